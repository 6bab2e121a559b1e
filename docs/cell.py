"""Draws docs/cell.png: the cell in the middle of its work, after half a minute of `pick_line`."""

from pathlib import Path

import cv2

from twin.layout import load_layout
from twin.loop import Loop
from twin.plant.plant import Plant
from twin.plant.snapshot import snapshot
from twin.stack.config import nominal_config
from twin.stack.control_unit import ControlUnit
from twin.stack.stack import Stack

TIME = 36.0  # s


def main() -> None:
    layout = load_layout()
    config = nominal_config(layout.site, layout.options)
    plant, stack = Plant(layout, 1), Stack(config)
    plant.park([w.motion.rest for w in stack.arms])
    Loop(plant, stack, ControlUnit(config.wheels)).run(TIME)
    x, y, _ = layout.site.pick
    folder = Path(__file__).parent
    for name, position, target in (
        ("cell", (x - 1.9, y - 1.7, 1.7), (x - 0.15, y + 0.1, 0.55)),
        ("close", (x - 0.9, y - 0.25, 1.35), (x - 0.25, y + 0.1, 0.65)),
    ):
        picture = snapshot(plant.world, position, target)
        cv2.imwrite(str(folder / f"{name}.png"), picture[:, :, ::-1])
    plant.close()


if __name__ == "__main__":
    main()

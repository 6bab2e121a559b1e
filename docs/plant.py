"""Draws docs/plant.png: cell and warehouse from above the south-west corner."""

from pathlib import Path

import cv2

from twin.layout import load_layout
from twin.messages import DriveOrder
from twin.plant.plant import Plant
from twin.plant.snapshot import snapshot
from twin.stack.config import nominal_config
from twin.stack.stack import Stack


def main() -> None:
    layout = load_layout()
    plant = Plant(layout, 0, DriveOrder(0.0, ()))
    stack = Stack(nominal_config(layout.site, layout.options))
    plant.park([worker.motion.rest for worker in stack.arms])
    picture = snapshot(plant.world, (-1.5, -8.6, 10.2), (6.9, 2.0, 0.0), 1280, 640)
    cv2.imwrite(str(Path(__file__).parent / "plant.png"), picture[..., ::-1])
    plant.close()


if __name__ == "__main__":
    main()

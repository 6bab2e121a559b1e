"""What stands or goes on the floor and is not in the drawing.

An obstacle that is there from the start is fixed to the floor. One that appears later, and every
mover, is a body of its own: it waits in a store below the floor, asleep, until the faults put it in
place, and then stands by its weight.
"""

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from twin.geometry import Array
from twin.layout import Mover, Obstacle
from twin.plant.assembly import MASKS, attach, set_masks
from twin.plant.model_files import load_model

# Seen from above, along x and y of its own frame, m; a test holds them to the models.
OUTLINE = {
    "carton": (0.40, 0.30),
    "pillar": (0.24, 0.24),
    "low_box": (0.40, 0.30),
    "table": (0.80, 0.60),
    "black_panel": (0.80, 0.12),  # with its feet
    "glass_panel": (0.80, 0.12),
    "calibration_board": (0.80, 0.44),
}
MOVER_OUTLINE = (0.50, 0.40)
BLACK, GLASS = "black", "glass"  # geoms that the lidar reads wrongly, by the end of their names
STORE_DEPTH, STORE_PITCH = 3.0, 1.5  # m


def is_late(obstacle: Obstacle) -> bool:
    """Whether an obstacle is not there from the start."""
    return obstacle.appears > 0 or obstacle.near > 0


def obstacle_name(index: int) -> str:
    """Prefix of an obstacle's names in the model; with `/free` the name of its joint."""
    return f"obstacle_{index}/"


def mover_name(index: int) -> str:
    """Prefix of a mover's names in the model; its joints and servos are `x` and `y`."""
    return f"mover_{index}/"


def mover_start(mover: Mover) -> Array:
    """Where a mover starts: at the head of its path, looking along it. Shape (3,)."""
    (x, y), (x1, y1) = mover.path[:2]
    return np.array([x, y, np.arctan2(y1 - y, x1 - x)])


def add_obstacles(spec: mujoco.MjSpec, obstacles: Sequence[Obstacle], root: Path) -> None:
    """Put obstacles where they stand, and late ones into their store."""
    for i, obstacle in enumerate(obstacles):
        model = load_model(root, f"obstacles/{obstacle.kind}.xml")
        if is_late(obstacle):
            _store(spec, model, i)
        else:
            attach(spec, model, obstacle.pose, obstacle_name(i), MASKS["standing"])


def _store(spec: mujoco.MjSpec, model: mujoco.MjSpec, index: int) -> None:
    set_masks(model, MASKS["loose"])
    frame = spec.worldbody.add_frame(pos=(STORE_PITCH * index, 0.0, -STORE_DEPTH))
    body = frame.attach_body(model.worldbody.first_body(), obstacle_name(index), "")
    body.add_freejoint(name=f"{obstacle_name(index)}free")
    body.sleep = mujoco.mjtSleepPolicy.mjSLEEP_INIT


def add_movers(spec: mujoco.MjSpec, movers: Sequence[Mover], root: Path) -> None:
    """Put the movers at the head of their paths."""
    for i, mover in enumerate(movers):
        model = load_model(root, "obstacles/mover.xml")
        attach(spec, model, tuple(mover_start(mover)), mover_name(i), MASKS["loose"])

"""Drives a cart to and fro along its path.

It has a protective field before it, as ISO 3691-4 asks of any driverless truck: the ground it would
need to stop, and a gap. It brakes for a vehicle in that field, standing or moving, and goes on when
the field is free. It sees nothing else, gives way to nobody, and looks neither to its sides nor
behind: who drives into its side, or into its field too late for its brakes, hits it.
"""

import mujoco
import numpy as np

from twin.floor_plan import FOOTPRINT
from twin.geometry import Array, rectangle, rectangles_overlap, rot2
from twin.layout import Mover
from twin.plant.obstacles import MOVER_OUTLINE, mover_name, mover_start

ACCELERATION = 1.0  # m/s^2; guess
CORNER_SPEED = 0.1  # m/s with which it takes a corner, and turns round; guess
GAP = 0.3  # m that the protective field reaches beyond what braking takes
GAIN = 2.0  # 1/s towards the point of the path where it should be; not tuned
FAR = 4.0  # m between the middles from which nobody is in the way: more than it takes at 2 m/s
LEASH = 0.10  # m that it may be off that point before the point waits


class MoverWay:
    """How far a cart is along its path, and how fast it lets itself go. No physics.

    Attributes:
        travel: m along the path there and back.
        speed: m/s.

    Args:
        mover: its path and speed.
    """

    def __init__(self, mover: Mover):
        self._mover = mover
        self.yaw = float(mover_start(mover)[2])  # of the cart in world: it never turns
        # there and back, as one closed way
        self._corners = np.array([*mover.path, *mover.path[-2::-1]], dtype=float)
        steps = np.linalg.norm(np.diff(self._corners, axis=0), axis=1)
        self._along = np.concatenate([[0.0], np.cumsum(steps)])
        self.travel = self.speed = 0.0

    def choose_speed(self, now: float, pose: Array, dt: float) -> None:
        """Towards the speed that is allowed, as its drive can.

        Args:
            now: s.
            pose: of the vehicle, x, y, yaw in world.
            dt: time since the last call, s.
        """
        wanted = 0.0 if now < self._mover.starts else self._allowed(pose)
        change = np.clip(wanted - self.speed, -ACCELERATION * dt, ACCELERATION * dt)
        self.speed += float(change)

    def advance(self, dt: float) -> None:
        """On along the path at the chosen speed."""
        self.travel = (self.travel + self.speed * dt) % self._along[-1]

    def here(self) -> tuple[Array, Array, float]:
        """Point of the path, its direction, and what is left to the corner."""
        i = int(np.searchsorted(self._along, self.travel, side="right")) - 1
        i = min(i, len(self._corners) - 2)
        leg = self._corners[i + 1] - self._corners[i]
        direction = leg / np.linalg.norm(leg)
        point = self._corners[i] + (self.travel - self._along[i]) * direction
        return point, direction, float(self._along[i + 1] - self.travel)

    def _allowed(self, pose: Array) -> float:
        """Speed from which it can slow down to the next corner; 0 with the vehicle in its field."""
        point, direction, left = self.here()
        speed = min(self._mover.speed, float(np.sqrt(2 * ACCELERATION * left)) + CORNER_SPEED)
        if np.linalg.norm(pose[:2] - point) > FAR:
            return speed
        x, y, yaw = pose
        vehicle = rectangle(x, y, yaw, *FOOTPRINT)
        braking = self.speed**2 / (2 * ACCELERATION)
        length, width = MOVER_OUTLINE
        for ahead in np.arange(0.0, GAP + braking + 0.05, 0.05):
            x, y = point + ahead * direction
            if rectangles_overlap(rectangle(x, y, self.yaw, length, width), vehicle):
                return 0.0
        return speed


class MoverDriver:
    """One cart. Call `step` at a fixed period.

    Args:
        model: the compiled plant.
        index: of the cart in `world.faults.movers`.
        mover: its path and speed.
    """

    def __init__(self, model: mujoco.MjModel, index: int, mover: Mover):
        name = mover_name(index)
        joints = [model.joint(f"{name}{axis}") for axis in "xy"]
        self._qpos = [int(j.qposadr[0]) for j in joints]
        self._ctrl = [model.actuator(f"{name}{axis}").id for axis in "xy"]
        self._way, self._start = MoverWay(mover), mover_start(mover)
        self._R_world_cart = rot2(self._start[2])

    def position(self, data: mujoco.MjData) -> Array:
        """Where the cart is. Shape (2,), world."""
        return self._start[:2] + self._R_world_cart @ data.qpos[self._qpos]

    def step(self, data: mujoco.MjData, pose: Array, dt: float) -> None:
        """Set the servos.

        Args:
            data: the plant's state.
            pose: of the vehicle, x, y, yaw in world.
            dt: time since the last call, s.
        """
        here = self.position(data)
        self._way.choose_speed(data.time, pose, dt)
        target, direction, _ = self._way.here()
        v = GAIN * (target - here)
        if np.linalg.norm(target - here) < LEASH:
            self._way.advance(dt)
            v += self._way.speed * direction
        data.ctrl[self._ctrl] = self._R_world_cart.T @ v

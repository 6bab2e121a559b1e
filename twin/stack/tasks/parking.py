"""Standing still to a millimetre: a straight leg, then small steps until the pose is right.

While the vehicle stands, the filter of the photoelectric network averages over turns of the head;
so it stands and waits before each step, and stays where it is once it is near enough.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np

from twin.geometry import Array
from twin.messages import BodyVelocity, ParkOrder
from twin.stack.config import DriveLimits
from twin.stack.planning.drive import Leg
from twin.stack.planning.tracking import VelocityLaw, pose_error
from twin.stack.tasks.mission import Act, Behaviour, sequence

if TYPE_CHECKING:
    from twin.stack.stack import Stack

NEAR, NEAR_YAW = 0.0004, np.radians(0.05)  # m, rad: good enough to stay
LISTEN = 0.8  # s of standing before the pose is judged
CLOSE_IN = 0.6  # s after a leg in which feedback closes in
MOST_STEPS = 6  # after which it stays where it is
HOLD = 0.5  # s that it stays


class Parker:
    """Moves the wheels to a pose and keeps them there.

    Args:
        limits: of the vehicle.
    """

    def __init__(self, limits: DriveLimits):
        self._limits, self._law = limits, VelocityLaw(limits)
        self._goal = np.zeros(3)
        self._leg: Leg | None = None
        self._state: Literal["idle", "leg", "listen", "hold"] = "idle"
        self._since, self._steps = 0.0, 0
        self.parked: list[tuple[float, Array]] = []  # stamp and goal of each that was reached

    @property
    def active(self) -> bool:
        """Whether the wheels are its own."""
        return self._state != "idle"

    def start(self, now: float, pose: Array, goal: Sequence[float]) -> None:
        """Set out for a pose, x, y, yaw in world."""
        self._goal, self._steps = np.asarray(goal, dtype=float), 0
        self._set_out(now, pose)

    def _set_out(self, now: float, pose: Array) -> None:
        self._law.reset()
        self._leg = Leg(self._limits, pose, self._goal, now)
        self._state = "leg"

    def step(self, now: float, pose: Array) -> BodyVelocity:
        """Command of this tick from the localised pose, x, y, yaw in world."""
        if self._state == "leg":
            assert self._leg is not None
            if now < self._leg.ends + CLOSE_IN:
                reference, _, _ = self._leg.at(now)
                _, speed, push = self._leg.at(now + self._limits.dead_time)
                return self._law.command(pose, reference, speed, push)
            self._state, self._since = "listen", now
        if self._state == "listen" and now >= self._since + LISTEN:
            off = pose_error(self._goal, pose)
            near = np.hypot(*off[:2]) < NEAR and abs(off[2]) < NEAR_YAW
            if near or self._steps >= MOST_STEPS:
                self._state, self._since = "hold", now
            else:
                self._steps += 1
                self._set_out(now, pose)
        if self._state == "hold" and now >= self._since + HOLD:
            self._state = "idle"
            self.parked.append((now, self._goal))
        return BodyVelocity()


def park_mission(stack: "Stack") -> Behaviour:
    """From pose to pose of the order, parked at each."""
    assert isinstance(stack.order, ParkOrder)
    return sequence("park order", *[_park(stack, i, p) for i, p in enumerate(stack.order.poses)])


def _park(stack: "Stack", index: int, pose) -> Act:
    parker = stack.parker
    return Act(
        f"park at {index + 1}",
        done=lambda: not parker.active,
        start=lambda: parker.start(stack.now, stack.pose, pose),
    )

"""An arm that takes something standing from one place and sets it down at another.

Down over the thing with open fingers, close, make sure of the grip, carry, set down, let go, up and
back to the fold. A grip is believed only as long as the fingers say so.
"""

from dataclasses import dataclass
from enum import Enum

import numpy as np

from twin.geometry import Array, apply, wrap_angle
from twin.stack.control.arm_kinematics import Unreachable
from twin.stack.control.arm_motion import DWELL, RELEASE
from twin.stack.tasks.arm_worker import RELEASE_HEIGHT, ArmWorker, Phase

HOVER = 0.065  # m above a place from which the hand goes straight down
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Place:
    """Where a thing stands: its bottom's middle in base, m, and the turn of its x axis, rad."""

    position: tuple[float, float, float]
    yaw: float


class Step(Enum):
    IDLE = "idle"
    REACHING = "reaching"
    CLOSING = "closing"
    CARRYING = "carrying"
    RELEASING = "releasing"
    BACKING = "backing"


class Porter:
    """Carries a thing with one arm.

    Args:
        worker: the arm, which must have no job of its own meanwhile.
    """

    def __init__(self, worker: ArmWorker):
        self._worker = worker
        self._config = worker.config
        self.step_name = Step.IDLE
        self.failure = ""  # why the last thing did not arrive
        self._goal: Place | None = None
        self._due = 0.0

    @property
    def idle(self) -> bool:
        return self.step_name is Step.IDLE

    def start(self, now: float, source: Place, goal: Place) -> None:
        """Set out; out of reach is a failure at once."""
        worker = self._worker
        self.failure, self._goal = "", goal
        worker.set_fingers(self._config.gripper.stroke)
        try:
            self._over(now, source)
            self._due = worker.motion.move_to(now, self._tcp(source), self._closing(source))
        except Unreachable as error:
            self._fail(now, f"out of reach: {error}")
            return
        self.step_name = Step.REACHING

    def step(self, now: float) -> None:
        """Go on; call every tick until `idle`."""
        worker, parcel = self._worker, self._config.parcel
        if worker.phase is Phase.BLOCKED:
            self.failure, self.step_name = "the arm is blocked", Step.IDLE
        if self.step_name is Step.CARRYING and now < self._due:
            if not worker.grips(parcel.width):
                self._fail(now, "lost on the way")
            return
        if now < self._due:
            return
        if self.step_name is Step.REACHING:
            worker.set_fingers(0.0)
            self.step_name, self._due = Step.CLOSING, now + DWELL
        elif self.step_name is Step.CLOSING:
            self._carry(now)
        elif self.step_name is Step.CARRYING:
            worker.motion.dynamics.set_payload(0.0)
            worker.set_fingers(self._config.gripper.stroke)
            self.step_name, self._due = Step.RELEASING, now + RELEASE
        elif self.step_name is Step.RELEASING:
            self._due = self._back(now)
        elif self.step_name is Step.BACKING:
            self.step_name = Step.IDLE

    # --- inside ----------------------------------------------------------------------------------

    def _carry(self, now: float) -> None:
        worker, goal = self._worker, self._goal
        if not worker.grips(self._config.parcel.width):
            self._fail(now, "closed on nothing")
            return
        assert goal is not None
        worker.motion.dynamics.set_payload(self._config.parcel.mass)
        try:
            self._over(now, goal)
            target = self._tcp(goal) + RELEASE_HEIGHT * UP
            self._due = worker.motion.move_to(now, target, self._closing(goal))
        except Unreachable as error:
            worker.set_fingers(self._config.gripper.stroke)  # back to where it stood, nearly
            self._fail(now, f"the goal is out of reach: {error}")
            return
        self.step_name = Step.CARRYING

    def _over(self, now: float, place: Place) -> None:
        above = self._tcp(place) + HOVER * UP
        self._worker.motion.move_to(now, above, self._closing(place))

    def _tcp(self, place: Place) -> Array:
        """Where the hand holds a thing that stands there, in mount. Shape (3,)."""
        p_base = np.array(place.position) + self._config.parcel.grasp_z * UP
        return apply(self._worker.motion.T_mount_base, p_base)

    def _closing(self, place: Place) -> float:
        """Along the thing's y the fingers close; in mount."""
        R = self._worker.motion.T_mount_base[:3, :3]
        return float(wrap_angle(place.yaw + np.pi / 2 + np.arctan2(R[1, 0], R[0, 0])))

    def _back(self, now: float) -> float:
        self.step_name = Step.BACKING
        return self._worker.motion.go_stow(now)

    def _fail(self, now: float, why: str) -> None:
        self.failure = why
        self._worker.events.append(f"arm {self._worker.index}: parcel {why}")
        self._worker.motion.dynamics.set_payload(0.0)
        self._worker.set_fingers(self._config.gripper.stroke)
        self._due = self._back(now)

"""Ways out when there is no plan (Li & An 2025, section 2.2: a vehicle stuck in a dead end).

Clear the map, turn on the spot, back out; after each a new plan is tried. It ends with a plan or
standing still and saying why. A state machine without a clock: time is passed in.
"""

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np

from twin.geometry import Array, wrap_angle
from twin.messages import BodyVelocity


class Stage(Enum):
    IDLE = "idle"
    CLEAR_MAP = "clear map"
    TURN = "turn in place"
    BACK_OUT = "back out"
    RECOVERED = "recovered"
    GIVEN_UP = "given up"


STILL = BodyVelocity()
ORDER = (Stage.CLEAR_MAP, Stage.TURN, Stage.BACK_OUT)


@dataclass(frozen=True)
class RecoveryOptions:
    """Not tuned."""

    wait: float = 1.5  # s for fresh scans after the map was cleared
    turn: float = math.pi / 2  # rad
    turn_rate: float = 0.5  # rad/s
    back: float = 0.5  # m
    back_speed: float = 0.15  # m/s
    room: float = 0.05  # m behind below which it does not go on
    patience: float = 2.0  # a stage may take that many times as long as it should
    rounds: int = 2  # through all stages


@dataclass(frozen=True)
class RecoveryStep:
    """What is to be done in this tick.

    Args:
        stage: under way.
        velocity: to be driven.
        clear_map: whether the obstacles seen so far are to be forgotten now; once a stage.
        replan: whether a plan is to be tried now; its outcome is passed to the next step.
        event: one line when the stage changes, else empty.
    """

    stage: Stage
    velocity: BodyVelocity = STILL
    clear_map: bool = False
    replan: bool = False
    event: str = ""


class Recovery:
    """The state machine.

    Args:
        options: sizes of its motions.
    """

    def __init__(self, options: RecoveryOptions | None = None):
        self.options = options or RecoveryOptions()
        self.stage, self.reason = Stage.IDLE, ""
        self._round, self._since, self._asked = 0, 0.0, False
        self._origin, self._turned = np.zeros(3), 0.0
        self._tried: list[str] = []
        self._announced = self._cleared = False

    @property
    def active(self) -> bool:
        return self.stage in ORDER

    def start(self, now: float, pose: Array, reason: str) -> None:
        """There is no plan, for a reason of one line, while the vehicle stands at a pose."""
        self.reason, self._round, self._tried = reason, 0, []
        self._enter(Stage.CLEAR_MAP, now, np.asarray(pose, dtype=float))

    def step(
        self, now: float, pose: Array, planned: bool, room_to_turn: bool, room_back: float
    ) -> RecoveryStep:
        """What to do in this tick.

        Args:
            now: s.
            pose: fused x, y, yaw in world.
            planned: whether there is a plan by now, after it was asked for.
            room_to_turn: whether the vehicle can turn on the spot.
            room_back: m that it can back out.
        """
        if not self.active:
            return RecoveryStep(self.stage)
        if not (math.isfinite(now) and np.shape(pose) == (3,) and np.all(np.isfinite(pose))):
            return RecoveryStep(self.stage)  # blind: stand still
        if self._asked and planned:
            self.stage = Stage.RECOVERED
            return RecoveryStep(self.stage, event=f"recovered after {self._tried[-1]}")
        if self._asked:
            self._next(now, pose)
            if not self.active:
                return RecoveryStep(self.stage, event=self.reason)
        event = "" if self._announced else f"recovery: {self.stage.value}"
        self._announced = True
        clear = self.stage is Stage.CLEAR_MAP and not self._cleared
        self._cleared = self._cleared or clear
        velocity = self._motion(now, pose, room_to_turn, room_back)
        if velocity is None:
            self._asked = True
            return RecoveryStep(self.stage, clear_map=clear, replan=True, event=event)
        return RecoveryStep(self.stage, velocity, clear, event=event)

    def _motion(self, now, pose, room_to_turn: bool, room_back: float) -> BodyVelocity | None:
        """Velocity of the stage under way, or None when it is over."""
        o, elapsed = self.options, now - self._since
        if self.stage is Stage.CLEAR_MAP:
            return BodyVelocity() if elapsed < o.wait else None
        if self.stage is Stage.TURN:
            self._turned += abs(float(wrap_angle(pose[2] - self._origin[2])))
            self._origin[2] = pose[2]
            late = elapsed > o.patience * o.turn / o.turn_rate
            if late or self._turned >= o.turn or not room_to_turn:
                return None
            return BodyVelocity(omega=o.turn_rate)
        gone = float(np.hypot(*(np.asarray(pose[:2]) - self._origin[:2])))
        late = elapsed > o.patience * o.back / o.back_speed
        if late or gone >= o.back or not room_back > o.room:
            return None
        return BodyVelocity(vx=-o.back_speed)

    def _next(self, now: float, pose: Array) -> None:
        """On to the next stage, the next round, or give up."""
        place = ORDER.index(self.stage) + 1
        if place == len(ORDER):
            place, self._round = 0, self._round + 1
        if self._round >= self.options.rounds:
            self.stage = Stage.GIVEN_UP
            tried = ", ".join(dict.fromkeys(self._tried))
            self.reason = f"given up: {self.reason} (tried {self._round} times: {tried})"
            return
        self._enter(ORDER[place], now, pose)

    def _enter(self, stage: Stage, now: float, pose: Array) -> None:
        self.stage, self._since, self._asked = stage, now, False
        self._origin, self._turned = np.array(pose, dtype=float), 0.0
        self._announced = self._cleared = False
        self._tried.append(stage.value)

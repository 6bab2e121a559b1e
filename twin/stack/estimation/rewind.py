"""Takes corrections of the filter back: wheels begin to slip before it shows."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field

from twin.geometry import Array
from twin.stack.estimation.ekf import POSE, MotionEkf


@dataclass
class _Mark:
    """State of the filter at a time, and the inertial readings that carried it on from there."""

    stamp: float
    x: Array
    P: Array
    acceleration: Array
    steps: list[tuple[float, Array | None, float | None]] = field(default_factory=list)


class Rewind:
    """Keeps the states of the last moments.

    Args:
        ekf: the filter, which is advanced through here alone.
        span: s that can be taken back.
    """

    def __init__(self, ekf: MotionEkf, span: float):
        self._ekf, self._span = ekf, span
        self._marks: deque[_Mark] = deque()

    def advance(self, dt: float, accel: Array | None, gyro: float | None) -> None:
        """Advance the filter and remember by what."""
        self._ekf.advance(dt, accel, gyro)
        if self._marks:
            self._marks[-1].steps.append((dt, accel, gyro))

    def mark(self, stamp: float) -> None:
        """Remember the state, which is that of `stamp`."""
        ekf = self._ekf
        self._marks.append(_Mark(stamp, ekf.x.copy(), ekf.P.copy(), ekf.acceleration))
        while self._marks[0].stamp < stamp - self._span:
            self._marks.popleft()

    def clear(self) -> None:
        """Whatever happened until now is not taken back any more."""
        self._marks.clear()

    def back(self) -> Iterator[tuple[float, Array]]:
        """Go through the span again by inertia alone; yields stamps and poses (3,) on the way."""
        if not self._marks:
            return
        ekf, first = self._ekf, self._marks[0]
        steps = [step for mark in self._marks for step in mark.steps]
        ekf.x, ekf.P, ekf.acceleration = first.x, first.P, first.acceleration
        stamp = first.stamp
        self.clear()
        for dt, accel, gyro in steps:
            ekf.advance(dt, accel, gyro)
            stamp += dt
            yield stamp, ekf.x[POSE]

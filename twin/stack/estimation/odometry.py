"""Dead reckoning from wheel counts alone, kept beside the fused estimate for comparison."""

import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array, compose2
from twin.messages import WheelState
from twin.stack.config import Wheels
from twin.stack.control import mecanum


def displacement(wheels: Wheels, ticks: NDArray[np.integer]) -> Array:
    """Displacement of the base in its own axes for an increment of counts.

    Args:
        wheels: the drawing.
        ticks: increments of the four wheels' counters, shape (4,).

    Returns:
        x, y in m and yaw in rad, as a twist times its duration. Shape (3,).
    """
    turn = 2 * np.pi / (wheels.gear_ratio * wheels.counts_per_turn)
    return mecanum.body_velocity(wheels, turn * ticks.astype(np.float64))


def exp2(twist: Array) -> Array:
    """Planar pose reached by a constant twist held for unit time: the exponential of SE(2).

    Args:
        twist: x, y in m and yaw in rad, in the axes of the start. Shape (3,).
    """
    x, y, yaw = twist
    # sin(yaw) / yaw and (1 - cos(yaw)) / yaw, without a division by zero; sinc(a) is of pi a.
    a, b = np.sinc(yaw / np.pi), 0.5 * yaw * np.sinc(0.5 * yaw / np.pi) ** 2
    return np.array([a * x - b * y, b * x + a * y, yaw])


class WheelOdometry:
    """Integrates wheel counts, exactly for a twist that is constant over the interval."""

    def __init__(self, wheels: Wheels, start: Array):
        self._wheels = wheels
        self.pose = np.array(start, dtype=float)  # x, y, yaw in world
        self._last: WheelState | None = None

    def update(self, state: WheelState) -> Array:
        """Pose after a reading; one that is not newer than the last is ignored. Shape (3,)."""
        if not np.isfinite(state.stamp) or (
            self._last is not None and state.stamp <= self._last.stamp
        ):
            return self.pose
        if self._last is not None:
            self.pose = compose2(
                self.pose, exp2(displacement(self._wheels, state.ticks - self._last.ticks))
            )
        self._last = state
        return self.pose

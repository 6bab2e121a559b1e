"""Whether the wheels grip: from their own redundancy, and from what the inertial unit says.

Four wheels report three velocities; what is left over is zero on a vehicle that does not slip. With
the equations of `twin.stack.control.mecanum` the rim speeds obey

    r (w_fl + w_fr - w_rl - w_rr) = 0,

whatever the motion. It sees the wheels of one side, one end or one corner slip, not all four
spinning alike; that shows against the inertial unit, as an innovation outside the filter's gate.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from twin.geometry import Array
from twin.stack.config import Wheels

CLOSURE = np.array([1.0, 1.0, -1.0, -1.0])  # orthogonal to the three columns of the kinematics


def closure(wheels: Wheels, speeds: Array) -> float:
    """Mean rim speed of a wheel that no motion of the vehicle explains, m/s.

    Args:
        wheels: the drawing.
        speeds: wheel speeds, rad/s. Shape (4,).
    """
    return float(wheels.radius * (CLOSURE @ speeds) / 4.0)


@dataclass(frozen=True)
class SlipLimits:
    """When wheels are said to slip, and when to grip again.

    The size of the closure without slip was measured on drives of the default cell (seeds 0-3):
    0.5 mm/s rms at cruise, 4 mm/s at 0.5 m/s of strafe, 5 mm/s at 1.2 rad/s of turning.
    """

    # 1 sigma of the closure without slip: constant, per m/s of strafe, per rad/s of turning.
    closure: tuple[float, float, float] = (0.0015, 0.008, 0.004)
    sigmas: float = 5.0  # of it, beyond which wheels slip
    grip_time: float = 0.10  # s without a sign of slip after which the wheels are believed again
    # Wheels that differ from the estimate by the same velocity for so long do not slip: slipping
    # speeds change. Then the estimate is wrong, say after a blow that the unit did not take.
    steady_time: float = 2.0  # s
    steady: tuple[float, float, float] = (0.01, 0.01, 0.02)  # m/s, m/s, rad/s, 1 sigma; guess
    longest: float = 8.0  # s on inertia alone, then the wheels are better than nothing; guess


class SlipMonitor:
    """Follows the signs of slip from reading to reading.

    Args:
        limits: when wheels are said to slip.
    """

    def __init__(self, limits: SlipLimits | None = None):
        self.limits = limits or SlipLimits()
        self.slipping = False
        self.mistaken = False  # the estimate, not the wheels, is wrong
        self._since = self._quiet_since = 0.0
        self._offsets: deque[tuple[float, Array]] = deque()

    def closes(self, residual: float, twist: Array) -> bool:
        """Whether a closure (m/s) is what a twist (3,) without slip leaves over."""
        size = np.dot(self.limits.closure, (1.0, abs(twist[1]), abs(twist[2])))
        return abs(residual) <= self.limits.sigmas * size

    def update(
        self, stamp: float, closes: bool, inside: bool, offset: Array, shaken: bool = False
    ) -> bool:
        """Take a reading of the wheels; returns whether it may correct the estimate.

        Args:
            stamp: s.
            closes: whether the four wheels agree among each other.
            inside: whether they agree with the estimate.
            offset: velocity of the wheels less the estimate's. Shape (3,).
            shaken: whether an inertial reading was dropped since the last call: then it is the
                estimate that lacks something.
        """
        self.mistaken = shaken and closes and not inside
        if self.mistaken:
            self.slipping = False
            return True
        if not (closes and inside):
            if not self.slipping:
                self.slipping, self._since = True, stamp
                self._offsets.clear()
            self._quiet_since = stamp
        if not self.slipping:
            return True
        self._offsets.append((stamp, offset))
        while stamp - self._offsets[0][0] > self.limits.steady_time:
            self._offsets.popleft()
        if stamp - self._quiet_since >= self.limits.grip_time:
            self.slipping = False
        elif stamp - self._since >= self.limits.longest or (closes and self._steady(stamp)):
            self.slipping, self.mistaken = False, True
        return not self.slipping

    def _steady(self, stamp: float) -> bool:
        """Whether wheels and estimate have differed by a constant for the whole window."""
        if stamp - self._offsets[0][0] < 0.9 * self.limits.steady_time:
            return False
        spread = np.std([offset for _, offset in self._offsets], axis=0)
        return bool(np.all(spread < self.limits.steady))

"""Encoder counts to angle and speed of the wheels.

The counters take all four edges of a line (four-fold decoding, Li & An 2025, section 1.2) and wrap
at 16 bit; at 15.7 rad/s a wheel makes 200 counts in 2 ms, far from the 32767 that would alias.
"""

import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array

WINDOW = 5  # steps: one count in 10 ms is 0.016 rad/s, 1.2 mm/s at the rim


class CountDecoder:
    """Unwraps the counters and differentiates them over a sliding window.

    Args:
        counts_per_turn: of the wheel, gearbox included.
        period: seconds between calls.
    """

    def __init__(self, counts_per_turn: float, period: float):
        self._angle = 2 * np.pi / counts_per_turn  # rad a count
        self._period = period
        self._raw: NDArray[np.uint16] | None = None
        self.total = np.zeros(4, dtype=np.int64)  # counts since the first call
        self._history: list[NDArray[np.int64]] = [self.total.copy()]

    @property
    def angle(self) -> Array:
        """Of the wheels since the first call, rad. Shape (4,)."""
        return np.asarray(self.total * self._angle, dtype=np.float64)

    def update(self, ticks: NDArray[np.uint16]) -> Array:
        """Take the counters' present state; returns wheel speeds in rad/s. Shape (4,).

        The speed is the mean over the last `WINDOW` periods (fewer after the start).
        """
        if self._raw is not None:
            # The difference of two uint16 read as int16 is right across the wrap.
            self.total = self.total + (ticks - self._raw).astype(np.int16)
            self._history.append(self.total)
            del self._history[: -WINDOW - 1]
        self._raw = np.array(ticks, dtype=np.uint16)
        span = len(self._history) - 1
        if span == 0:
            return np.zeros(4)
        counts = (self._history[-1] - self._history[0]).astype(np.float64)
        return counts * (self._angle / (span * self._period))

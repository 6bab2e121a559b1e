"""Fused poses of the last seconds: where the vehicle was when a picture was taken."""

from bisect import bisect_left
from collections import deque

import numpy as np

from twin.geometry import Array, wrap_angle

AHEAD = 0.05  # s beyond the newest pose that may be extrapolated


class PoseHistory:
    """Ring buffer of poses, interpolated in time.

    Args:
        length: number of poses kept; 300 at 100 Hz reach back three seconds.
    """

    def __init__(self, length: int = 300):
        self._stamps: deque[float] = deque(maxlen=length)
        self._poses: deque[Array] = deque(maxlen=length)

    def add(self, stamp: float, pose: Array) -> None:
        """Append a pose; stamps must rise, others are ignored."""
        if self._stamps and stamp <= self._stamps[-1]:
            return
        self._stamps.append(stamp)
        self._poses.append(np.array(pose, dtype=float))

    def forget(self, since: float) -> None:
        """Drop the poses from `since` on: they were found to be wrong."""
        while self._stamps and self._stamps[-1] >= since:
            self._stamps.pop()
            self._poses.pop()

    def at(self, stamp: float) -> Array | None:
        """Pose (x, y, yaw) at a past time; None where the buffer does not reach. Shape (3,)."""
        if len(self._stamps) < 2 or not (self._stamps[0] <= stamp <= self._stamps[-1] + AHEAD):
            return None
        i = min(max(bisect_left(self._stamps, stamp), 1), len(self._stamps) - 1)
        before, after = self._poses[i - 1], self._poses[i]
        span = self._stamps[i] - self._stamps[i - 1]
        change = after - before
        change[2] = wrap_angle(change[2])
        pose = before + change * (stamp - self._stamps[i - 1]) / span
        pose[2] = wrap_angle(pose[2])
        return pose

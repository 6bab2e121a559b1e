"""How well a vehicle drives a course, and how its odometry fares on dry and on wet floor.

All from the plant's truth. The wheels stand on a patch when the middle of one of them does.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from evaluation.run import Trajectory
from twin.geometry import between2
from twin.layout import WetPatch
from twin.loop import Tick
from twin.stack.estimation.motion_models import mismatch

STILL, TURNING = 0.02, 0.05  # m/s, rad/s of the true velocity
AT_NODE = 0.10  # m from a node within which the vehicle turns on it
STEP, SHORTEST = 0.5, 0.05  # s of a step of the odometry; m that it must cover to count
FULL_TURN = 2 * np.pi - np.radians(1.0)


@dataclass(frozen=True)
class Aisle:
    """A straight line along x, clear of patches, that is driven at cruise.

    Attributes:
        y: where it is drawn, m.
        x: from, to, m.
        cruise: speed that counts as cruise, m/s.
    """

    y: float
    x: tuple[float, float]
    cruise: float


class CourseMonitor:
    """Follows the true motion tick by tick.

    Args:
        wet: patches of the floor.
        wheels: where the wheels stand in base, m. Shape (4, 2).
    """

    def __init__(self, wet: Sequence[WetPatch], wheels: NDArray[np.float64]):
        self._wet, self._wheels = tuple(wet), wheels
        self._stamps: list[float] = []
        self._pose: list[NDArray] = []
        self._velocity: list[NDArray] = []

    def observe(self, tick: Tick) -> None:
        self._stamps.append(tick.stamp)
        self._pose.append(np.array(tick.truth.pose))
        self._velocity.append(np.array(tick.truth.velocity))

    @property
    def pose(self) -> NDArray[np.float64]:
        """True x, y, yaw. Shape (n, 3)."""
        return np.array(self._pose).reshape(-1, 3)

    @property
    def speed(self) -> NDArray[np.float64]:
        """Shape (n,), m/s."""
        return np.hypot(*np.array(self._velocity).reshape(-1, 3)[:, :2].T)

    def wheels_wet(self) -> NDArray[np.int64]:
        """Number of wheels on a patch at each stamp. Shape (n,)."""
        x, y, yaw = self.pose.T
        c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        wx = x[:, None] + c * self._wheels[:, 0] - s * self._wheels[:, 1]
        wy = y[:, None] + s * self._wheels[:, 0] + c * self._wheels[:, 1]
        on = np.zeros(wx.shape, dtype=bool)
        for p in self._wet:
            on |= (p.x[0] <= wx) & (wx <= p.x[1]) & (p.y[0] <= wy) & (wy <= p.y[1])
        return on.sum(axis=1)

    def dry_until(self) -> float:
        """Stamp at which the first wheel comes onto a patch; inf without one."""
        wet = np.flatnonzero(self.wheels_wet())
        return self._stamps[wet[0]] if len(wet) else np.inf

    def cross_track(self, aisle: Aisle) -> tuple[float, float]:
        """Greatest true distance (m) from the drawn line at cruise, and the way driven so (m).

        NaN where the aisle was not driven at cruise.
        """
        pose, velocity = self.pose, np.array(self._velocity).reshape(-1, 3)
        c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        speed = np.abs(c * velocity[:, 0] - s * velocity[:, 1])  # along the aisle
        inside = (pose[:, 0] >= aisle.x[0]) & (pose[:, 0] <= aisle.x[1])
        along = inside & (np.abs(pose[:, 1] - aisle.y) < 0.5) & (speed >= aisle.cruise)
        if not along.any():
            return float("nan"), 0.0
        period = float(np.median(np.diff(self._stamps)))
        return float(np.abs(pose[along, 1] - aisle.y).max()), float(speed[along].sum() * period)

    def turn_drift(self, node: Sequence[float]) -> float:
        """Greatest true displacement (m) of the vehicle's middle while it turns once at a node.

        Measured from where it was when it began to turn, until it has turned by 360 degrees. NaN
        where it never did.
        """
        pose, yaw = self.pose, np.unwrap(self.pose[:, 2])
        rate = np.abs(np.array(self._velocity).reshape(-1, 3)[:, 2])
        here = np.hypot(*(pose[:, :2] - np.asarray(node)[:2]).T) < AT_NODE
        worst = float("nan")
        i, n = 0, len(pose)
        while i < n:
            if not (here[i] and self.speed[i] < STILL and rate[i] < TURNING):
                i += 1
                continue
            away = np.flatnonzero(~here[i:])
            end = i + (away[0] if len(away) else n - i)
            full = np.flatnonzero(np.abs(yaw[i:end] - yaw[i]) >= FULL_TURN)
            if len(full):
                moved = np.hypot(*(pose[i : i + full[0] + 1, :2] - pose[i, :2]).T)
                worst = float(np.fmax(worst, moved.max()))
            i = end
        return worst


def step_errors(truth: Trajectory, track: Trajectory) -> dict[str, float]:
    """Errors of the steps that a track reports, rms: Xu et al., Eqs. 16-18.

    Each step is split into a first turn, a path and a second turn; the difference from the true
    step's is the odometry's own error, without what it has gathered before. NaN without a step.

    Args:
        truth, track: on the same stamps.
    """
    stamps, true = truth
    known = {}
    if len(stamps):
        at = np.arange(stamps[0], stamps[-1], STEP)
        for i in np.unique(np.searchsorted(stamps, at)):
            known[int(i)] = true[i], track[1][i]
    off = []
    for (a, reported_a), (b, reported_b) in pairwise(known.values()):
        step = between2(a, b)
        if np.hypot(*step[:2]) >= SHORTEST:
            off.append(mismatch(between2(reported_a, reported_b), step))
    first, path, second = (
        np.sqrt(np.mean(np.square(off), axis=0)) if off else np.full(3, np.nan)
    ).tolist()
    return {
        "step_first_turn_error_mrad": 1e3 * first,
        "step_path_error_mm": 1e3 * path,
        "step_second_turn_error_mrad": 1e3 * second,
    }

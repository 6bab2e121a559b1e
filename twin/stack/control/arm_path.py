"""Path of the hand from one standing point to another, and its fastest timing.

Geometry and timing are apart: the path alone decides what the hand can touch, the timing alone
what the drives must give. The hand points down all along; positions are in the mount frame.

1. Seen from above, the route is a taut string around the arm's own column, so it never leaves
   the hull of start, goal and column, and two arms with a line between their points stay apart.
2. Over the belt the hand keeps the belt's travel height, over the tray the tray's, and it comes
   and goes straight up and down where it starts or ends below.
3. Timing: fastest along the path under joint speed and acceleration limits (time-optimal path
   parameterisation by reachability: Pham & Pham 2018, IEEE T-RO 34(3), algorithm 1).
4. A moving average over `SMOOTHING` bounds the jerk (2 a / SMOOTHING); an average of values
   within the limits is within the limits.
"""

from dataclasses import dataclass

import numba
import numpy as np

from twin.geometry import Array
from twin.stack.config import Arm
from twin.stack.control.arm_kinematics import ArmKinematics

COLUMN = 0.135  # m, radius of the string's circle: half the hand and half the column, 45 mm air
GRID, FEWEST = 0.004, 150  # m, step along the path; and least number of points
ROUNDING = 0.05  # m, length over which corners are rounded
SMOOTHING = 0.085  # s: jerk 2 * 20 * MARGIN / SMOOTHING, below 500 rad/s^3
MARGIN, ATTEMPTS = (
    0.95,
    4,
)  # share of the acceleration limits at grid points, and tries to keep them
SLOWEST = 1e-3  # 1/s, of the path parameter: a standstill inside a path would last for ever
STEP = 0.002  # s, of the tables


@dataclass(frozen=True)
class Travel:
    """Heights that the TCP keeps while it travels, in mount."""

    belt_edge: float  # x in mount beyond which the belt's rail may stand below the hand, m
    belt_height: float  # of the TCP beyond that edge, m
    tray_height: float  # of the TCP elsewhere, m


@dataclass(frozen=True)
class JointTable:
    """Joint motion sampled every `STEP` seconds from its start. Shapes (n, 6)."""

    q: Array  # rad
    qd: Array  # rad/s
    qdd: Array  # rad/s^2

    @classmethod
    def from_positions(cls, q: Array) -> "JointTable":
        """Derivatives by central differences of a smooth motion."""
        qd = np.gradient(q, STEP, axis=0, edge_order=2)
        return cls(q, qd, np.gradient(qd, STEP, axis=0, edge_order=2))

    @property
    def duration(self) -> float:
        return (len(self.q) - 1) * STEP

    def sample(self, t: float) -> tuple[Array, Array, Array]:
        """Position, velocity, acceleration at t seconds from the start; held beyond the ends."""
        x = min(max(t / STEP, 0.0), len(self.q) - 1.0)
        k = min(int(x), len(self.q) - 2)
        w = x - k
        return tuple((1 - w) * a[k] + w * a[k + 1] for a in (self.q, self.qd, self.qdd))  # type: ignore[return-value]


def taut_string(start: Array, goal: Array, radius: float) -> Array:
    """Shortest route in the plane around a circle at the origin, through the front (+x).

    Args:
        start, goal: outside the circle or on it, m. Shape (2,).
        radius: of the circle, m.

    Returns:
        Corner points, the arc as a polyline. Shape (n, 2).
    """
    r0, r1 = np.hypot(*start), np.hypot(*goal)
    angle0, angle1 = np.arctan2(start[1], start[0]), np.arctan2(goal[1], goal[0])
    turn = np.sign(angle1 - angle0)
    # Each straight piece touches the circle arccos(radius / r) after the angle of its end.
    touch0 = angle0 + turn * np.arccos(min(radius / r0, 1.0))
    touch1 = angle1 - turn * np.arccos(min(radius / r1, 1.0))
    if turn * (touch1 - touch0) <= 0.0:  # the straight line passes clear
        return np.array([start, goal])
    n = max(2, int(np.ceil(abs(touch1 - touch0) * radius / GRID)))
    arc = np.linspace(touch0, touch1, n)
    return np.vstack([start, radius * np.column_stack([np.cos(arc), np.sin(arc)]), goal])


def hand_path(start: Array, goal: Array, travel: Travel) -> Array:
    """Points of the TCP, evenly spaced, from start to goal by the rules above. Shape (n, 3)."""
    start, goal = np.asarray(start, dtype=float), np.asarray(goal, dtype=float)
    radius = min(COLUMN, np.hypot(*start[:2]), np.hypot(*goal[:2]))
    route = _resample(taut_string(start[:2], goal[:2], radius))
    over_belt = route[:, 0] > travel.belt_edge
    height = np.where(over_belt, travel.belt_height, travel.tray_height)
    # Between belt and tray the height changes evenly along the way; at the ends it is at least
    # the end's own.
    along = np.linspace(0.0, 1.0, len(route))
    if over_belt[0] != over_belt[-1]:
        edge = along[np.argmax(over_belt != over_belt[0])]
        if over_belt[0]:
            height = np.interp(along, [0, edge, 1], [travel.belt_height] * 2 + [travel.tray_height])
        else:
            height = np.interp(along, [0, edge, 1], [travel.tray_height] + [travel.belt_height] * 2)
    high = [max(height[0], start[2]), max(height[-1], goal[2])]
    height = np.maximum(height, np.interp(along, [0, 1], high) if len(along) > 2 else high)
    corners = np.vstack([start, np.column_stack([route, height]), goal])
    return _resample(_rounded(_resample(corners)), FEWEST)


def time_path(points: Array, yaw: tuple[float, float], near: float, arm: Arm) -> JointTable:
    """Fastest smooth joint motion along a path, at rest at both ends.

    Args:
        points: of the TCP in mount, evenly spaced. Shape (n, 3).
        yaw: closing direction in mount at start and goal, rad.
        near: joint 6 at the start is the choice nearest to this, rad.
        arm: drawing and limits.
    """
    s = np.linspace(0.0, 1.0, len(points))
    turn = np.unwrap(np.arctan2(points[:, 1], points[:, 0])) + np.pi / 2
    first, last = _joint_six(turn[0] - yaw[0], turn[-1] - yaw[1], near)
    # Joint 6 turns evenly along the path: it never reverses.
    yaws = turn - (first + (last - first) * s)
    q = ArmKinematics(arm).inverse_down(points, yaws, first)
    share = MARGIN
    for _ in range(ATTEMPTS):
        table = _timed(q, np.array(arm.max_speed), share * np.array(arm.max_acceleration))
        excess = float((np.abs(table.qdd) / arm.max_acceleration).max())
        if excess <= 1.0:
            break
        share /= 1.01 * excess  # the limits hold at grid points alone: give the rest some room
    return table


def _timed(q: Array, speed: Array, acceleration: Array) -> JointTable:
    """Fastest smooth motion through joint positions spaced evenly along a path. Shape (n, 6)."""
    s, ds = np.linspace(0.0, 1.0, len(q), retstep=True)
    dq = np.gradient(q, ds, axis=0, edge_order=2)
    ddq = np.gradient(dq, ds, axis=0, edge_order=2)
    rate2 = fastest(dq, ddq, speed, acceleration, float(ds))
    rate = np.sqrt(rate2)
    t = np.concatenate([[0.0], np.cumsum(2 * ds / np.maximum(rate[:-1] + rate[1:], SLOWEST))])
    times = np.arange(int(np.ceil(t[-1] / STEP)) + 1) * STEP
    # Within a grid cell the acceleration along the path is constant.
    k = np.clip(np.searchsorted(t, times, side="right") - 1, 0, len(t) - 2)
    dt = np.minimum(times - t[k], t[k + 1] - t[k])
    u = (rate2[k + 1] - rate2[k]) / (2 * ds)
    path_s = np.minimum(s[k] + rate[k] * dt + 0.5 * u * dt * dt, 1.0)
    raw = np.column_stack([np.interp(path_s, s, column) for column in q.T])
    window = round(SMOOTHING / STEP)
    padded = np.vstack([np.repeat(q[:1], window, 0), raw, np.repeat(q[-1:], window, 0)])
    total = np.cumsum(np.vstack([np.zeros((1, 6)), padded]), axis=0)
    return JointTable.from_positions((total[window:] - total[:-window]) / window)


def _joint_six(start: float, goal: float, near: float) -> tuple[float, float]:
    """Joint 6 at both ends, give or take half turns: two fingers are alike.

    At the start it is the choice nearest to `near`, at the goal the one with the least turn that
    keeps it within half a turn of zero, so that it never winds up over many picks.
    """
    start -= np.pi * np.round((start - near) / np.pi)
    nearest = goal - np.pi * np.round((goal - start) / np.pi)
    choices = nearest + np.pi * np.array([0.0, 1.0, -1.0, 2.0, -2.0])
    good = choices[np.abs(choices) <= np.pi + 1e-6]
    return start, float(good[np.argmin(np.abs(good - start))])


@numba.njit(cache=True)
def _bounds(dq, ddq, limit, x):
    """Interval of path acceleration that the joints allow at squared path speed x."""
    low, high = -1e12, 1e12
    for i in range(dq.shape[0]):
        a, b = -limit[i] - ddq[i] * x, limit[i] - ddq[i] * x
        if abs(dq[i]) < 1e-9:
            if a > 0.0 or b < 0.0:
                return 1.0, -1.0
            continue
        a, b = a / dq[i], b / dq[i]
        low, high = max(low, min(a, b)), min(high, max(a, b))
    return low, high


@numba.njit(cache=True)
def fastest(dq, ddq, speed, acceleration, ds):
    """Largest squared path speed at each grid point, from rest to rest (Pham & Pham 2018).

    Args:
        dq, ddq: first and second derivative of the joints along the path. Shape (n, 6).
        speed, acceleration: limits of the joints, rad/s, rad/s^2. Shape (6,).
        ds: grid step of the path parameter.
    """
    n = dq.shape[0]
    ceiling = np.zeros(n)  # largest x from which the goal can still be reached at rest
    for k in range(n - 2, -1, -1):
        top = 1e6
        for i in range(dq.shape[1]):
            if abs(dq[k, i]) > 1e-9:
                top = min(top, (speed[i] / dq[k, i]) ** 2)
        low, high = 0.0, top  # the good x form an interval that begins at 0: bisect its end
        for _ in range(50):
            x = 0.5 * (low + high)
            a, b = _bounds(dq[k], ddq[k], acceleration, x)
            a, b = max(a, -x / (2 * ds)), min(b, (ceiling[k + 1] - x) / (2 * ds))
            if a <= b:
                low = x
            else:
                high = x
        ceiling[k] = low
    rate2 = np.zeros(n)
    for k in range(n - 1):
        _, b = _bounds(dq[k], ddq[k], acceleration, rate2[k])
        rate2[k + 1] = max(0.0, min(ceiling[k + 1], rate2[k] + 2 * ds * b))
    return rate2


def _resample(corners: Array, fewest: int = 3) -> Array:
    """Even points along a polyline, at most `GRID` apart. Shape (n, d), n at least `fewest`."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = np.linspace(0.0, length[-1], max(fewest, int(np.ceil(length[-1] / GRID)) + 1))
    return np.column_stack([np.interp(at, length, column) for column in corners.T])


def _rounded(points: Array) -> Array:
    """Corners rounded by two moving averages; the ends, mirrored through themselves, stay."""
    w = min(round(ROUNDING / GRID), len(points) - 1)
    for _ in range(2):
        head, tail = 2 * points[0] - points[w:0:-1], 2 * points[-1] - points[-2 : -w - 2 : -1]
        padded = np.vstack([head, points, tail])
        total = np.cumsum(np.vstack([np.zeros((1, 3)), padded]), axis=0)
        half = w // 2
        centre = np.arange(len(points)) + w
        points = (total[centre + half + 1] - total[centre - half]) / (2 * half + 1)
    return points

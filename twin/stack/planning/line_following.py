"""Following a wall or a rack by a straight line through scan points.

Base frame: x forward, y left. The line is y = a0 + a1 x (Xu et al., Eq. 3), and theta = atan a1 is
the turn that makes the vehicle parallel to it. The source's sign is that of an axis to the right;
in base a positive slope asks for a turn to the left.
"""

from dataclasses import dataclass

import numpy as np

from twin.geometry import Array
from twin.messages import BodyVelocity

MIN_POINTS = 8
MIN_LENGTH = 0.20  # m of line that points must span
TRIM = 3.0  # times the median distance beyond which a point is no part of the line
FLOOR = 0.01  # m: range noise, below which nothing is trimmed
ROUNDS = 5
STEEP = np.pi / 4  # angle from which a line is fitted by distances, not by errors along y
PAIRS = 60  # of points through which a first line is tried: with half of the points on the line,
# the chance that no pair is on it is 0.75^60


@dataclass(frozen=True)
class LineFit:
    """A straight line in base: the points p with normal @ p == distance."""

    angle: float  # of the line to x, rad, within (-pi/2, pi/2]
    distance: float  # from the base's origin along the normal (-sin angle, cos angle), m; left is +
    rms: float  # distance of points from the line, m
    points: int

    @property
    def slope(self) -> float:
        """a1; very large for a line across the vehicle."""
        return float(np.tan(self.angle))

    @property
    def offset(self) -> float:
        """a0, m: where the line crosses y."""
        return self.distance / float(np.cos(self.angle))


def least_squares(points: Array) -> tuple[float, float] | None:
    """Line y = a0 + a1 x of least squared errors along y (Xu et al., Eqs. 3-5).

    The normal equations solved by Cramer's rule, about the points' mean, which loses no digits.

    Args:
        points: x, y. Shape (n, 2).

    Returns:
        a0, a1; None for fewer than two points, or all at one x: such a line has no slope.
    """
    points = _finite(points)
    if len(points) < 2:
        return None
    mean = points.mean(axis=0)
    x, y = (points - mean).T
    spread = float(x @ x)
    if spread <= 1e-12 * (1.0 + float(y @ y)):
        return None
    a1 = float(x @ y) / spread
    return float(mean[1] - a1 * mean[0]), a1


def total_least_squares(points: Array) -> LineFit | None:
    """Line of least squared distances, for lines of any direction. Shape (n, 2).

    None for fewer than two points or points without a direction.
    """
    points = _finite(points)
    if len(points) < 2:
        return None
    mean = points.mean(axis=0)
    x, y = (points - mean).T
    sxx, syy, sxy = float(x @ x), float(y @ y), float(x @ y)
    if np.hypot(sxx - syy, 2 * sxy) <= 1e-9 * (sxx + syy) or sxx + syy == 0:
        return None
    angle = 0.5 * float(np.arctan2(2 * sxy, sxx - syy))  # larger principal axis
    if angle <= -np.pi / 2:
        angle += np.pi
    normal = np.array([-np.sin(angle), np.cos(angle)])
    rms = float(np.sqrt(np.mean(((points - mean) @ normal) ** 2)))
    return LineFit(angle, float(mean @ normal), rms, len(points))


def line_through(points: Array) -> LineFit | None:
    """Line through all points: the source's least squares, or that of distances if it is steep.

    Errors along y serve for a line along the way, as they do in the source; a line across it has no
    slope in y. Shape (n, 2).
    """
    line = total_least_squares(points)
    if line is None or abs(line.angle) > STEEP:
        return line
    points, straight = _finite(points), least_squares(points)
    if straight is None:
        return line
    a0, a1 = straight
    angle = float(np.arctan(a1))
    distance = a0 * float(np.cos(angle))
    off = _off(points, angle, distance)
    return LineFit(angle, distance, float(np.sqrt(np.mean(off**2))), len(points))


def fit_line(points: Array) -> LineFit | None:
    """Line through most of the points: what lies off it is trimmed, round by round.

    It starts from the pair of points to whose line the others are nearest in the median (least
    median of squares, Rousseeuw 1984): a mean of all would be drawn to a niche and stay there.

    Returns None if too few points are left or they span too short a piece. Shape (n, 2).
    """
    points = _finite(points)
    off = _nearest_pair(points) if len(points) >= MIN_POINTS else None
    line = None
    kept = np.zeros(0, dtype=bool)
    for _ in range(ROUNDS):
        if off is None:
            return None
        inside = off <= max(TRIM * float(np.median(off)), FLOOR)
        if np.array_equal(inside, kept):
            break
        kept = inside
        line = line_through(points[kept]) if np.sum(kept) >= MIN_POINTS else None
        off = None if line is None else np.abs(_off(points, line.angle, line.distance))
    if line is None:
        return None
    along = points[kept] @ (np.cos(line.angle), np.sin(line.angle))
    return line if np.ptp(along) >= MIN_LENGTH else None


def _nearest_pair(points: Array) -> Array | None:
    """Distances of points (n, 2) from the line through the best pair of them. Shape (n,)."""
    n, k = len(points), np.arange(1, PAIRS + 1)
    # Multiples of irrational numbers, evenly spread and the same every time.
    i, j = (n * ((k * 0.6180339887) % 1)).astype(int), (n * ((k * 0.4142135624) % 1)).astype(int)
    along = points[j] - points[i]
    length = np.hypot(along[:, 0], along[:, 1])
    good = length > MIN_LENGTH
    if not good.any():
        return None
    i, along = i[good], along[good] / length[good, None]
    rest = points - points[i][:, None]  # (pairs, n, 2)
    off = np.abs(along[:, None, 0] * rest[..., 1] - along[:, None, 1] * rest[..., 0])
    return off[np.argmin(np.median(off, axis=1))]


def _off(points: Array, angle: float, distance: float) -> Array:
    return points @ np.array([-np.sin(angle), np.cos(angle)]) - distance


def steering_angle(line: LineFit) -> float:
    """theta = atan a1, rad: the turn to the left that makes the vehicle parallel to the line."""
    return line.angle


@dataclass(frozen=True)
class LineFollower:
    """Drives along a line on one side at a set distance. Gains not tuned.

    Attributes:
        speed: along the line, m/s.
        distance: wanted of the line, m; positive with the line on the left.
        gain: of the distance, 1/s.
        gain_turn: of the angle, 1/s.
        strafe_speed, turn_rate: most that the correction may use, m/s and rad/s.
        window: x ahead of and behind the base, m, and half-width about `distance`, in which points
            are taken for the line.
    """

    speed: float
    distance: float
    gain: float = 1.0
    gain_turn: float = 1.5
    strafe_speed: float = 0.2
    turn_rate: float = 0.6
    window: tuple[float, float, float] = (2.5, -1.0, 0.4)

    def line(self, p_base: Array) -> LineFit | None:
        """Line among the scan points (n, 2) in base; None if it is not there."""
        points = _finite(p_base)
        ahead, behind, half = self.window
        x, y = points[:, 0], points[:, 1]
        near = (x < ahead) & (x > behind) & (np.abs(y - self.distance) < half)
        return fit_line(points[near])

    def command(self, p_base: Array) -> BodyVelocity | None:
        """Velocity that follows the line; None if no line is seen: the caller decides."""
        line = self.line(p_base)
        if line is None or abs(line.angle) > np.pi / 4:
            return None
        c, s = np.cos(line.angle), np.sin(line.angle)
        across = float(
            np.clip(
                self.gain * (line.distance - self.distance), -self.strafe_speed, self.strafe_speed
            )
        )
        turn = self.gain_turn * steering_angle(line)
        # Along the line and square to it, whichever way the vehicle still points.
        return BodyVelocity(
            float(c * self.speed - s * across),
            float(s * self.speed + c * across),
            float(np.clip(turn, -self.turn_rate, self.turn_rate)),
        )


def _finite(points: Array) -> Array:
    points = np.asarray(points, dtype=float).reshape(-1, 2)
    return points[np.all(np.isfinite(points), axis=1)]

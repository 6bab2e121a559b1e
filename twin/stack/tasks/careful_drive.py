"""Driving without a map: which way is free, by what lidar and depth camera see of it.

The lidar sees a rack's posts and not its shelves, the depth camera sees shelves but only ahead. So
posts as far apart as those of a rack count as a closed front, and what the depth camera has seen is
remembered for a while in the odometry's frame.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from twin.floor_plan import FOOTPRINT, RACK
from twin.floor_sections import RACK_POST
from twin.geometry import Array, rot2

GAP = 0.12  # m between neighbouring end points: another thing begins
POST_SIZE = 0.12  # m: a thing wider than this is no post
PITCH = ((RACK[0] - RACK_POST) / 2, RACK[1] - RACK_POST)  # of a rack's posts along and across, m
PITCH_SLACK = 0.06  # m, by which a measured pitch may differ: range noise on either post
NEAR = 3.0  # m: what is farther does not matter yet


@dataclass(frozen=True)
class CarefulLimits:
    """Guesses, checked on kidnappings of seeds 0-9."""

    speed: float = 0.40  # m/s
    turn_rate: float = 0.8  # rad/s
    margin: float = 0.06  # m kept between the vehicle and anything
    ahead: float = 1.2  # m looked ahead along a way
    remember: float = 12.0  # s that what the depth camera saw is kept
    cell: float = 0.05  # m, grain of that memory


def closed_fronts(points: Array) -> Array:
    """Points along the straight lines between neighbouring posts of a rack, 0.1 m apart.

    Args:
        points: end points of a scan in the order of its beams, in base, m. Shape (n, 2).

    Returns:
        Shape (k, 2).
    """
    if len(points) < 2:
        return np.zeros((0, 2))
    breaks = np.nonzero(np.hypot(*np.diff(points, axis=0).T) > GAP)[0] + 1
    things = [t for t in np.split(points, breaks) if len(t) >= 2]
    posts = [t.mean(axis=0) for t in things if np.hypot(*np.ptp(t, axis=0)) < POST_SIZE]
    fronts = [np.zeros((0, 2))]
    for i, a in enumerate(posts):
        for b in posts[i + 1 :]:
            length = float(np.hypot(*(b - a)))
            if any(abs(length - pitch) < PITCH_SLACK for pitch in PITCH):
                fronts.append(a + np.linspace(0, 1, int(length / 0.1) + 1)[:, None] * (b - a))
    return np.concatenate(fronts)


class DepthMemory:
    """What the depth camera saw lately, in the odometry's frame."""

    def __init__(self, limits: CarefulLimits):
        self._limits = limits
        self._seen: dict[tuple[int, int], float] = {}  # cell and when it was last seen

    def clear(self) -> None:
        self._seen.clear()

    def add(self, now: float, points_base: Array, odometry: Array) -> None:
        """Points (n, 2 or 3) in base, at a pose of the odometry."""
        p = np.asarray(points_base, dtype=float)[:, :2]
        p = p[np.hypot(*p.T) < NEAR] if len(p) else p.reshape(0, 2)
        cells = np.floor((p @ rot2(odometry[2]).T + odometry[:2]) / self._limits.cell)
        for cell in np.unique(cells.astype(int), axis=0):
            self._seen[int(cell[0]), int(cell[1])] = now

    def points(self, now: float, odometry: Array) -> Array:
        """Centres of the cells in base. Shape (n, 2)."""
        oldest = now - self._limits.remember
        self._seen = {cell: t for cell, t in self._seen.items() if t >= oldest}
        if not self._seen:
            return np.zeros((0, 2))
        world = (np.array(list(self._seen)) + 0.5) * self._limits.cell
        p = (world - odometry[:2]) @ rot2(odometry[2])
        return p[np.hypot(*p.T) < NEAR]


def free_length(points: Array, arc: tuple[float, float, float], limits: CarefulLimits):
    """How far the footprint can follow an arc, m, and its room there.

    Args:
        points: obstacles in base, m. Shape (n, 2).
        arc: vx, vy in m/s and omega in rad/s, held.
        limits: margin and how far is looked.

    Returns:
        Length, m (of a turn on the spot: of the swept corner), at most `limits.ahead`; and the
        least distance of anything to the footprint up to there, m, at most 1. Something that is
        within the margin already only counts where it comes nearer.
    """
    return _free_length(
        np.ascontiguousarray(points, dtype=float), arc, FOOTPRINT, limits.margin, limits.ahead
    )


@njit(cache=True)
def _free_length(points, arc, footprint, margin, ahead):
    vx, vy, omega = arc
    corner = 0.5 * np.hypot(footprint[0], footprint[1])
    speed = max(np.hypot(vx, vy), corner * abs(omega), 1e-6)
    step = 0.05
    x, y, yaw = 0.0, 0.0, 0.0
    steps = int(ahead / step + 0.5)
    room, before = 1.0, _room(points, x, y, yaw, footprint)
    for k in range(steps):
        dt = step / speed
        c, s = np.cos(yaw + 0.5 * omega * dt), np.sin(yaw + 0.5 * omega * dt)
        x, y = x + (c * vx - s * vy) * dt, y + (s * vx + c * vy) * dt
        yaw += omega * dt
        here = _room(points, x, y, yaw, footprint)
        if here < margin and here < before + 1e-3:
            return k * step, room
        before = here
        room = min(room, here)
    return ahead, room


@njit(cache=True)
def _room(points, x, y, yaw, footprint):
    """Least distance of a point to the footprint at a pose; 0 inside."""
    least = 1.0
    c, s = np.cos(yaw), np.sin(yaw)
    for i in range(len(points)):
        px, py = points[i, 0] - x, points[i, 1] - y
        ax = max(abs(c * px + s * py) - 0.5 * footprint[0], 0.0)
        ay = max(abs(-s * px + c * py) - 0.5 * footprint[1], 0.0)
        least = min(least, np.hypot(ax, ay))
    return least


def middle(points: Array) -> float:
    """How far to the left the middle between what is on either side lies, m; 0 if one is open."""
    x, y = points[:, 0], points[:, 1]
    beside = np.abs(x) < 0.5 * FOOTPRINT[0] + 0.3
    left, right = y[beside & (y > 0.2)], y[beside & (y < -0.2)]
    if len(left) == 0 or len(right) == 0 or left.min() - right.max() > 2.2:
        return 0.0
    return 0.5 * float(left.min() + right.max())


def best_arc(
    points: Array, limits: CarefulLimits, last_turn: float
) -> tuple[tuple[float, float, float], float]:
    """Forward arc with a long free way and room on both sides, and its free length, m."""
    best, best_score, length = (0.0, 0.0, 0.0), -np.inf, 0.0
    for turn in np.linspace(-limits.turn_rate, limits.turn_rate, 17):
        speed = limits.speed * (1 - 0.5 * abs(turn) / limits.turn_rate)
        arc = (float(speed), 0.0, float(turn))
        free, room = free_length(points, arc, limits)
        score = free + min(room, 0.5) - 0.15 * abs(turn) - 0.1 * abs(turn - last_turn)
        if score > best_score:
            best, best_score, length = arc, score, free
    return best, length

"""Room between the vehicle's rectangle and what stands around it.

Obstacles are capsules: a segment in world, grown by a radius, that may move at a constant velocity;
a point is a segment of no length. An array of them has one row each: `AX, AY, BX, BY` (m, ends of
the segment at time zero), `RADIUS` (m), `VX, VY` (m/s).
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.geometry import Array

AX, AY, BX, BY, RADIUS, VX, VY = range(7)


@dataclass(frozen=True)
class Footprint:
    """Rectangle of the vehicle, centred in its base frame, length along x. Metres."""

    length: float = 0.70
    width: float = 0.50

    def __post_init__(self):
        if not (0 < self.width <= self.length < math.inf):
            raise ValueError(f"footprint: {self.length} x {self.width} m, wanted length >= width")

    @property
    def half(self) -> Array:
        """Half length and half width. Shape (2,)."""
        return np.array([0.5 * self.length, 0.5 * self.width])

    @property
    def inscribed(self) -> float:
        """Radius of the largest circle inside: nearer to an obstacle every heading collides."""
        return 0.5 * self.width

    @property
    def circumscribed(self) -> float:
        """Radius of the circle around it: farther from an obstacle no heading collides."""
        return 0.5 * math.hypot(self.length, self.width)


def points(xy, radius: float = 0.0, velocity=(0.0, 0.0)) -> Array:
    """Obstacles of points (n, 2) in world, m, all moving at one velocity, m/s. Shape (n, 7)."""
    xy = np.asarray(xy, dtype=float).reshape(-1, 2)
    return segments(np.hstack([xy, xy]), radius, velocity)


def segments(ends, radius: float = 0.0, velocity=(0.0, 0.0)) -> Array:
    """Obstacles of segments (n, 4): both ends x, y in world, m. Shape (n, 7)."""
    ends = np.asarray(ends, dtype=float).reshape(-1, 4)
    rest = np.tile([radius, *velocity], (len(ends), 1))
    return np.hstack([ends, rest])


def no_obstacles() -> Array:
    """An empty array of obstacles. Shape (0, 7)."""
    return np.zeros((0, 7))


def standing(obstacles: Array) -> NDArray[np.bool_]:
    """Which obstacles do not move. Shape (n,)."""
    return (obstacles[:, VX] == 0) & (obstacles[:, VY] == 0)


def obstacle_fault(obstacles: Array) -> str | None:
    """Why an array cannot be taken for obstacles, in one line, or None."""
    if not isinstance(obstacles, np.ndarray) or obstacles.ndim != 2 or obstacles.shape[1] != 7:
        return f"obstacles: shape {np.shape(obstacles)}, wanted (n, 7)"
    if not np.all(np.isfinite(obstacles)):
        return "obstacles: a value is not finite"
    if np.any(obstacles[:, RADIUS] < 0):
        return "obstacles: a radius is negative"
    return None


@njit(cache=True)
def clearance(x, y, yaw, half, ax, ay, bx, by):
    """Signed distance from the rectangle at a pose to a segment, and its derivative.

    Apart, it is the distance between their nearest points; overlapping, minus the least shift that
    parts them (separating axes). By the envelope theorem the nearest points may be held fixed in
    the derivative.

    Returns:
        distance (m), its derivative by x, y (1) and by yaw (m/rad).
    """
    hx, hy = half[0], half[1]
    c, s = math.cos(yaw), math.sin(yaw)
    # Ends in base.
    ux, uy = c * (ax - x) + s * (ay - y), -s * (ax - x) + c * (ay - y)
    wx, wy = c * (bx - x) + s * (by - y), -s * (bx - x) + c * (by - y)
    # n points from the rectangle to the obstacle, r is the nearest point on the line along n.
    best = min(ux, wx) - hx
    nx, ny = 1.0, 0.0
    rx, ry = (ux, uy) if ux < wx else (wx, wy)
    gap = -max(ux, wx) - hx
    if gap > best:
        best, nx, ny = gap, -1.0, 0.0
        rx, ry = (ux, uy) if ux > wx else (wx, wy)
    gap = min(uy, wy) - hy
    if gap > best:
        best, nx, ny = gap, 0.0, 1.0
        rx, ry = (ux, uy) if uy < wy else (wx, wy)
    gap = -max(uy, wy) - hy
    if gap > best:
        best, nx, ny = gap, 0.0, -1.0
        rx, ry = (ux, uy) if uy > wy else (wx, wy)
    ex, ey = wx - ux, wy - uy
    length2 = ex * ex + ey * ey
    if length2 > 1e-12:
        length = math.sqrt(length2)
        mx, my = -ey / length, ex / length
        off = mx * ux + my * uy
        if off < 0:
            mx, my, off = -mx, -my, -off
        gap = off - hx * abs(mx) - hy * abs(my)
        if gap > best:
            best, nx, ny = gap, mx, my
            rx, ry = math.copysign(hx, mx), math.copysign(hy, my)
    if best > 1e-9:  # apart: nearest of ends to rectangle and corners to segment
        d2 = 1e300
        for k in range(2):
            qx, qy = (ux, uy) if k == 0 else (wx, wy)
            px, py = min(max(qx, -hx), hx), min(max(qy, -hy), hy)
            near2 = (qx - px) ** 2 + (qy - py) ** 2
            if near2 < d2:
                d2, nx, ny, rx, ry = near2, qx - px, qy - py, px, py
        if length2 > 1e-12:
            for k in range(4):
                px, py = (hx if k < 2 else -hx), (hy if k % 2 == 0 else -hy)
                along = min(max(((px - ux) * ex + (py - uy) * ey) / length2, 0.0), 1.0)
                qx, qy = ux + along * ex, uy + along * ey
                near2 = (qx - px) ** 2 + (qy - py) ** 2
                if near2 < d2:
                    d2, nx, ny, rx, ry = near2, qx - px, qy - py, px, py
        best = math.sqrt(d2)
        nx, ny = nx / best, ny / best
    by_yaw = nx * ry - ny * rx
    return best, -(c * nx - s * ny), -(s * nx + c * ny), by_yaw


@njit(cache=True)
def nearest(x, y, yaw, t, half, obstacles):
    """Least room at a pose and time, and the row of that obstacle (-1 and inf without any)."""
    least, which = math.inf, -1
    reach = math.hypot(half[0], half[1])
    for k in range(obstacles.shape[0]):
        o = obstacles[k]
        sx, sy = o[VX] * t, o[VY] * t
        ax, ay, bx, by = o[AX] + sx, o[AY] + sy, o[BX] + sx, o[BY] + sy
        if to_segment(x, y, ax, ay, bx, by) - reach - o[RADIUS] >= least:
            continue
        d = clearance(x, y, yaw, half, ax, ay, bx, by)[0] - o[RADIUS]
        if d < least:
            least, which = d, k
    return least, which


@njit(cache=True)
def to_segment(x, y, ax, ay, bx, by):
    """Distance of a point from a segment, m."""
    ex, ey = bx - ax, by - ay
    length2 = ex * ex + ey * ey
    along = 0.0
    if length2 > 1e-12:
        along = min(max(((x - ax) * ex + (y - ay) * ey) / length2, 0.0), 1.0)
    return math.hypot(x - ax - along * ex, y - ay - along * ey)


def room(pose, footprint: Footprint, obstacles: Array, t: float = 0.0) -> float:
    """Room around the vehicle at a pose (x, y, yaw) in world, at a time; inf without obstacles."""
    return float(nearest(pose[0], pose[1], pose[2], t, footprint.half, obstacles)[0])


def room_to_turn(pose: Array, footprint: Footprint, obstacles: Array, margin: float = 0.03) -> bool:
    """Whether the vehicle can turn once around on the spot."""
    yaws = pose[2] + np.linspace(0, np.pi, 37)  # a rectangle looks the same turned by half a turn
    return all(room([pose[0], pose[1], a], footprint, obstacles) >= margin for a in yaws)


def room_back(
    pose: Array, footprint: Footprint, obstacles: Array, most: float = 1.0, margin: float = 0.03
) -> float:
    """Metres, up to `most`, that the vehicle can back out straight."""
    step, free = 0.02, 0.0
    back = -np.array([math.cos(pose[2]), math.sin(pose[2])])
    while free < most:
        x, y = pose[:2] + (free + step) * back
        if room([x, y, pose[2]], footprint, obstacles) < margin:
            break
        free += step
    return min(free, most)

"""Whether a band leads over ground that the camera will not have looked at by then.

The lidar misses what is low, and the camera sees the floor only some way ahead. So a vehicle that
goes backwards, sideways or close round a corner may sweep over ground where a low box stands
unseen. The band is driven through in thought: what the camera looks at on the way becomes known.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.geometry import Array
from twin.stack.planning.teb_trajectory import Trajectory

STEP = 0.1  # s between the poses that are looked at


@dataclass(frozen=True)
class SightOptions:
    """Not tuned, but where a reason is given."""

    ahead: float = 0.335  # m of the camera before the vehicle's middle
    # The depth camera looks level: it sees the floor from 1.05 m on, and marks it to 2.5 m.
    near: float = 1.1
    far: float = 2.3
    half_angle: float = math.radians(40.0)  # of 44
    rays: int = 61
    least: int = 4  # cells of unknown ground that count


def first_unknown(
    trajectory: Trajectory,
    phase: float,
    within: float,
    known: NDArray[np.bool_],
    solid: NDArray[np.bool_],
    resolution: float,
    origin: Array,
    half: Array,
    options: SightOptions,
) -> tuple[float, Array | None]:
    """When a band first covers ground that nobody will have looked at, and where that is.

    Args:
        trajectory: the band.
        phase: s from its start on.
        within: s from `phase` on that are looked through.
        known: cells that were looked at, or hold what is drawn or seen. Shape (h, w).
        solid: cells that hide what is behind them. Shape (h, w).
        resolution: edge of a cell, m.
        origin: x, y in world of the outer corner of cell [0, 0], m.
        half: half length and half width of what must not cover it, m. Shape (2,).
        options: what the camera sees.

    Returns:
        Seconds from `phase` on, inf if never; the middle of that ground, x, y in world, or None.
    """
    o = options
    times = np.arange(phase, min(phase + within, trajectory.duration) + STEP, STEP)
    poses = np.array([trajectory.motion(t)[0] for t in times])
    reach = o.ahead + o.far + 0.5
    low = np.maximum(((poses[:, :2].min(axis=0) - reach - origin) / resolution).astype(int), 0)
    high = ((poses[:, :2].max(axis=0) + reach - origin) / resolution).astype(int) + 1
    window = np.s_[low[1] : high[1], low[0] : high[0]]
    k, x, y = _walk(
        poses,
        known[window].copy(),
        np.ascontiguousarray(solid[window]),
        resolution,
        np.asarray(origin, dtype=float) + low * resolution,
        half,
        (o.ahead, o.near, o.far, o.half_angle, o.rays, o.least),
    )
    return (math.inf, None) if k < 0 else (float(times[k] - phase), np.array([x, y]))


@njit(cache=True)
def _walk(poses, known, solid, resolution, origin, half, camera):
    """Index of the first pose on unknown ground and the middle of that; -1 if there is none."""
    ahead, near, far, half_angle, rays, least = camera
    h, w = known.shape
    reach = np.hypot(half[0], half[1])
    for k in range(poses.shape[0]):
        x, y, yaw = poses[k]
        c, s = np.cos(yaw), np.sin(yaw)
        left, below = (x - origin[0]) / resolution, (y - origin[1]) / resolution
        r = reach / resolution
        i0, i1, j0, j1 = int(below - r), int(below + r), int(left - r), int(left + r)
        count, sum_x, sum_y = 0, 0.0, 0.0
        for i in range(max(i0, 0), min(i1 + 1, h)):
            for j in range(max(j0, 0), min(j1 + 1, w)):
                px, py = origin[0] + (j + 0.5) * resolution, origin[1] + (i + 0.5) * resolution
                dx, dy = px - x, py - y
                inside = abs(c * dx + s * dy) <= half[0] and abs(c * dy - s * dx) <= half[1]
                if inside and not known[i, j]:
                    count, sum_x, sum_y = count + 1, sum_x + px, sum_y + py
                    if k == 0:
                        known[i, j] = True  # it stands there
        if k > 0 and count >= least:
            return k, sum_x / count, sum_y / count
        ex, ey = x + ahead * c, y + ahead * s
        for ray in range(rays):
            a = yaw + half_angle * (2.0 * ray / (rays - 1) - 1.0)
            dx, dy = np.cos(a), np.sin(a)
            d = 0.0
            while d < far:
                i = int((ey + d * dy - origin[1]) / resolution)
                j = int((ex + d * dx - origin[0]) / resolution)
                if i < 0 or j < 0 or i >= h or j >= w or solid[i, j]:
                    break
                if d >= near:
                    known[i, j] = True
                d += resolution
    return -1, 0.0, 0.0

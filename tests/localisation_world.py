"""A small warehouse drawn as segments, its map, and drives through it with scans and odometry."""

from itertools import pairwise

import numpy as np
from flat_world import box, scan

from twin.geometry import between2, compose2, rot_z, transform
from twin.stack.estimation.likelihood_field import LikelihoodField
from twin.stack.estimation.motion_models import MotionNoise, omnidirectional

RESOLUTION = 0.05
SIZE = (12.0, 9.0)
MOUNT = transform(rot_z(0.0), (0.300, 0.0, 0.18))
RACKS = [(2.0, 2.0, 5.0, 2.8), (7.0, 2.0, 10.0, 2.8), (2.0, 5.0, 5.0, 5.8), (7.4, 5.0, 9.6, 6.2)]
# What makes the hall differ from its mirror image: a pillar, a cabinet and a niche.
ODD = [(0.0, 7.0, 0.9, 7.6), (10.9, 3.6, 12.0, 4.3), (5.7, 8.3, 6.4, 9.0)]
SEGMENTS = np.concatenate([box(0, 0, *SIZE), *(box(*b) for b in RACKS + ODD)])
LOOP = [(1.0, 1.0), (6.0, 1.0), (6.0, 4.0), (10.3, 4.9), (6.0, 7.2), (1.3, 6.4), (1.0, 1.0)]


def occupied_cells():
    """Cells that a surface passes through, with a margin of unknown outside. Shape (h, w)."""
    shape = (int(SIZE[1] / RESOLUTION) + 20, int(SIZE[0] / RESOLUTION) + 20)
    cells = np.zeros(shape, dtype=bool)
    for a, b in SEGMENTS:
        n = int(np.hypot(*(b - a)) / (0.2 * RESOLUTION)) + 2
        # A surface lies at the edge of a cell; an eps inwards takes the cell behind it.
        p = a + (b - a) * np.linspace(0, 1, n)[:, None] - ORIGIN + 1e-9
        cells[tuple((p[:, ::-1] / RESOLUTION).astype(int).T)] = True
    return cells


ORIGIN = np.array([-0.5 + 0.5 * RESOLUTION, -0.5 + 0.5 * RESOLUTION])


def free_cells():
    """Where the vehicle's centre may be: in the hall, 0.3 m off racks and walls."""
    field = world_field()
    h, w = field.distances.shape
    y, x = np.mgrid[:h, :w] * RESOLUTION + ORIGIN[0] + 0.5 * RESOLUTION
    free = (field.distances > 0.3) & (x > 0) & (x < SIZE[0]) & (y > 0) & (y < SIZE[1])
    for x0, y0, x1, y1 in RACKS + ODD:
        free &= ~((x > x0) & (x < x1) & (y > y0) & (y < y1))
    return free


def world_field():
    return LikelihoodField(occupied_cells(), ORIGIN, RESOLUTION, 1.5)


def scan_at(pose, rng=None, stamp=0.0, noise=0.010):
    """Scan of a vehicle whose base stands at `pose`."""
    return scan(SEGMENTS, compose2(pose, (MOUNT[0, 3], MOUNT[1, 3], 0.0)), rng, stamp, noise)


def drive(corners=LOOP, spacing=0.10, start=0.0):
    """Poses along straight legs, the vehicle turning over the first metre of each. Shape (n, 3)."""
    poses, yaw = [], start
    for a, b in pairwise(corners):
        a, b = np.array(a), np.array(b)
        length = np.hypot(*(b - a))
        heading = np.arctan2(*(b - a)[::-1])
        turn = (heading - yaw + np.pi) % (2 * np.pi) - np.pi
        for s in np.arange(0, length, spacing):
            poses.append((*(a + (b - a) * s / length), yaw + turn * min(s / 1.0, 1.0)))
        yaw = heading
    return np.array(poses)


def odometry_of(poses, rng, noise: MotionNoise | None = None):
    """What noisy odometry makes of a drive, from its own origin. Shape (n, 3)."""
    noise = noise or MotionNoise(0.02, 0.01, 0.02, 0.01, 0.02, 0.01)
    reckoned = [np.zeros(3)]
    for a, b in pairwise(poses):
        z = rng.standard_normal((1, 3))
        reckoned.append(omnidirectional(reckoned[-1][None], between2(a, b), noise, z)[0])
    return np.array(reckoned)

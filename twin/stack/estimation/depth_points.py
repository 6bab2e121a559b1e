"""Depth picture to all points that stand in the vehicle's way, the tops of low things included.

A scan (`depth_to_scan`) keeps the nearest point of each direction. That is the front of a low box;
how far the box reaches behind it matters too once it lies under the picture's lower edge.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.geometry import Array
from twin.stack.config import Camera
from twin.stack.estimation.depth_to_scan import DepthNoise, HeightBand

CELL = 0.025  # m: grain of the points, half a cell of the maps
SUPPORT = 3  # pixels that must agree on a point


class DepthPoints:
    """Finds the points of pictures.

    Args:
        camera: intrinsics and `T_base_camera`, as calibrated.
        reach: m from the vehicle's middle within which points are wanted.
        band: heights that count.
        noise: of the depth.
    """

    def __init__(
        self,
        camera: Camera,
        reach: float,
        band: HeightBand | None = None,
        noise: DepthNoise | None = None,
    ):
        self._band, self._noise = band or HeightBand(), noise or DepthNoise()
        v, u = np.mgrid[: camera.height, : camera.width]
        rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.matrix).T
        # Along each ray a metre of depth moves so far in base.
        rays = rays @ camera.T_base_camera[:3, :3].T
        self._rays = np.ascontiguousarray(rays, dtype=np.float32)
        self._eye = tuple(float(c) for c in camera.T_base_camera[:3, 3])
        self._reach = reach

    def find(self, depth_mm: NDArray[np.uint16]) -> Array:
        """Points x, y in base, m, `CELL` apart at least. Shape (n, 2)."""
        b, n = self._band, self._noise
        limits = (b.low, b.high, n.at_1m, n.max_range, n.sigmas)
        size = int(2 * self._reach / CELL)
        cells = _found(np.ascontiguousarray(depth_mm), self._rays, self._eye, limits, size)
        return (cells + 0.5) * CELL - self._reach


@njit(cache=True)
def _found(depth, rays, eye, limits, size):
    """Cells (i along x, j along y) that enough pixels fall into, in no order. Shape (n, 2)."""
    low, high, at_1m, longest, sigmas = limits
    count = np.zeros((size, size), dtype=np.int32)
    h, w = depth.shape
    half = size * CELL / 2
    for v in range(h):
        for u in range(w):
            d = np.float32(1e-3) * depth[v, u]
            if d == 0 or d > longest:
                continue
            dz = rays[v, u, 2]
            z = eye[2] + d * dz
            # A noisy depth moves a pixel along its ray: one that looks down moves up and down.
            lift = sigmas * at_1m * d * d * max(-dz, np.float32(0.0))
            if z < low + lift or z > high:
                continue
            i = int((eye[0] + d * rays[v, u, 0] + half) / CELL)
            j = int((eye[1] + d * rays[v, u, 1] + half) / CELL)
            if 0 <= i < size and 0 <= j < size:
                count[i, j] += 1
    out = np.empty((size * size, 2))
    n = 0
    for i in range(size):
        for j in range(size):
            if count[i, j] >= SUPPORT:
                out[n, 0], out[n, 1] = i, j
                n += 1
    return out[:n].copy()

"""Distance from any point of the floor to the nearest occupied cell, looked up in a table.

The distance that Xu et al., Eq. 21 take for a beam's end point is computed once for a whole map,
so that weighing a beam costs one look-up.
"""

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.geometry import Array


class LikelihoodField:
    """Exact Euclidean distances between cell centres, up to a limit.

    Args:
        occupied: which cells hold an obstacle, row i along world y, column j along world x.
            Shape (h, w), bool.
        origin: x, y in world of the outer corner of cell [0, 0], m.
        resolution: edge of a cell, m.
        max_distance: larger distances read as this, and so does all that is off the map, m.

    Raises:
        ValueError: for a mask that is not two-dimensional or empty, or figures out of range.
    """

    def __init__(self, occupied: NDArray[np.bool_], origin, resolution: float, max_distance: float):
        occupied = np.asarray(occupied, dtype=bool)
        if occupied.ndim != 2 or occupied.size == 0:
            raise ValueError(f"likelihood field: mask of shape {occupied.shape}, wanted (h, w)")
        if not (np.isfinite(resolution) and resolution > 0 and max_distance > 0):
            raise ValueError(
                f"likelihood field: resolution {resolution} and limit {max_distance} "
                "must be positive"
            )
        self.origin = np.array(origin, dtype=float)[:2]
        self.resolution, self.max_distance = float(resolution), float(max_distance)
        cells = np.full(occupied.shape, np.inf, dtype=np.float32)
        if occupied.any():  # OpenCV gives no defined distance to nothing
            cells = cv2.distanceTransform(
                (~occupied).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE
            )
        distances = np.minimum(cells * np.float32(resolution), np.float32(max_distance))
        self.distances: NDArray[np.float32] = np.ascontiguousarray(distances, dtype=np.float32)

    @classmethod
    def of_segments(
        cls, segments: Array, origin, resolution: float, shape: tuple[int, int], max_distance: float
    ) -> "LikelihoodField":
        """Distances from cell centres to drawn surfaces, which no cell has rounded.

        Args:
            segments: x0, y0, x1, y1 in world, m. Shape (n, 4).
            origin, resolution, max_distance: as of the class.
            shape: rows and columns.
        """
        field = cls(np.zeros(shape, dtype=bool), origin, resolution, max_distance)
        segments = np.ascontiguousarray(segments, dtype=np.float64).reshape(-1, 4)
        x, y = field.origin
        _approach(field.distances, segments, x, y, field.resolution, field.max_distance)
        return field

    def lookup(self, points: Array) -> NDArray[np.float32]:
        """Distances of points in world to the nearest obstacle, m. Shape (n, 2) to (n,).

        A point that is not finite or lies off the map reads `max_distance`.
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        limit = np.float32(self.max_distance)
        x0, y0 = self.origin
        return _lookup(self.distances, points, x0, y0, self.resolution, limit)


@njit(cache=True)
def _lookup(distances, points, x0, y0, resolution, limit):
    h, w = distances.shape
    found = np.empty(len(points), dtype=np.float32)
    for i in range(len(points)):
        column, row = (points[i, 0] - x0) / resolution, (points[i, 1] - y0) / resolution
        # Written so that NaN fails it, and before the conversion, which truncates towards zero.
        inside = column >= 0 and column < w and row >= 0 and row < h
        found[i] = distances[int(row), int(column)] if inside else limit
    return found


@njit(cache=True)
def _approach(distances, segments, x0, y0, resolution, limit):
    """Lower each cell to its distance from the nearest segment."""
    h, w = distances.shape
    for k in range(len(segments)):
        ax, ay, bx, by = segments[k]
        dx, dy = bx - ax, by - ay
        length = dx * dx + dy * dy
        left = max(int((min(ax, bx) - limit - x0) / resolution), 0)
        right = min(int((max(ax, bx) + limit - x0) / resolution) + 1, w)
        bottom = max(int((min(ay, by) - limit - y0) / resolution), 0)
        top = min(int((max(ay, by) + limit - y0) / resolution) + 1, h)
        for i in range(bottom, top):
            for j in range(left, right):
                px, py = x0 + (j + 0.5) * resolution - ax, y0 + (i + 0.5) * resolution - ay
                share = (px * dx + py * dy) / length if length > 0 else 0.0
                share = min(max(share, 0.0), 1.0)
                distance = np.hypot(px - share * dx, py - share * dy)
                distances[i, j] = min(distances[i, j], np.float32(distance))

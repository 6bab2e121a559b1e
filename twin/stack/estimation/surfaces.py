"""Surfaces finer than the cells they lie in: what a scan is matched to.

Each cell remembers the mean of the end points that fell into it; a line through the means around it
gives the surface's place and normal. A cell alone would say no more than its centre, half a cell
beside the surface, the same along a whole wall.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.geometry import Array

APART = 0.12  # m from a surveyed wall within which its own place counts, and not what was measured
AROUND = 3  # cells on either side through whose means a line is laid
STRAIGHT = 0.20  # standard deviation across over along, up to which the means make a line


@dataclass(frozen=True)
class SurfaceField:
    """The nearest surface of every cell.

    Attributes:
        distances: from the cell's centre, up to a limit, m. Shape (h, w), float32.
        nearest: row of `surfaces`, -1 where there is none. Shape (h, w), int32.
        surfaces: x, y of a point and its unit normal in world; a normal of 0 for what has no
            direction, such as a post. Shape (n, 4).
        origin: x, y in world of the outer corner of cell [0, 0], m.
        resolution: edge of a cell, m.
    """

    distances: NDArray[np.float32]
    nearest: NDArray[np.int32]
    surfaces: Array
    origin: Array
    resolution: float


class SurfaceMap:
    """Means of the end points of scans, by cell.

    Args:
        origin, resolution, shape: of the cells, as of the occupancy grid.
        surveyed: walls whose place is known, x0, y0, x1, y1, m. Shape (n, 4).
    """

    def __init__(
        self,
        origin: Array,
        resolution: float,
        shape: tuple[int, int],
        surveyed: Array | None = None,
    ):
        self.origin, self.resolution, self.shape = origin, resolution, shape
        self._sums = np.zeros((*shape, 3))  # x, y, number
        self._walls = _samples(surveyed, resolution) if surveyed is not None else np.zeros((0, 4))

    def clear(self) -> None:
        self._sums[:] = 0.0

    def add(self, points: Array) -> None:
        """End points in world, m. Shape (n, 2)."""
        x0, y0 = self.origin
        _add(self._sums, np.ascontiguousarray(points), x0, y0, self.resolution)

    def field(self, limit: float, standing: NDArray[np.bool_] | None = None) -> SurfaceField:
        """Nearest surfaces up to `limit` metres, of cells that still are `standing`. (h, w)."""
        there = self._sums[:, :, 2] > 0
        if standing is not None:
            there &= standing
        rows, columns = np.nonzero(there)
        found = np.zeros((len(rows), 4))
        if len(rows):
            _lines(self._sums, there, rows, columns, found)
        distances = np.full(self.shape, limit, dtype=np.float32)
        nearest = np.full(self.shape, -1, dtype=np.int32)
        surfaces = np.concatenate([self._walls, found])
        place = (*self.origin, self.resolution)
        _spread(distances, nearest, surfaces, 0, len(self._walls), place, limit)
        if len(self._walls) and len(rows):  # measured again what was surveyed
            keep = distances[rows, columns] > APART
            surfaces = np.concatenate([self._walls, found[keep]])
        _spread(distances, nearest, surfaces, len(self._walls), len(surfaces), place, limit)
        return SurfaceField(distances, nearest, surfaces, self.origin, self.resolution)


def _samples(walls: Array, step: float) -> Array:
    """Points a cell apart along walls, with normals. Shape (n, 4)."""
    rows = [np.zeros((0, 4))]
    for x0, y0, x1, y1 in np.asarray(walls, dtype=float).reshape(-1, 4):
        length = float(np.hypot(x1 - x0, y1 - y0))
        if length > 0:
            t = np.linspace(0.0, 1.0, int(np.ceil(length / step)) + 1)[:, None]
            normal = np.array([-(y1 - y0), x1 - x0]) / length
            points = np.array([x0, y0]) + t * (x1 - x0, y1 - y0)
            rows.append(np.concatenate([points, np.tile(normal, (len(t), 1))], axis=1))
    return np.concatenate(rows)


@njit(cache=True)
def _add(sums, points, x0, y0, resolution):
    h, w, _ = sums.shape
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        column, row = (x - x0) / resolution, (y - y0) / resolution
        if column >= 0 and column < w and row >= 0 and row < h:  # NaN fails it
            cell = sums[int(row), int(column)]
            cell[0] += x
            cell[1] += y
            cell[2] += 1.0


@njit(cache=True)
def _lines(sums, there, rows, columns, found):
    """Foot of each cell's mean on the line through the means around it, and the line's normal."""
    h, w, _ = sums.shape
    for k in range(len(rows)):
        r, c = rows[k], columns[k]
        mx, my = sums[r, c, 0] / sums[r, c, 2], sums[r, c, 1] / sums[r, c, 2]
        found[k, 0], found[k, 1] = mx, my
        n, sx, sy, xx, xy, yy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        cells = 0
        for i in range(max(r - AROUND, 0), min(r + AROUND + 1, h)):
            for j in range(max(c - AROUND, 0), min(c + AROUND + 1, w)):
                if there[i, j]:
                    # Seen often counts more, but a lone cell near the vehicle not for all.
                    weight = min(sums[i, j, 2], 20.0)
                    x, y = sums[i, j, 0] / sums[i, j, 2] - mx, sums[i, j, 1] / sums[i, j, 2] - my
                    n += weight
                    sx += weight * x
                    sy += weight * y
                    xx += weight * x * x
                    xy += weight * x * y
                    yy += weight * y * y
                    cells += 1
        if cells < 4:
            continue
        sx, sy = sx / n, sy / n
        xx, xy, yy = xx / n - sx * sx, xy / n - sx * sy, yy / n - sy * sy
        mean, half = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
        small, large = max(mean - half, 0.0), mean + half
        if small > STRAIGHT**2 * large:
            continue
        angle = 0.5 * np.arctan2(2 * xy, xx - yy) + 0.5 * np.pi  # across the longer axis
        nx, ny = np.cos(angle), np.sin(angle)
        off = nx * sx + ny * sy
        found[k, 0], found[k, 1], found[k, 2], found[k, 3] = mx + off * nx, my + off * ny, nx, ny


@njit(cache=True)
def _spread(distances, nearest, surfaces, first, end, place, limit):
    """Lower the cells around each surface to their distance from it."""
    x0, y0, resolution = place
    h, w = distances.shape
    reach = int(limit / resolution) + 1
    for k in range(first, end):
        x, y = (surfaces[k, 0] - x0) / resolution - 0.5, (surfaces[k, 1] - y0) / resolution - 0.5
        for i in range(max(int(y) - reach, 0), min(int(y) + reach + 1, h)):
            for j in range(max(int(x) - reach, 0), min(int(x) + reach + 1, w)):
                d = np.float32(resolution * np.sqrt((j - x) ** 2 + (i - y) ** 2))
                if d < distances[i, j]:
                    distances[i, j] = d
                    nearest[i, j] = k

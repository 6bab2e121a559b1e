"""Inflated grid: what it costs the vehicle's centre to be in a cell.

Conventions of Nav2's costmap_2d: 0 free, 1-252 falling off exponentially with the distance from the
nearest obstacle, 253 inscribed (nearer than half the vehicle's width: every heading collides), 254
lethal (the obstacle itself), 255 unknown. Row i runs along world y, column j along world x.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.geometry import Array
from twin.stack.planning.clearance import Footprint, no_obstacles, room, segments

FREE, INSCRIBED, LETHAL, UNKNOWN = 0, 253, 254, 255
OCCUPIED_STATE, UNKNOWN_STATE = 100, -1  # in the occupancy states, as in ROS OccupancyGrid


@dataclass(frozen=True)
class Costmap:
    """Costs of the cells.

    Args:
        cells: shape (h, w), uint8.
        resolution: edge of a cell, m.
        origin: x, y in world of the outer corner of cell [0, 0], m.
    """

    cells: NDArray[np.uint8]
    resolution: float
    origin: Array

    def cell(self, xy) -> tuple[int, int] | None:
        """Row and column of a point in world, or None off the map."""
        if not np.all(np.isfinite(xy)):
            return None
        column, row = np.floor((np.asarray(xy[:2]) - self.origin) / self.resolution).astype(int)
        inside = 0 <= row < self.cells.shape[0] and 0 <= column < self.cells.shape[1]
        return (int(row), int(column)) if inside else None

    def centres(self, cells) -> Array:
        """World points at the centres of cells (row, column). Shape (..., 2)."""
        return self.origin + (np.asarray(cells)[..., ::-1] + 0.5) * self.resolution

    def cost(self, xy) -> int:
        """Cost at a point in world; off the map it is unknown."""
        cell = self.cell(xy)
        return UNKNOWN if cell is None else int(self.cells[cell])

    def obstacles(self, xy, reach: float) -> Array:
        """Outlines of the lethal cells within a square of half-width `reach` around a point.

        Runs of cells along x, and along y what is left, become capsules as wide as a cell, so a
        wall is a few rows for the clearance and not hundreds. Corners of cells stand out of them by
        0.2 of a cell.

        Returns:
            Rows as in `clearance`. Shape (n, 7).
        """
        low = np.floor((np.asarray(xy[:2]) - reach - self.origin) / self.resolution).astype(int)
        high = np.ceil((np.asarray(xy[:2]) + reach - self.origin) / self.resolution).astype(int)
        (j0, i0), (j1, i1) = np.maximum(low, 0), np.maximum(high, 0)
        window = np.ascontiguousarray(self.cells[i0:i1, j0:j1] == LETHAL)
        return self._capsules(window, i0, j0)

    def obstacles_along(self, path: Array, reach: float) -> Array:
        """Outlines, as of `obstacles`, of the lethal cells within `reach` of a way (n, 2)."""
        low = np.floor((path.min(axis=0) - reach - self.origin) / self.resolution).astype(int)
        high = np.ceil((path.max(axis=0) + reach - self.origin) / self.resolution).astype(int) + 1
        (j0, i0), (j1, i1) = np.maximum(low, 0), np.maximum(high, 0)
        window = self.cells[i0:i1, j0:j1] == LETHAL
        if not window.any():
            return no_obstacles()
        near = np.zeros(window.shape, dtype=np.uint8)
        points = (path - self.origin) / self.resolution - np.array([j0, i0]) - 0.5
        width = max(round(2 * reach / self.resolution), 1)
        cv2.polylines(near, [np.rint(points).astype(np.int32)], False, 1, width)
        return self._capsules(np.ascontiguousarray(window & (near > 0)), i0, j0)

    def _capsules(self, window: NDArray[np.bool_], i0: int, j0: int) -> Array:
        """Outlines of the solid cells of a window whose first cell is (i0, j0). Shape (n, 7)."""
        if not window.any():
            return no_obstacles()
        runs = _runs(_outline(window))
        ends = self.centres(runs.reshape(-1, 2, 2) + np.array([i0, j0])).reshape(-1, 4)
        return segments(ends, 0.5 * self.resolution)

    def dearer(self, start: Array, end: Array, half: float, cost: int) -> None:
        """Raise to `cost` the passable cells within `half` m of a line between world points."""
        a, b = (
            np.rint((p - self.origin) / self.resolution - 0.5).astype(int) for p in (start, end)
        )
        mask = np.zeros(self.cells.shape, dtype=np.uint8)
        width = max(round(2 * half / self.resolution), 1)
        cv2.line(mask, (int(a[0]), int(a[1])), (int(b[0]), int(b[1])), 1, width)
        self.cells[(mask > 0) & (self.cells < cost)] = cost

    def fits(self, pose: Array, footprint: Footprint, margin: float = 0.0) -> bool:
        """Whether the vehicle's true rectangle at (x, y, yaw) keeps `margin` to lethal cells."""
        near = self.obstacles(pose, footprint.circumscribed + margin + self.resolution)
        return room(pose, footprint, near) >= margin


def inflate(
    states: NDArray[np.integer],
    resolution: float,
    origin,
    footprint: Footprint,
    decay: float = 5.0,
    reach: float = 1.0,
) -> Costmap:
    """Costs of an occupancy grid.

    At a distance d from the nearest occupied cell a cell costs 252 exp(-decay (d - inscribed)), as
    in Nav2's inflation layer. Unknown cells stay unknown unless the vehicle would surely collide
    there.

    Args:
        states: 100 occupied, 0 free, -1 unknown; shape (h, w).
        resolution: edge of a cell, m.
        origin: x, y in world of the outer corner of cell [0, 0], m.
        footprint: of the vehicle.
        decay: `cost_scaling_factor`, 1/m.
        reach: distance from which cells are free of charge, m.

    Raises:
        ValueError: not a map; one line.
    """
    states, origin = np.asarray(states), np.asarray(origin, dtype=float)
    if states.ndim != 2 or states.size == 0 or not np.issubdtype(states.dtype, np.integer):
        raise ValueError(f"costmap: states of shape {states.shape}, wanted integers (h, w)")
    if not (np.isfinite(resolution) and resolution > 0 and np.all(np.isfinite(origin))):
        raise ValueError(f"costmap: resolution {resolution} m and origin {origin} must be finite")
    occupied = states == OCCUPIED_STATE
    if not np.all(occupied | (states == 0) | (states == UNKNOWN_STATE)):
        raise ValueError("costmap: a state is none of 100 (occupied), 0 (free), -1 (unknown)")
    cells = np.zeros(states.shape, dtype=np.uint8)
    if occupied.any():
        distance = resolution * cv2.distanceTransform(
            np.where(occupied, 0, 1).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE
        )
        inscribed = footprint.inscribed
        soft = (INSCRIBED - 1) * np.exp(-decay * (distance - inscribed))
        cells = np.where(distance <= reach, soft.clip(0, INSCRIBED - 1), 0).astype(np.uint8)
        cells[distance <= inscribed] = INSCRIBED
        cells[occupied] = LETHAL
    cells[(states == UNKNOWN_STATE) & (cells < INSCRIBED)] = UNKNOWN
    return Costmap(cells, float(resolution), origin)


@njit(cache=True)
def _outline(solid):
    """Cells with a neighbour, of four, that is not solid; the border counts as not solid."""
    out = np.zeros_like(solid)
    h, w = solid.shape
    for i in range(h):
        for j in range(w):
            if solid[i, j]:
                inner = 0 < i < h - 1 and 0 < j < w - 1
                out[i, j] = not (
                    inner
                    and solid[i - 1, j]
                    and solid[i + 1, j]
                    and solid[i, j - 1]
                    and solid[i, j + 1]
                )
    return out


@njit(cache=True)
def _runs(mask):
    """First and last cell (row, column) of straight runs that cover the mask. Shape (n, 4)."""
    h, w = mask.shape
    left = mask.copy()
    out = np.empty((mask.sum(), 4), dtype=np.int64)
    n = 0
    for shortest in (3, 1):  # long runs along x first, then along y, where a cell alone counts
        for along_x in (True, False):
            if along_x and shortest == 1:
                continue
            lines, length = (h, w) if along_x else (w, h)
            for a in range(lines):
                b = 0
                while b < length:
                    start = b
                    while b < length and (left[a, b] if along_x else left[b, a]):
                        b += 1
                    if b - start >= shortest:
                        for k in range(start, b):
                            if along_x:
                                left[a, k] = False
                            else:
                                left[k, a] = False
                        first = (a, start) if along_x else (start, a)
                        last = (a, b - 1) if along_x else (b - 1, a)
                        out[n, 0], out[n, 1], out[n, 2], out[n, 3] = *first, *last
                        n += 1
                    b = max(b, start + 1)
    return out[:n]

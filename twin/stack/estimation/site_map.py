"""Maps of the drawing: what the lidar sees of it, and where the vehicle cannot go.

Both in cells of the floor, row i along world y and column j along world x, as ROS OccupancyGrid
has them. The lidar sees legs and posts where the vehicle must keep off whole tables and racks.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.floor_plan import Box, machines
from twin.floor_sections import sections
from twin.geometry import Array, rectangle
from twin.stack.estimation.likelihood_field import LikelihoodField
from twin.stack.estimation.map_file import load_map
from twin.stack.estimation.occupancy_grid import FREE, OCCUPIED, UNKNOWN

RESOLUTION = 0.05  # m, edge of a cell
MARGIN = 0.5  # m about the hall: a scan's end points may fall behind a wall
WALL = 0.05  # m of the outer walls that are drawn
ROOM = 0.25  # m from the vehicle's centre to what it would touch: half its width
FINEST, COARSEST = 0.01, 0.20  # m: cells of a map that the vehicle can drive by
MOST_OVER = 2.0  # m by which a map may reach beyond the hall
TOUCH = 1e-6  # m by which a box must reach into a cell to fill it


@dataclass(frozen=True)
class SiteMap:
    """States of the floor's cells.

    Attributes:
        states: `OCCUPIED` (100), `FREE` (0) or `UNKNOWN` (-1). Shape (h, w), int8.
        resolution: edge of a cell, m.
        origin: x, y in world of the outer corner of cell [0, 0], m. Shape (2,).
        surfaces: where the map is drawn and not measured: what a beam can end on, as segments x0,
            y0, x1, y1 in world. Shape (n, 4); empty for a map from a file.
    """

    states: NDArray[np.int8]
    resolution: float
    origin: Array
    surfaces: Array = field(default_factory=lambda: np.zeros((0, 4)))

    @property
    def occupied(self) -> NDArray[np.bool_]:
        """Shape (h, w)."""
        return self.states == OCCUPIED

    @property
    def free(self) -> NDArray[np.bool_]:
        """Shape (h, w)."""
        return self.states == FREE

    def cells(self, points: Array) -> NDArray[np.int64]:
        """Row and column of points in world, which may lie off the map. Shape (..., 2)."""
        return np.floor((np.asarray(points) - self.origin) / self.resolution).astype(int)[..., ::-1]

    def room(self, radius: float) -> NDArray[np.bool_]:
        """Free cells whose centre is farther than `radius` from all others. Shape (h, w)."""
        field = LikelihoodField(~self.free, self.origin, self.resolution, radius + 1.0)
        return self.free & (field.distances > radius)

    def likelihood_field(self, max_distance: float) -> LikelihoodField:
        """Distances to what a beam can end on: to the drawn surfaces, or to occupied cells."""
        if len(self.surfaces) == 0:
            return LikelihoodField(self.occupied, self.origin, self.resolution, max_distance)
        return LikelihoodField.of_segments(
            self.surfaces, self.origin, self.resolution, self.states.shape, max_distance
        )


def lidar_map(site: Any, T_base_lidar: Array, resolution: float = RESOLUTION) -> SiteMap:
    """What a level lidar on the vehicle sees of the drawing `twin.site.Site`.

    Args:
        site: the drawing.
        T_base_lidar: mount; its height decides what is seen. Shape (4, 4).
        resolution: edge of a cell, m.
    """
    boxes = sections(site, float(T_base_lidar[2, 3]))
    drawn = [box for machine in boxes.values() for box in machine]
    surfaces = [(*box[i - 1], *box[i]) for box in [_hall(site), *drawn] for i in range(4)]
    return _draw(site, drawn, resolution, np.array(surfaces))


def floor_map(site: Any, resolution: float = RESOLUTION) -> SiteMap:
    """What stands in the way of the vehicle, whole outlines of the drawing: for planning."""
    boxes = [box for machine in machines(site).values() for box in machine]
    return _draw(site, boxes, resolution)


def load_site_map(path: Path | str, site: Any) -> SiteMap:
    """Map of a ROS map_server file.

    Args:
        path: the header.
        site: the drawing `twin.site.Site`, whose hall the map must be of.

    Raises:
        ValueError: one line, for a file that is missing, truncated, malformed, without room for the
            vehicle or anything that stands there, or of another hall.
    """
    grid = load_map(Path(path))
    states = grid.states()
    if not np.any(states == FREE):
        raise ValueError(f"map {path}: no free cell among {states.shape[0]} x {states.shape[1]}")
    low, high = FINEST, COARSEST
    if not low <= grid.resolution <= high:
        raise ValueError(f"map {path}: resolution {grid.resolution} m, wanted {low} to {high}")
    size = np.array(states.shape[::-1]) * grid.resolution
    for i, (axis, (start, end)) in enumerate((("x", site.hall.x), ("y", site.hall.y))):
        first, last = float(grid.origin[i]), float(grid.origin[i] + size[i])
        over = start - first, last - end
        if min(over) < -grid.resolution or max(over) > MOST_OVER:
            raise ValueError(
                f"map {path}: of another hall: {axis} from {first:.2f} to {last:.2f} m,"
                f" drawn is {start:.2f} to {end:.2f} m"
            )
    read = SiteMap(states, grid.resolution, grid.origin)
    if not read.occupied.any():
        raise ValueError(f"map {path}: nothing stands in it")
    if not read.room(ROOM).any():
        raise ValueError(f"map {path}: no place with {ROOM} m of room for the vehicle")
    return read


def _hall(site: Any) -> Box:
    (x0, x1), (y0, y1) = site.hall.x, site.hall.y
    return rectangle((x0 + x1) / 2, (y0 + y1) / 2, 0.0, x1 - x0, y1 - y0)


def _draw(site: Any, boxes: list[Box], resolution: float, surfaces: Array | None = None) -> SiteMap:
    """Cells that boxes reach into, in a hall whose walls begin at its inner faces."""
    (x0, x1), (y0, y1) = site.hall.x, site.hall.y
    margin = int(np.ceil(MARGIN / resolution))
    origin = np.array([x0, y0]) - margin * resolution
    size = np.ceil((np.array([x1, y1]) - origin) / resolution - 1e-6).astype(int) + margin
    states = np.full((size[1], size[0]), UNKNOWN, dtype=np.int8)
    x, y = (origin[i] + (np.arange(size[i]) + 0.5) * resolution for i in range(2))
    half = 0.5 * resolution

    def between(by: float) -> NDArray[np.bool_]:
        return ((x > x0 - by) & (x < x1 + by)) & ((y > y0 - by) & (y < y1 + by))[:, None]

    states[between(WALL + half - TOUCH)] = OCCUPIED
    states[between(TOUCH - half)] = FREE
    for box in boxes:
        states[_reached(np.array(box), x, y, half)] = OCCUPIED
    return SiteMap(states, resolution, origin, np.zeros((0, 4)) if surfaces is None else surfaces)


def _reached(box: Array, x: Array, y: Array, half: float) -> NDArray[np.bool_]:
    """Cells (centres x (w,), y (h,)) that a rectangle overlaps: separating axes. Shape (h, w)."""
    reached = np.ones((len(y), len(x)), dtype=bool)
    edges = box[1] - box[0], box[3] - box[0]
    for axis in (*(e / np.hypot(*e) for e in edges), np.array([1.0, 0.0]), np.array([0.0, 1.0])):
        along = box @ axis
        centre = x * axis[0] + (y * axis[1])[:, None]
        by = half * float(np.sum(np.abs(axis))) - TOUCH
        reached &= (centre > along.min() - by) & (centre < along.max() + by)
    return reached

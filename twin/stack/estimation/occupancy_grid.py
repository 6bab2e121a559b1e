"""What one sensor says of each cell of the floor, as log-odds of being occupied.

Row i of the arrays runs along world y and column j along world x; `origin` is the outer corner of
cell [0, 0]. A cell of which nothing is known has log-odds 0. Each sensor has its own grid; they
meet in `grid_fusion`.
"""

from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.geometry import Array
from twin.messages import LidarScan
from twin.stack.estimation.scans import scan_fault

FREE, UNKNOWN, OCCUPIED = 0, -1, 100  # values of a cell in `states`, as in ROS OccupancyGrid


@dataclass(frozen=True)
class SensorModel:
    """Log-odds that a sensor adds to a cell, by what a beam did there; guesses, not tuned."""

    hit: float = 0.85  # the beam ended here: probability 0.70
    miss: float = -0.40  # it passed: probability 0.40
    limit: float = 4.0  # of a cell, so that what has moved can be unlearnt: 0.982
    max_range: float = 25.0  # m; what is farther is left out
    seam: float = 0.0  # m before a beam's end that are not called free


@dataclass
class OccupancyGrid:
    """Cells of one sensor.

    Args:
        origin: x, y in world of the outer corner of cell [0, 0], m.
        resolution: edge of a cell, m.
        log_odds: shape (h, w), float32.
        occupied_above: probability from which a cell counts as occupied (ROS map_server).
        free_below: probability below which it counts as free.
    """

    origin: Array
    resolution: float
    log_odds: NDArray[np.float32]
    occupied_above: float = 0.65
    free_below: float = 0.25
    _seen: NDArray[np.int32] = field(init=False, repr=False)  # number of the scan that met a cell
    _scan: int = field(init=False, default=0)

    def __post_init__(self):
        self.origin = np.array(self.origin, dtype=float)
        self.log_odds = np.ascontiguousarray(self.log_odds, dtype=np.float32)
        if self.log_odds.ndim != 2 or self.log_odds.size == 0 or self.origin.shape != (2,):
            raise ValueError(
                f"occupancy grid: cells of shape {self.log_odds.shape} and origin of shape "
                f"{self.origin.shape}, wanted (h, w) and (2,)"
            )
        if not (np.isfinite(self.resolution) and self.resolution > 0):
            raise ValueError(f"occupancy grid: resolution {self.resolution} must be positive")
        self._seen = np.zeros(self.log_odds.shape, dtype=np.int32)

    @classmethod
    def covering(cls, lower, upper, resolution: float) -> "OccupancyGrid":
        """Unknown grid over the rectangle from `lower` to `upper` (x, y in world, m)."""
        size = np.ceil((np.asarray(upper) - np.asarray(lower)) / resolution - 1e-9).astype(int)
        cells = np.zeros((max(size[1], 0), max(size[0], 0)), dtype=np.float32)
        return cls(np.asarray(lower, dtype=float), resolution, cells)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.log_odds.shape[0], self.log_odds.shape[1]

    @property
    def probability(self) -> NDArray[np.floating]:
        """Of being occupied; 0.5 where nothing is known. Shape (h, w)."""
        return 1 / (1 + np.exp(-self.log_odds))

    @property
    def occupied(self) -> NDArray[np.bool_]:
        """Shape (h, w)."""
        return self.log_odds > _logit(self.occupied_above)

    @property
    def free(self) -> NDArray[np.bool_]:
        """Shape (h, w)."""
        return self.log_odds < _logit(self.free_below)

    def states(self) -> NDArray[np.int8]:
        """`OCCUPIED`, `FREE` or `UNKNOWN` of each cell. Shape (h, w)."""
        known = np.where(self.free, FREE, UNKNOWN)
        return np.where(self.occupied, OCCUPIED, known).astype(np.int8)

    def cells(self, points: Array) -> NDArray[np.int64]:
        """Row and column of points in world, which may lie off the grid. Shape (..., 2)."""
        return np.floor((np.asarray(points) - self.origin) / self.resolution).astype(int)[..., ::-1]

    def centres(self, cells: NDArray[np.integer]) -> Array:
        """World points at the centres of cells (row, column). Shape (..., 2)."""
        return self.origin + (np.asarray(cells)[..., ::-1] + 0.5) * self.resolution

    def insert_scan(self, scan: LidarScan, sensor_pose: Array, model: SensorModel) -> str | None:
        """Add a scan: each cell is changed once, and an end point outweighs a passing beam.

        A beam without a return says nothing: in a closed hall it met something that does not
        reflect.

        Args:
            scan: in the sensor's plane.
            sensor_pose: x, y, yaw of the sensor in world.
            model: of the sensor.

        Returns:
            None, or why the scan was dropped; the grid is then unchanged.
        """
        fault = scan_fault(scan)
        if fault is None and not np.all(np.isfinite(sensor_pose)):
            fault = f"scan at {scan.stamp:.3f} s: the sensor's pose is not finite"
        if fault is not None:
            return fault
        self._scan += 1
        x, y = (np.asarray(sensor_pose[:2], dtype=float) - self.origin) / self.resolution
        _insert(
            self.log_odds,
            self._seen,
            self._scan,
            np.ascontiguousarray(scan.ranges, dtype=np.float64),
            float(scan.angle_min + sensor_pose[2]),
            float(scan.angle_increment),
            x,
            y,
            self.resolution,
            min(scan.range_max, model.max_range),
            (model.hit, model.miss, model.limit, model.seam / self.resolution),
        )
        return None


def _logit(probability: float) -> float:
    return float(np.log(probability / (1 - probability)))


@njit(cache=True)
def _insert(log_odds, seen, number, ranges, first, step, x0, y0, resolution, longest, model):
    """Positions in cells; `seen` keeps the number of the scan that last changed a cell."""
    hit, miss, limit, seam = model
    h, w = log_odds.shape
    n = len(ranges)
    dx, dy = np.empty(n), np.empty(n)  # of the whole beam, in cells
    for i in range(n):
        r = ranges[i]
        dx[i] = dy[i] = 0.0
        if r > 0.0 and r <= longest:  # neither NaN nor inf passes
            angle = first + i * step
            dx[i], dy[i] = r * np.cos(angle) / resolution, r * np.sin(angle) / resolution
            x, y = x0 + dx[i], y0 + dy[i]
            if x >= 0 and x < w and y >= 0 and y < h and seen[int(y), int(x)] != number:
                row, column = int(y), int(x)
                seen[row, column] = number
                log_odds[row, column] = min(log_odds[row, column] + hit, limit)
    for i in range(n):
        length = np.sqrt(dx[i] * dx[i] + dy[i] * dy[i])
        if length > seam:
            keep = 1.0 - seam / length
            _clear(log_odds, seen, number, x0, y0, keep * dx[i], keep * dy[i], miss, -limit)


@njit(cache=True)
def _clear(log_odds, seen, number, x0, y0, dx, dy, miss, limit):
    """Lower the cells of a beam from (x0, y0) to (x0 + dx, y0 + dy) but its last one.

    Amanatides & Woo 1987: from cell border to cell border, whichever comes first.
    """
    h, w = log_odds.shape
    enter, leave = 0.0, 1.0  # share of the beam inside the grid (Liang & Barsky 1984)
    for d, p, size in ((dx, x0, float(w)), (dy, y0, float(h))):
        if d == 0.0:
            if p < 0.0 or p >= size:
                return
            continue
        a, b = -p / d, (size - p) / d
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    if enter >= leave:
        return
    # Clamping moves a point by no more than the rounding error of the clipping.
    column = min(max(int(np.floor(x0 + enter * dx)), 0), w - 1)
    row = min(max(int(np.floor(y0 + enter * dy)), 0), h - 1)
    last_column = min(max(int(np.floor(x0 + leave * dx)), 0), w - 1)
    last_row = min(max(int(np.floor(y0 + leave * dy)), 0), h - 1)
    across = 1 if dx > 0 else -1
    up = 1 if dy > 0 else -1
    columns, rows = abs(last_column - column), abs(last_row - row)
    per_column = abs(1.0 / dx) if dx != 0.0 else np.inf
    per_row = abs(1.0 / dy) if dy != 0.0 else np.inf
    to_column = (column + (1 if across > 0 else 0) - x0) / dx if columns > 0 else np.inf
    to_row = (row + (1 if up > 0 else 0) - y0) / dy if rows > 0 else np.inf
    for _ in range(columns + rows):
        if seen[row, column] != number:
            seen[row, column] = number
            log_odds[row, column] = max(log_odds[row, column] + miss, limit)
        if to_column < to_row:
            column += across
            columns -= 1
            to_column = to_column + per_column if columns > 0 else np.inf
        else:
            row += up
            rows -= 1
            to_row = to_row + per_row if rows > 0 else np.inf
    if leave < 1.0 and seen[row, column] != number:  # the beam goes on beyond the grid
        seen[row, column] = number
        log_odds[row, column] = max(log_odds[row, column] + miss, limit)

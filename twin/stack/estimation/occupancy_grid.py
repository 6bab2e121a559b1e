"""What one sensor says of each cell of the floor, as log-odds of being occupied.

Row i of the arrays runs along world y and column j along world x; `origin` is the outer corner of
cell [0, 0]. A cell of which nothing is known has log-odds 0. Each sensor has its own grid; they
meet in `grid_fusion`.
"""

from dataclasses import dataclass

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
    blind: float = 0.0  # m around the sensor that it does not call free: it looks over low things


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

    def insert_scan(
        self,
        scan: LidarScan,
        sensor_pose: Array,
        model: SensorModel,
        clear_to: Array | None = None,
    ) -> str | None:
        """Add a scan: each cell is changed once, and an end point outweighs a passing beam.

        A beam without a return says nothing: in a closed hall it met something that does not
        reflect.

        Args:
            scan: in the sensor's plane.
            sensor_pose: x, y, yaw of the sensor in world.
            model: of the sensor.
            clear_to: how far each beam is known to be free if it did not return, m. Shape (n,).

        Returns:
            None, or why the scan was dropped; the grid is then unchanged.
        """
        if clear_to is None:
            clear_to = np.zeros(np.shape(scan.ranges))
        fault = scan_fault(scan, beams_needed=not np.any(clear_to > 0))
        if fault is None and np.shape(clear_to) != np.shape(scan.ranges):
            fault = f"scan at {scan.stamp:.3f} s: free distances of shape {np.shape(clear_to)}"
        if fault is None and not np.all(np.isfinite(sensor_pose)):
            fault = f"scan at {scan.stamp:.3f} s: the sensor's pose is not finite"
        if fault is not None:
            return fault
        x, y = (np.asarray(sensor_pose[:2], dtype=float) - self.origin) / self.resolution
        _insert(
            self.log_odds,
            np.ascontiguousarray(scan.ranges, dtype=np.float64),
            np.ascontiguousarray(clear_to, dtype=np.float64),
            float(scan.angle_min + sensor_pose[2]),
            float(scan.angle_increment),
            x,
            y,
            self.resolution,
            min(scan.range_max, model.max_range),
            (model.hit, model.miss, model.limit, model.seam, model.blind),
        )
        return None

    def insert_hits(self, points: Array, model: SensorModel) -> None:
        """Raise the cells in which points lie, each once. In world, m, shape (n, 2)."""
        points = np.asarray(points, dtype=float).reshape(-1, 2)
        cells = self.cells(points[np.all(np.isfinite(points), axis=1)])
        inside = np.all((cells >= 0) & (cells < self.shape), axis=1)
        rows, columns = cells[inside].T
        raised = np.minimum(self.log_odds[rows, columns] + model.hit, model.limit)
        self.log_odds[rows, columns] = raised  # cells that come twice get the same value


def _logit(probability: float) -> float:
    return float(np.log(probability / (1 - probability)))


# Half-width in cells by which a cell's centre must lie before a beam's end to be called free.
HALF = 0.5
FINER = 4  # entries of the table of directions to a beam's angle


@njit(cache=True)
def _insert(log_odds, ranges, clear_to, first, step, x0, y0, resolution, longest, model):
    """Positions in cells. End points raise their cells; the beam nearest in angle clears others.

    The inverse sensor model of Thrun et al. 2005, Table 9.2, turned round: cells look for their
    beam, so each is touched once however many beams cross it.
    """
    hit, miss, limit, seam, blind = model
    h, w = log_odds.shape
    n = len(ranges)
    rows, columns = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    before = np.empty(n, dtype=np.float32)
    good = np.zeros(n, dtype=np.bool_)
    far = np.zeros(n)  # up to which a beam's cells are free, in cells
    hits = 0
    low_x, high_x, low_y, high_y = x0, x0, y0, y0
    for i in range(n):
        r = ranges[i]
        good[i] = r > 0.0 and r <= longest  # neither NaN nor inf passes
        r = r if good[i] else min(clear_to[i], longest)
        if r > 0.0:
            angle = first + i * step
            x = x0 + r * np.cos(angle) / resolution
            y = y0 + r * np.sin(angle) / resolution
            far[i] = max((r - seam) / resolution - HALF, 0.0)
            low_x, high_x = min(low_x, x), max(high_x, x)
            low_y, high_y = min(low_y, y), max(high_y, y)
            if good[i] and x >= 0 and x < w and y >= 0 and y < h:
                rows[hits], columns[hits] = int(y), int(x)
                before[hits] = log_odds[int(y), int(x)]
                hits += 1
    near = np.zeros(int(min(2 * np.pi / abs(step) * FINER, 65536)) + 2, dtype=np.float32)
    fine = 2 * np.pi / (len(near) - 1)
    for k in range(len(near)):  # squared distance, in cells, up to which a direction is free
        angle = -np.pi + (k + 0.5) * fine
        turn = (angle - first) * np.sign(step)
        turn -= 2 * np.pi * np.floor(turn / (2 * np.pi) + 0.25 * abs(step) / np.pi)
        i = int(turn / abs(step) + 0.5)
        if i < n:
            near[k] = far[i] ** 2
    left, right = int(min(max(low_x, 0), w)), int(min(max(high_x + 1, 0), w))
    bottom, top = int(min(max(low_y, 0), h)), int(min(max(high_y + 1, 0), h))
    directions = np.empty(max(right - left, 0), dtype=np.int32)
    x_left = np.float32(left + 0.5 - x0)
    for row in range(bottom, top):
        dy = np.float32(row + 0.5 - y0)
        _directions(directions, dy, x_left, np.float32(1 / fine))
        _clear(
            log_odds[row, left:right],
            directions,
            dy * dy,
            x_left,
            near,
            np.float32((blind / resolution) ** 2),
            np.float32(miss),
            np.float32(-limit),
        )
    for i in range(hits):
        log_odds[rows[i], columns[i]] = min(before[i] + hit, limit)


@njit(cache=True, fastmath=True, error_model="numpy")
def _directions(directions, dy, x_left, per_rad):
    """Entry of the table of directions for each cell of a row, by its offset from the sensor.

    Without branches, in single precision and apart from the look-up, so that the compiler takes
    many cells at a time. Arc tangent: a polynomial of seventh degree, off by less than 3e-4 rad.
    """
    half_pi, pi, zero = np.float32(0.5 * np.pi), np.float32(np.pi), np.float32(0.0)
    c1, c2, c3 = np.float32(-0.0464964749), np.float32(0.15931422), np.float32(-0.327622764)
    ay = abs(dy)
    for j in range(len(directions)):
        dx = x_left + np.float32(np.int32(j))
        ax = abs(dx)
        steep = ay > ax
        a = (ax if steep else ay) / ((ay if steep else ax) + np.float32(1e-12))
        s = a * a
        angle = ((c1 * s + c2) * s + c3) * s * a + a
        angle = half_pi - angle if steep else angle
        angle = pi - angle if dx < zero else angle
        angle = -angle if dy < zero else angle
        directions[j] = np.int32((angle + pi) * per_rad)


@njit(cache=True, fastmath=True, error_model="numpy")
def _clear(cells, directions, dy_squared, x_left, near, blind, miss, floor):
    """Lower the cells of a row that lie before the end of the beam in their direction."""
    for j in range(len(cells)):
        dx = x_left + np.float32(np.int32(j))
        old = cells[j]
        lower = old + miss
        lower = lower if lower > floor else floor
        # Unsigned: a signed index would be tested for counting from the end.
        squared = dx * dx + dy_squared
        free = squared < near[np.uint32(directions[j])]
        cells[j] = lower if free & (squared >= blind) else old

"""What stands in the way now: live obstacles on top of the map.

Lidar and depth camera each write into a grid of their own, since neither may clear what it cannot
see: the lidar looks over a low box and through glass. Only where the lidar has once confirmed what
the camera saw may it also take it away. What moves is followed apart (`moving_objects`) and kept
out of the grids.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.floor_plan import FOOTPRINT
from twin.geometry import Array, compose2, rectangle, rot2, wrap_angle
from twin.messages import LidarScan, RgbdFrame
from twin.stack.config import StackConfig
from twin.stack.estimation.depth_points import DepthPoints
from twin.stack.estimation.depth_to_scan import DepthToScan
from twin.stack.estimation.moving_objects import MovingObjects
from twin.stack.estimation.occupancy_grid import OCCUPIED, OccupancyGrid, SensorModel
from twin.stack.estimation.scans import beam_angles, scan_fault


@dataclass(frozen=True)
class LayerOptions:
    """Not tuned, but where a reason is given."""

    lidar_reach: float = 6.0  # m: farther, a degree of error is more than two cells
    depth_reach: float = 2.5  # m
    # Low limits: four scans, 0.4 s, unlearn what has gone.
    lidar: SensorModel = field(default_factory=lambda: SensorModel(limit=2.0, seam=0.05))
    depth_hit: float = 0.85
    depth_miss: float = -0.4
    depth_limit: float = 2.5
    depth_seam: float = 0.15  # m: three sigma of the depth at 2.5 m
    drawn: float = 0.12  # m around what the map shows that belong to it: errors of pose and lidar
    moving: float = 0.20  # m likewise, for what may move
    late: float = 0.5  # s: older readings are left out
    memory: float = 60.0  # s after which ground that was looked at may hold something again
    edge: float = 0.02  # rad of the lidar's view within which a thing may be cut off


class ObstacleLayer:
    """Live obstacles over a map.

    Args:
        config: the stack's belief of the sensors.
        options: of the layer.
    """

    def __init__(self, config: StackConfig, options: LayerOptions | None = None):
        self.options = options or LayerOptions()
        o = self.options
        T = config.T_base_lidar
        self._lidar_in_base = np.array([T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])])
        self._convert = DepthToScan(config.rgbd)
        self._solid = DepthPoints(config.rgbd, o.depth_reach)
        self._depth_model = SensorModel(
            o.depth_hit, o.depth_miss, o.depth_limit, o.depth_reach, o.depth_seam,
            self._convert.blind,
        )  # fmt: skip
        self.moving = MovingObjects()
        self.dropped = 0  # readings that were of no use
        self._newest = {LidarScan: -np.inf, RgbdFrame: -np.inf}

    def set_map(self, states: NDArray[np.int8], resolution: float, origin) -> None:
        """Take a map; what was seen is kept if the map lies where the last one lay.

        Args:
            states: 100 occupied, 0 free, -1 unknown. Shape (h, w).
            resolution: edge of a cell, m.
            origin: x, y in world of the outer corner of cell [0, 0], m.
        """
        old = getattr(self, "lidar", None)
        self._drawn = np.asarray(states)
        distance = resolution * cv2.distanceTransform(
            np.where(self._drawn == OCCUPIED, 0, 1).astype(np.uint8), cv2.DIST_L2, 5
        )
        self._off_map = distance > self.options.drawn
        self._off_map_far = distance > self.options.moving
        same = (
            old is not None
            and old.shape == self._drawn.shape
            and old.resolution == resolution
            and np.allclose(old.origin, origin)
        )
        if same:
            return
        h, w = self._drawn.shape
        blank = np.zeros((h, w), dtype=np.float32)
        self.lidar = OccupancyGrid(np.asarray(origin, dtype=float), resolution, blank)
        self.depth = OccupancyGrid(np.asarray(origin, dtype=float), resolution, blank.copy())
        self._shared = np.zeros((h, w), dtype=bool)
        # When the camera last looked there, or the vehicle last stood there, s.
        self.looked_at = np.full((h, w), -np.inf, dtype=np.float32)

    # --- readings --------------------------------------------------------------------------------

    def hear(self, reading: LidarScan | RgbdFrame, pose: Array | None) -> str | None:
        """Take a reading.

        Args:
            reading: of lidar or depth camera.
            pose: localised x, y, yaw in world at the exposure; None if it is not known.

        Returns:
            None, or why the reading was dropped; nothing is changed then.
        """
        kind = LidarScan if isinstance(reading, LidarScan) else RgbdFrame
        fault = None
        if pose is None or np.shape(pose) != (3,) or not np.all(np.isfinite(pose)):
            fault = "no pose is known at its exposure"
        elif not np.isfinite(reading.stamp):
            fault = "its stamp is not finite"
        elif reading.stamp <= self._newest[kind]:
            fault = "it is no newer than the last one"
        elif reading.stamp < max(self._newest.values()) - self.options.late:
            fault = "it comes too late"
        if fault is None:
            place = np.asarray(pose, dtype=float)
            if isinstance(reading, LidarScan):
                fault = self._hear_lidar(reading, place)
            else:
                fault = self._hear_depth(reading, place)
        if fault is not None:
            self.dropped += 1
            return f"{kind.__name__}: {fault}"
        self._newest[kind] = reading.stamp
        return None

    def _hear_lidar(self, scan: LidarScan, pose: Array) -> str | None:
        fault = scan_fault(scan)
        if fault is not None:
            return fault
        o, ranges = self.options, np.asarray(scan.ranges, dtype=float)
        place = compose2(pose, self._lidar_in_base)
        with np.errstate(invalid="ignore"):
            good = (ranges > 0) & (ranges <= scan.range_max)
            near = good & (ranges <= o.lidar_reach)
        points = self._points(place, beam_angles(scan)[near], ranges[near])
        off = self._mask(self._off_map_far, points)
        low, high = sorted((scan.angle_min, beam_angles(scan)[-1]))
        angles = beam_angles(scan)[near][off]
        at_edge = (angles < low + o.edge) | (angles > high - o.edge)

        def in_view(xy: Array) -> bool:
            direction = wrap_angle(np.arctan2(*(xy - place[:2])[::-1]) - place[2])
            return bool(low < direction < high)

        self.moving.update(scan.stamp, points[off], place[:2], in_view, at_edge)
        moving = self.moving.near_moving(scan.stamp, points, 0.15) & off
        kept = np.where(near, ranges, np.inf)
        kept[np.nonzero(near)[0][moving]] = np.inf
        # What ends beyond the window, or on something that moves, still clears the way there.
        clear = np.where(good & ~np.isfinite(kept), np.minimum(ranges, o.lidar_reach) - 0.1, 0.0)
        fault = self._insert(self.lidar, scan, kept, place, o.lidar, np.maximum(clear, 0.0))
        if fault is None:
            both = self.lidar.occupied & self.depth.occupied
            self._shared |= both
            gone = self._shared & self.lidar.free
            self.depth.log_odds[gone] = 0.0
            self._shared[gone] = False
        return fault

    def _hear_depth(self, frame: RgbdFrame, pose: Array) -> str | None:
        found = self._convert.convert(frame)
        if found is None:
            return self._convert.fault or "it cannot be read"
        scan, place = found.scan, compose2(pose, found.sensor_pose)
        ranges = np.asarray(scan.ranges, dtype=float)
        near = ranges <= self.options.depth_reach
        points = self._points(place, beam_angles(scan)[near], ranges[near])
        moving = self.moving.near_moving(scan.stamp, points, 0.30)
        kept = np.where(near, ranges, np.inf)
        kept[np.nonzero(near)[0][moving]] = np.inf
        clear = np.where(
            near & ~np.isfinite(kept), ranges - 0.3, np.minimum(found.clear_to, ranges - 0.1)
        )
        clear = np.maximum(np.minimum(clear, self.options.depth_reach), 0.0)
        fault = self._insert(self.depth, scan, kept, place, self._depth_model, clear)
        if fault is None:
            self._fill(pose, self._solid.find(frame.depth_mm), scan.stamp)
            ends = self._points(place, beam_angles(scan), np.maximum(clear, 0.0))
            seen = self._filled(np.vstack([place[:2], ends])) & (self.depth.log_odds != 0.0)
            seen |= self._filled(np.array(rectangle(pose[0], pose[1], pose[2], *FOOTPRINT)))
            self.looked_at[seen] = frame.stamp
        return fault

    def _fill(self, pose: Array, points_base: Array, stamp: float) -> None:
        """Raise the cells behind a front that belong to the same thing, such as a low box's top."""
        points = points_base @ rot2(pose[2]).T + pose[:2]
        points = points[~self.moving.near_moving(stamp, points, 0.30)]
        cells = self.depth.cells(points)
        h, w = self.depth.shape
        cells = cells[(cells >= 0).all(axis=1) & (cells[:, 0] < h) & (cells[:, 1] < w)]
        cells = np.unique(cells, axis=0)
        i, j = cells[:, 0], cells[:, 1]
        raised = np.minimum(self.depth.log_odds[i, j] + self.options.depth_hit, 0.85)
        self.depth.log_odds[i, j] = np.maximum(self.depth.log_odds[i, j], raised)

    def _filled(self, outline: Array) -> NDArray[np.bool_]:
        """Cells within an outline in world, (k, 2). Shape (h, w)."""
        cells = (outline - self.lidar.origin) / self.lidar.resolution - 0.5
        mask = np.zeros(self.looked_at.shape, dtype=np.uint8)
        cv2.fillPoly(mask, [np.rint(cells).astype(np.int32)], 1)
        return mask > 0

    @staticmethod
    def _insert(grid: OccupancyGrid, scan: LidarScan, ranges, place, model, clear) -> str | None:
        kept = LidarScan(scan.stamp, scan.angle_min, scan.angle_increment, ranges, scan.range_max)
        return (
            grid.insert_scan(kept, place, model, clear)
            if clear.any()
            else (grid.insert_scan(kept, place, model))
        )

    @staticmethod
    def _points(place: Array, angles: Array, ranges: Array) -> Array:
        """End points in world. Shape (n, 2)."""
        a = angles + place[2]
        return place[:2] + np.column_stack([ranges * np.cos(a), ranges * np.sin(a)])

    def _mask(self, mask: NDArray[np.bool_], points: Array) -> NDArray[np.bool_]:
        """What a mask says at points in world; False off the map. Shape (n,)."""
        cells = self.lidar.cells(points)
        h, w = mask.shape
        inside = (cells >= 0).all(axis=1) & (cells[:, 0] < h) & (cells[:, 1] < w)
        out = np.zeros(len(points), dtype=bool)
        out[inside] = mask[cells[inside, 0], cells[inside, 1]]
        return out

    # --- what there is ---------------------------------------------------------------------------

    @property
    def looked(self) -> NDArray[np.bool_]:
        """Where the camera has looked, or the vehicle stood, not long ago. Shape (h, w)."""
        return self.looked_at > max(self._newest.values()) - self.options.memory

    @property
    def live(self) -> NDArray[np.bool_]:
        """Cells that hold something which the map does not show. Shape (h, w)."""
        return (self.lidar.occupied | self.depth.occupied) & self._off_map

    @property
    def live_by_lidar(self) -> NDArray[np.bool_]:
        """Those of them that the lidar sees. Shape (h, w)."""
        return self.lidar.occupied & self._off_map

    def states(self) -> NDArray[np.int8]:
        """The map with the live obstacles: 100 occupied, 0 free, -1 unknown. Shape (h, w)."""
        out = self._drawn.copy()
        unknown = out < 0
        out[unknown & (self.lidar.free | self.depth.free)] = 0
        out[self.live] = OCCUPIED
        return out

    def forget(self, pose: Array, keep: float) -> None:
        """Forget what was seen, but for what lies within `keep` m: it may be out of sight there."""
        rows, columns = np.indices(self.lidar.shape, sparse=True)
        x = self.lidar.origin[0] + (columns + 0.5) * self.lidar.resolution - pose[0]
        y = self.lidar.origin[1] + (rows + 0.5) * self.lidar.resolution - pose[1]
        far = x * x + y * y > keep * keep
        self.lidar.log_odds[...] = 0.0
        self.depth.log_odds[far] = 0.0
        self._shared[far] = False
        self.looked_at[far] = -np.inf

"""Mapping while driving: fused odometry corrected by the map that it draws.

Xu et al., Eqs. 1-2: the motion model carries the pose on by the odometry's increment with noise u;
the observation model is the scan against the map, with noise v. Li & An 2025, Fig. 8, compare the
path with and without such corrections. Every few decimetres a key frame is kept; where the vehicle
comes back to old key frames, a match against them closes the loop, the pose graph is solved and
the maps are drawn anew. Poses are of the base in world.
"""

from dataclasses import dataclass, field

import numpy as np

from twin.geometry import Array, between2, compose2, rot2, wrap_angle
from twin.messages import LidarScan
from twin.stack.estimation.depth_to_scan import DepthScan
from twin.stack.estimation.occupancy_grid import OccupancyGrid, SensorModel
from twin.stack.estimation.pose_graph import Edge, PoseGraph, edge_error
from twin.stack.estimation.scan_matching import Match, MatchSettings, match_scan
from twin.stack.estimation.scans import beam_points, scan_fault, without_offset
from twin.stack.estimation.surfaces import SurfaceMap


@dataclass(frozen=True)
class SlamSettings:
    """Distances and doubts of the mapper; guesses but where said."""

    key_distance: float = 0.30  # m, and
    key_turn: float = 0.25  # rad between key frames
    # Noise u of the odometry, added to its own covariance: per root metre and root rad.
    drift: tuple[float, float] = (0.02, 0.015)
    min_inliers: float = 0.60  # share of points that must lie on the map for a correction
    start_inliers: float = 0.25  # share that must lie on surveyed walls to put the start right
    gate: float = 16.27  # squared Mahalanobis distance of a correction: chi-square, 3, 99.9 %
    field_limit: float = 0.5  # m, of the distance field
    max_range: float = 25.0  # m of the beams that are matched
    loop_radius: float = 2.0  # m from an old key frame at which a loop is tried
    loop_path: float = 8.0  # m driven in between
    loop_pause: float = 1.5  # m driven between two tries
    loop_neighbours: int = 6  # key frames on either side drawn for a try
    loop_inliers: float = 0.75
    loop_conditioning: float = 0.15  # a bare corridor closes no loop
    # m and rad by which a loop must disagree with the tracked pose for the maps to be bent: within
    # them the scan has already been matched to the old map.
    loop_apart: tuple[float, float] = (0.03, 0.006)
    anchor_inliers: float = 0.30  # share of a key frame's points on surveyed walls that hold it
    anchor_grain: tuple[float, float] = (0.005, 0.001)  # m and rad that such a match may err
    tracking: MatchSettings = field(default_factory=lambda: MatchSettings(window=(0.10, 0.05)))
    closing: MatchSettings = field(
        default_factory=lambda: MatchSettings(window=(0.80, 0.20), step=(0.08, 0.02), sigma=0.15)
    )
    lidar: SensorModel = field(default_factory=SensorModel)
    # hit, max_range: tuned on plant runs, seeds 0-2, for recall; one picture is enough to see by.
    rgbd: SensorModel = field(
        default_factory=lambda: SensorModel(hit=0.85, miss=-0.3, max_range=3.5, blind=1.1)
    )


@dataclass
class KeyFrame:
    """A scan that is kept, and the depth pictures taken until the next."""

    stamp: float
    scan: LidarScan
    points: Array  # (k, 2) in base
    travelled: float  # m of path before it
    depth: list[tuple[DepthScan, Array]] = field(default_factory=list)  # pose in the key frame


class Slam:
    """Builds the maps of lidar and depth camera and the pose in them.

    Args:
        lower, upper: corners of the mapped rectangle in world, m.
        resolution: of the grids, m.
        start: x, y, yaw of the base at the start.
        start_sigma: its standard deviations.
        lidar_in_base: x, y, yaw of the lidar in base.
        settings: of the mapper.
        surveyed: walls whose place in world is known, x0, y0, x1, y1, m. Shape (n, 4). Scans are
            matched to them as to the map, so that it cannot turn or drift away as a whole.
    """

    def __init__(
        self,
        lower,
        upper,
        resolution: float,
        start: Array,
        start_sigma,
        lidar_in_base: Array,
        settings: SlamSettings = SlamSettings(),
        surveyed: Array | None = None,
    ):
        self.settings = settings
        self.lidar = OccupancyGrid.covering(lower, upper, resolution)
        self.rgbd = OccupancyGrid.covering(lower, upper, resolution)
        self.pose = np.array(start, dtype=float)
        self.covariance = np.diag(np.square(np.asarray(start_sigma, dtype=float)))
        self.key_frames: list[KeyFrame] = []
        self.graph = PoseGraph(self.pose, np.asarray(start_sigma, dtype=float))
        self.stamp = -np.inf
        self.matched = self.lost = 0  # scans that corrected the pose, scans that could not
        self.refused = 0  # loops that the path or other loops contradict
        self.ignored = 0  # scans that were broken, late or came twice
        self.fault: str | None = None  # why the last reading was dropped
        self._lidar_in_base = np.array(lidar_in_base, dtype=float)
        self._odometry: Array | None = None  # at the last scan
        self._since_key = np.zeros((3, 3))  # covariance of the way from the last key frame
        self._travelled, self._tried = 0.0, 0.0
        grid = self.lidar
        self._surfaces = SurfaceMap(grid.origin, resolution, grid.shape, surveyed)
        known = surveyed is not None and len(surveyed) > 0
        self._walls = self._surfaces.field(settings.field_limit) if known else None
        self._field = self._walls

    @property
    def path(self) -> list[tuple[float, Array]]:
        """Stamps and poses of the key frames, as believed after all that was seen."""
        poses = self.graph.poses
        return [(frame.stamp, poses[i]) for i, frame in enumerate(self.key_frames)]

    def add_scan(self, scan: LidarScan, odometry: Array) -> bool:
        """Take a scan.

        Args:
            scan: of the lidar.
            odometry: pose that odometry alone gives for the scan's stamp; only its increments
                count, so its frame does not matter.

        Returns:
            False if the scan was dropped; `fault` says why and nothing has changed.
        """
        self.fault = scan_fault(scan)
        if self.fault is None and scan.stamp <= self.stamp:
            self.fault = f"scan at {scan.stamp:.3f} s dropped: the last was at {self.stamp:.3f} s"
        if self.fault is None and not (
            np.shape(odometry) == (3,) and np.all(np.isfinite(odometry))
        ):
            self.fault = f"scan at {scan.stamp:.3f} s dropped: no odometry of its time"
        if self.fault is not None:
            self.ignored += 1
            return False
        odometry = np.array(odometry, dtype=float)
        moved = np.zeros(3) if self._odometry is None else between2(self._odometry, odometry)
        self.stamp, self._odometry = scan.stamp, odometry
        self._predict(moved)
        points = compose_points(self._lidar_in_base, beam_points(scan, self.settings.max_range))
        self._correct(points)
        if self._is_key():
            self._add_key(scan, points)
            if self._close_loop():
                self.redraw()
            self._renew_field()
        return True

    def add_depth(self, depth: DepthScan, odometry: Array) -> bool:
        """Take a depth picture; it is drawn from the last key frame on, and moves with it.

        Args:
            depth: from `DepthToScan`.
            odometry: pose that odometry alone gives for the picture's stamp.

        Returns:
            False before the first key frame, or without a usable odometry.
        """
        if not self.key_frames or self._odometry is None or not np.all(np.isfinite(odometry)):
            return False
        base = compose2(self.pose, between2(self._odometry, np.asarray(odometry, dtype=float)))
        in_key = compose2(between2(self.graph.poses[-1], base), depth.sensor_pose)
        self.key_frames[-1].depth.append((depth, in_key))
        self._draw_depth(depth, compose2(self.graph.poses[-1], in_key))
        return True

    def redraw(self) -> None:
        """Draw both maps anew from the key frames at their present poses."""
        self.lidar.log_odds[:], self.rgbd.log_odds[:] = 0.0, 0.0
        self._surfaces.clear()
        for frame, pose in zip(self.key_frames, self.graph.poses, strict=True):
            sensor = compose2(pose, self._lidar_in_base)
            self.lidar.insert_scan(frame.scan, sensor, self.settings.lidar)
            self._surfaces.add(compose_points(pose, frame.points))
            for depth, in_key in frame.depth:
                self._draw_depth(depth, compose2(pose, in_key))

    def correct_ranges(self, offset: float) -> None:
        """Take a constant error of range, m, off the scans so far, and draw the maps anew."""
        if offset == 0.0 or not self.key_frames:
            return
        for frame in self.key_frames:
            frame.scan = without_offset(frame.scan, offset)
            points = beam_points(frame.scan, self.settings.max_range)
            frame.points = compose_points(self._lidar_in_base, points)
        self.redraw()
        self._renew_field()

    def _draw_depth(self, depth: DepthScan, sensor: Array) -> None:
        model = self.settings.rgbd
        self.rgbd.insert_scan(depth.scan, sensor, model, depth.clear_to)
        self.rgbd.insert_hits(compose_points(sensor, depth.behind), model)

    def _predict(self, moved: Array) -> None:
        """Motion model, Xu et al., Eq. 1; u grows with the root of distance and turn."""
        distance, turn = float(np.hypot(*moved[:2])), abs(float(moved[2]))
        along, yaw = self.settings.drift
        u = np.diag([along**2 * (distance + 0.2 * turn)] * 2 + [yaw**2 * (turn + 0.3 * distance)])
        R, F = np.eye(3), np.eye(3)
        R[:2, :2] = rot2(self.pose[2])
        F[:2, 2] = R[:2, :2] @ (-moved[1], moved[0])
        self.covariance = F @ self.covariance @ F.T + R @ u @ R.T
        self.pose = compose2(self.pose, moved)
        self._travelled += distance
        if self.key_frames:  # the same, in the axes of the last key frame
            _, _, heading = between2(self.graph.poses[-1], self.pose)
            K, G = np.eye(3), np.eye(3)
            K[:2, :2] = rot2(heading)
            G[:2, 2] = K[:2, :2] @ (-moved[1], moved[0])
            self._since_key = G @ self._since_key @ G.T + K @ u @ K.T

    def _correct(self, points: Array) -> None:
        """Observation model, Xu et al., Eq. 2: the pose at which the scan fits the map."""
        if self._field is None:
            return
        s = self.settings
        wanted = s.min_inliers if self.key_frames else s.start_inliers
        match = match_scan(self._field, points, self.pose, s.tracking)
        if match is None or match.inliers < wanted:
            self.lost += 1
            return
        innovation = match.pose - self.pose
        innovation[2] = wrap_angle(innovation[2])
        S = self.covariance + match.covariance
        if innovation @ np.linalg.solve(S, innovation) > s.gate:
            self.lost += 1
            return
        self.matched += 1
        K = self.covariance @ np.linalg.inv(S)
        self.pose = self.pose + K @ innovation
        self.pose[2] = wrap_angle(self.pose[2])
        self.covariance = (np.eye(3) - K) @ self.covariance
        self.covariance = 0.5 * (self.covariance + self.covariance.T)

    def _is_key(self) -> bool:
        if not self.key_frames:
            return True
        x, y, yaw = between2(self.graph.poses[-1], self.pose)
        far = np.hypot(x, y) >= self.settings.key_distance
        return bool(far or abs(yaw) >= self.settings.key_turn)

    def _add_key(self, scan: LidarScan, points: Array) -> None:
        if self.key_frames:
            # The map ties neighbours more firmly than odometry, but never beyond its grain.
            grain = np.diag([0.005**2, 0.005**2, 0.001**2])
            self.graph.append(
                between2(self.graph.poses[-1], self.pose), 0.1 * self._since_key + grain
            )
        self.key_frames.append(KeyFrame(scan.stamp, scan, points, self._travelled))
        self._since_key = np.zeros((3, 3))
        sensor = compose2(self.pose, self._lidar_in_base)
        self.lidar.insert_scan(scan, sensor, self.settings.lidar)
        self._surfaces.add(compose_points(self.pose, points))
        self._anchor(points)

    def _anchor(self, points: Array) -> None:
        """Hold the newest key frame by the surveyed walls that it sees."""
        s = self.settings
        if self._walls is None:
            return
        match = match_scan(self._walls, points, self.pose, s.tracking, search=False)
        if match is None or match.inliers < s.anchor_inliers:
            return
        shift, turn = s.anchor_grain
        grain = np.diag([shift**2, shift**2, turn**2])
        self.graph.anchor(len(self.key_frames) - 1, match.pose, match.covariance + grain)

    def _renew_field(self) -> None:
        self._field = self._surfaces.field(self.settings.field_limit, self.lidar.occupied)

    def _close_loop(self) -> bool:
        """Match the newest key frame with old ones near by; True if the graph was bent."""
        s, here = self.settings, len(self.key_frames) - 1
        if self._travelled - self._tried < s.loop_pause:
            return False
        poses = np.array(self.graph.poses)
        way = np.array([frame.travelled for frame in self.key_frames])
        distance = np.hypot(*(poses[:, :2] - poses[here, :2]).T)
        old = np.nonzero((way[here] - way > s.loop_path) & (distance < s.loop_radius))[0]
        if len(old) == 0:
            return False
        self._tried = self._travelled
        near = int(old[np.argmin(distance[old])])
        match = self._match_old(near, here)
        if match is None or match.inliers < s.loop_inliers:
            return False
        if match.conditioning < s.loop_conditioning:
            return False
        R = np.eye(3)
        R[:2, :2] = rot2(poses[near, 2]).T
        grain = np.diag([0.01**2, 0.01**2, 0.003**2])
        covariance = R @ match.covariance @ R.T + grain
        edge = Edge(near, here, between2(poses[near], match.pose), covariance)
        x, y, yaw = edge_error(edge, self.graph.poses)
        agrees = np.hypot(x, y) < s.loop_apart[0] and abs(yaw) < s.loop_apart[1]
        if not self.graph.close(edge):
            self.refused += 1
            return False
        if agrees:
            return False
        if not self.graph.settle():
            self.refused += 1
            return False
        self.pose = self.graph.poses[here].copy()
        return True

    def _match_old(self, near: int, here: int) -> Match | None:
        """The newest scan against a map of the key frames around an old one alone."""
        s = self.settings
        local = SurfaceMap(self.lidar.origin, self.lidar.resolution, self.lidar.shape)
        for i in range(max(near - s.loop_neighbours, 0), min(near + s.loop_neighbours + 1, here)):
            local.add(compose_points(self.graph.poses[i], self.key_frames[i].points))
        points = self.key_frames[here].points
        return match_scan(local.field(s.field_limit), points, self.graph.poses[here], s.closing)


def compose_points(pose_a_b: Array, p_b: Array) -> Array:
    """Points of frame b in frame a by the planar pose of b in a. Shape (n, 2)."""
    return p_b @ rot2(pose_a_b[2]).T + np.asarray(pose_a_b[:2])

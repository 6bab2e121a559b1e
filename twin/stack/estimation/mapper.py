"""The mapper in the stack: readings in, the maps and the pose in them out.

Frames: *odom* is the frame of the fused odometry, which drifts smoothly; `world_from_odom` is its
planar pose in world, corrected with each scan. Before the depth camera is calibrated its pictures
wait, so that none is drawn by a pose that is about to change.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from twin.floor_plan import machines
from twin.geometry import Array, between2, compose2, rectangle
from twin.messages import LidarScan, RgbdFrame
from twin.site import Site
from twin.stack.config import StackConfig
from twin.stack.estimation.depth_to_scan import DepthNoise, DepthToScan
from twin.stack.estimation.grid_fusion import fuse
from twin.stack.estimation.map_file import save_map
from twin.stack.estimation.occupancy_grid import OccupancyGrid
from twin.stack.estimation.scans import without_offset
from twin.stack.estimation.site_map import SiteMap
from twin.stack.estimation.slam import Slam, SlamSettings
from twin.stack.estimation.vehicle_calibration import Calibration, CalibrationRun

MOST_WAITING = 200  # pictures kept until the camera is calibrated: 40 MB
LATE = 1.0  # s behind the newest scan after which a picture is dropped
MAPS = ("lidar", "rgbd", "fused")


@dataclass(frozen=True)
class MapperSettings:
    resolution: float = 0.05  # m, edge of a cell
    margin: float = 0.50  # m about the drawn hall: end points may fall behind a wall
    surveyed: bool = True  # the drawn walls hold the map in world; False maps from the start alone
    slam: SlamSettings = field(default_factory=SlamSettings)
    # A map may look farther than what stops the vehicle: it averages. Tuned on seeds 0-2.
    depth: DepthNoise = field(
        default_factory=lambda: DepthNoise(max_range=3.5, deep_range=2.5, deep_support=8)
    )


class Mapper:
    """Draws the maps of one run.

    Args:
        config: the drawing: hall, mounts, cameras, doubt about the dock.
        start: x, y, yaw of the base at the start, in world; the dock without it.
        calibration: of the depth camera, from an earlier run; without one it is sought, see
            `calibrate`.
        settings: of the mapper.
    """

    def __init__(
        self,
        config: StackConfig,
        start: Array | None = None,
        calibration: Calibration | None = None,
        settings: MapperSettings = MapperSettings(),
    ):
        self.settings = settings
        self.belief = config  # of the sensors, with the calibration once there is one
        (x0, x1), (y0, y1) = config.site.hall.x, config.site.hall.y
        m = settings.margin
        T = config.T_base_lidar
        self.slam = Slam(
            (x0 - m, y0 - m),
            (x1 + m, y1 + m),
            settings.resolution,
            np.asarray(config.site.dock if start is None else start, dtype=float),
            config.odometry_start_sigma,
            np.array([T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])]),
            settings.slam,
            outer_walls(config.site) if settings.surveyed else None,
        )
        self.world_from_odom = np.zeros(3)  # planar pose of odom in world
        self.calibration = calibration
        self.run = CalibrationRun(config)
        self.fault: str | None = None  # why the last reading was dropped, one line
        self.dropped = 0
        self._converter: DepthToScan | None = None
        self._waiting: list[tuple[RgbdFrame, Array]] = []
        self._last_frame = -np.inf
        if calibration is not None:
            self._use(calibration.applied(config))

    @property
    def covariance(self) -> Array:
        """Of x, y, yaw at the newest scan. Shape (3, 3)."""
        return self.slam.covariance.copy()

    @property
    def calibrated(self) -> bool:
        """Whether the depth camera's pose has been measured."""
        return self.calibration is not None

    # --- readings --------------------------------------------------------------------------------

    def hear(self, reading: LidarScan | RgbdFrame, odometry: Array | None) -> bool:
        """Take a reading.

        Args:
            reading: of lidar or depth camera.
            odometry: x, y, yaw of the base in odom at the reading's exposure; None if unknown.

        Returns:
            False if it was dropped; `fault` says why and nothing has changed.
        """
        self.fault = None
        if odometry is None or not np.all(np.isfinite(odometry)):
            self.fault = (
                f"{_kind(reading)} at {reading.stamp:.3f} s dropped: no odometry of its time"
            )
        elif isinstance(reading, LidarScan):
            self._hear_scan(reading, np.asarray(odometry, dtype=float))
        else:
            self._hear_frame(reading, np.asarray(odometry, dtype=float))
        if self.fault is not None:
            self.dropped += 1
            return False
        return True

    def _hear_scan(self, scan: LidarScan, odometry: Array) -> None:
        offset = self.calibration.lidar_range_offset if self.calibration else 0.0
        if not self.slam.add_scan(without_offset(scan, offset), odometry):
            self.fault = self.slam.fault
            return
        self.world_from_odom = compose2(self.slam.pose, between2(odometry, np.zeros(3)))
        if not self.calibrated:
            self.run.hear(scan, odometry)

    def _hear_frame(self, frame: RgbdFrame, odometry: Array) -> None:
        newest = self.slam.stamp
        if not np.isfinite(frame.stamp):
            self.fault = "depth picture dropped: its stamp is not finite"
        elif frame.stamp <= self._last_frame or frame.stamp < newest - LATE:
            last = max(self._last_frame, newest - LATE)
            self.fault = f"depth picture at {frame.stamp:.3f} s dropped: older than {last:.3f} s"
        elif not np.isfinite(newest):
            self.fault = f"depth picture at {frame.stamp:.3f} s dropped: no scan yet"
        if self.fault is not None:
            return
        if self._converter is None:
            self._last_frame = frame.stamp
            self.run.hear(frame, odometry)
            self._waiting = [*self._waiting[-MOST_WAITING + 1 :], (frame, odometry)]
            return
        depth = self._converter.convert(frame)
        if depth is None:
            self.fault = self._converter.fault
            return
        self._last_frame = frame.stamp
        self.slam.add_depth(depth, odometry)

    # --- calibration -----------------------------------------------------------------------------

    def calibrate(self) -> str | None:
        """Take the depth camera's pose from what was seen so far; the waiting pictures are drawn.

        Returns:
            None, or why it could not be done, in one line; the drawing's pose is then used.
        """
        try:
            self.adopt(self.run.solve())
        except ValueError as error:
            self._use(self.belief)
            return str(error)
        return None

    def adopt(self, calibration: Calibration) -> None:
        """Use a calibration from now on; what the lidar has drawn so far is drawn anew by it."""
        self.calibration = calibration
        self.slam.correct_ranges(calibration.lidar_range_offset)
        self._use(calibration.applied(self.belief))

    def _use(self, config: StackConfig) -> None:
        """Draw by a belief of the camera from now on."""
        self.belief = config
        self._converter = DepthToScan(config.rgbd, noise=self.settings.depth)
        waiting, self._waiting = self._waiting, []
        for frame, odometry in waiting:
            depth = self._converter.convert(frame)
            if depth is not None:
                self.slam.add_depth(depth, odometry)

    # --- maps ------------------------------------------------------------------------------------

    def grids(self) -> dict[str, OccupancyGrid]:
        """`lidar`, `rgbd` and `fused`."""
        lidar, rgbd = self.slam.lidar, self.slam.rgbd
        return {"lidar": lidar, "rgbd": rgbd, "fused": fuse(rgbd, lidar)}

    def site_map(self, fused: bool = True) -> SiteMap:
        """What is known now: of both sensors, or of the lidar alone."""
        grid = self.grids()["fused"] if fused else self.slam.lidar
        return SiteMap(grid.states(), grid.resolution, grid.origin.copy())

    def save(self, folder: Path) -> list[str]:
        """Write `lidar`, `rgbd` and `fused` as .pgm and .yaml; returns the names of the files."""
        for name, grid in self.grids().items():
            save_map(grid, Path(folder) / f"{name}.yaml")
        return [f"{name}.{kind}" for name in MAPS for kind in ("pgm", "yaml")]


def outer_walls(site: Site) -> Array:
    """Faces of the drawn hall and its partitions as segments x0, y0, x1, y1. Shape (n, 4).

    What is built into the hall stands where it was surveyed; machines may have been moved.
    """
    (x0, x1), (y0, y1) = site.hall.x, site.hall.y
    boxes = [rectangle((x0 + x1) / 2, (y0 + y1) / 2, 0.0, x1 - x0, y1 - y0)]
    for name, drawn in machines(site).items():
        boxes += drawn if name.startswith("partition") else []
    return np.array([(*box[i - 1], *box[i]) for box in boxes for i in range(4)])


def _kind(reading: LidarScan | RgbdFrame) -> str:
    return "scan" if isinstance(reading, LidarScan) else "depth picture"

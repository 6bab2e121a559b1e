"""What the vehicle has measured of its own sensors, and the file that keeps it.

A run collects pairs of scan and depth picture while the vehicle turns; the result replaces the
drawing's pose of the depth camera and takes the lidar's constant error off its ranges. Walls and
floor tell the camera's pose against a level frame at the lidar, sloping boards how the lidar hangs
in it.
"""

import json
import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from twin.geometry import Array, between2, inverse, transform, wrap_angle
from twin.messages import LidarScan, RgbdFrame
from twin.stack.config import StackConfig
from twin.stack.estimation.extrinsic_calibration import (
    PlaneObservation,
    calibrate,
    fixed_angles,
    rotation_xyz,
)
from twin.stack.estimation.lidar_stand import BoardObservation, LidarStand, find_stand
from twin.stack.estimation.scans import scan_fault, without_offset
from twin.stack.estimation.wall_pairs import observe_boards, observe_walls, pair

VERSION = 2
RANGE_SIGMA = 0.010  # m, 1 sigma of a unit's constant error: data sheet, 30 mm taken as 3 sigma
ROUNDS = 3  # with a better belief, points find their walls better
SPACING = 0.10  # rad or m that the vehicle moves between two pairs that are used
TOGETHER = 0.06  # s at most between the exposures of a pair
MOST_PAIRS = 120


@dataclass(frozen=True)
class Calibration:
    """Pose of the depth camera in the lidar's frame, and the lidar's error of range.

    The camera's position in the lidar's axes, m, and the angles of Li & An 2025, Eq. 2, rad.
    Standard deviations are what the residuals leave open. Fields are those of the file.
    """

    position: tuple[float, float, float]
    angles: tuple[float, float, float]  # gamma, beta, alpha about the fixed axes x, y, z
    position_sigma: tuple[float, float, float]
    angle_sigma: tuple[float, float, float]
    lidar_stand: tuple[float, float, float]  # m over its drawn height; roll, pitch
    lidar_range_offset: float  # m that the lidar reads too far
    residual_rms: float  # in units of the believed noise
    pairs: int  # of scan and picture
    boards: int  # seen by both; without any the lidar is believed to hang as drawn
    version: int = VERSION

    @property
    def T_lidar_rgbd(self) -> Array:
        """Of the lidar as it hangs. Shape (4, 4)."""
        return transform(rotation_xyz(*self.angles), self.position)

    @property
    def T_level_rgbd(self) -> Array:
        """In a level frame at the lidar's drawn height. Shape (4, 4)."""
        return LidarStand(self.lidar_stand).T_level_lidar @ self.T_lidar_rgbd

    def applied(self, config: StackConfig) -> StackConfig:
        """The belief with the depth camera where it was found."""
        T = config.T_base_lidar @ self.T_level_rgbd
        return replace(config, rgbd=replace(config.rgbd, T_base_camera=T))


def save_calibration(calibration: Calibration, path: Path) -> None:
    """Write the file, complete or not at all."""
    part = path.with_name(path.name + ".part")
    part.write_text(json.dumps(asdict(calibration), indent=2) + "\n", encoding="utf-8")
    part.replace(path)


def load_calibration(path: Path) -> Calibration:
    """Read the file.

    Raises:
        ValueError: one line, for a file that is missing, of another version or malformed.
    """
    path = Path(path)
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"calibration {path}: cannot be read ({error})") from None
    version = tree.get("version") if isinstance(tree, dict) else None
    if version != VERSION:
        raise ValueError(f"calibration {path}: version {version}, known is {VERSION}")
    wanted = {name: 3 for name in ("position", "angles", "position_sigma", "angle_sigma")}
    wanted |= {"lidar_stand": 3, "lidar_range_offset": 0, "residual_rms": 0}
    wanted |= {"pairs": 0, "boards": 0, "version": 0}
    if set(tree) != set(wanted):
        odd = ", ".join(sorted(set(tree) ^ set(wanted)))
        raise ValueError(f"calibration {path}: missing or unknown: {odd}")
    for name, size in wanted.items():
        value = tree[name]
        numbers = value if size and isinstance(value, list) else [value]
        if len(numbers) != max(size, 1) or not all(map(_is_number, numbers)):
            raise ValueError(f"calibration {path}: {name}: wanted {size or 1} finite numbers")
        tree[name] = tuple(float(v) for v in numbers) if size else value
    return Calibration(**tree)


def _is_number(value) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


class CalibrationRun:
    """Collects pairs of readings and solves for the camera's pose.

    Args:
        config: the drawing, which gives the start.
    """

    def __init__(self, config: StackConfig):
        self._config = config
        self._scan: tuple[LidarScan, Array] | None = None
        self._pairs: list[tuple[LidarScan, RgbdFrame, Array]] = []
        self._last: Array | None = None  # odometry at the last pair
        self.turned = 0.0  # rad so far, in either direction
        self._heading: float | None = None

    @property
    def pairs(self) -> int:
        """Pairs that will be used."""
        return len(self._pairs)

    def hear(self, reading: LidarScan | RgbdFrame, odometry: Array) -> None:
        """Take a reading with the odometry's pose (x, y, yaw) at its exposure."""
        odometry = np.array(odometry, dtype=float)
        if odometry.shape != (3,) or not np.all(np.isfinite((*odometry, reading.stamp))):
            return
        if isinstance(reading, LidarScan):
            if scan_fault(reading) is None:
                self._scan = (reading, odometry)
                if self._heading is not None:
                    self.turned += abs(float(wrap_angle(odometry[2] - self._heading)))
                self._heading = float(odometry[2])
            return
        if self._scan is None or abs(reading.stamp - self._scan[0].stamp) > TOGETHER:
            return
        if len(self._pairs) >= MOST_PAIRS or not self._moved(odometry):
            return
        self._last = odometry
        self._pairs.append((self._scan[0], reading, between2(self._scan[1], odometry)))

    def _moved(self, odometry: Array) -> bool:
        if self._last is None:
            return True
        x, y, yaw = between2(self._last, odometry)
        return bool(np.hypot(x, y) + abs(yaw) >= SPACING)

    def solve(self) -> Calibration:
        """Pose of the camera from the pairs so far.

        Raises:
            ValueError: one line, if what was seen does not determine it.
        """
        config = self._config
        T = inverse(config.T_base_lidar) @ config.rgbd.T_base_camera
        removed, found = 0.0, None
        boards: list[BoardObservation] = []
        for _ in range(ROUNDS):
            walls: list[PlaneObservation] = []
            boards.clear()
            for scan, frame, moved in self._pairs:
                scan = without_offset(scan, removed)
                seen = pair(scan, frame, config.rgbd, config.T_base_lidar, T, moved)
                if seen is not None:
                    walls += observe_walls(seen)
                    boards += observe_boards(seen, T)
            found = calibrate(walls, T, range_sigma=RANGE_SIGMA, range_removed=removed)
            T, removed = found.T_lidar_rgbd, found.range_offset
        assert found is not None
        stand = find_stand(boards)
        height, roll, pitch = np.diag(stand.covariance)
        known = np.diag(found.covariance) + np.array([roll, pitch, 0.0, 0.0, 0.0, height])
        sigma = np.sqrt(known).tolist()
        T = inverse(stand.T_level_lidar) @ T
        return Calibration(
            position=tuple(T[:3, 3].tolist()),
            angles=fixed_angles(T[:3, :3]),
            position_sigma=tuple(sigma[3:]),
            angle_sigma=tuple(sigma[:3]),
            lidar_stand=stand.values,
            lidar_range_offset=removed,
            residual_rms=found.rms,
            pairs=self.pairs,
            boards=stand.boards,
        )

"""The stack's belief of vehicle and site: the nominal drawing, passed in, never module constants.

Every number here is the drawing's; the vehicle as built deviates, and the stack does not know how.
Base frame: origin on the floor under the vehicle's centre, x forward, y left, z up.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from twin.geometry import Array, look_at, rot_z, transform
from twin.layout import Options, models_dir
from twin.messages import PartClass
from twin.site import Site
from twin.stack.estimation.beacons.stamps import Counter, HeadParameters, SyncSequence
from twin.stack.estimation.beacons.stamps import Noise as StampNoise


@dataclass(frozen=True)
class Wheels:
    """Mecanum base; `twin.stack.control.mecanum` has the kinematics."""

    radius: float = 0.07593  # effective rolling radius, m: models/agv/README.md, calibration
    half_base: float = 0.230  # axle to centre along x, m
    half_track: float = 0.200  # wheel centre to centre along y, m
    rollers: int = 12  # on each wheel
    gear_ratio: float = 20.0
    counts_per_turn: int = 4 * 500  # quadrature counts a motor turn: 500 lines
    max_wheel_speed: float = 15.7  # rad/s: motor 3000 rpm over the gear


@dataclass(frozen=True)
class DriveLimits:
    speed: float = 0.95  # m/s
    strafe_speed: float = 0.5  # m/s
    turn_rate: float = 1.2  # rad/s
    acceleration: float = 0.8  # m/s^2
    turn_acceleration: float = 2.0  # rad/s^2
    jerk: float = 4.0  # m/s^3: full acceleration within 0.2 s; guess
    turn_jerk: float = 10.0  # rad/s^3: likewise
    # Answer of the wheel loops to a commanded vx, vy, omega: (T s + 1) / (L T s^2 + T s + 1) after
    # a dead time. T follows from their PI gains; L and the dead time were fitted to a drive.
    velocity_lag: tuple[float, float, float] = (0.10, 0.08, 0.03)  # L, s
    lag_washout: float = 0.25  # T, s
    dead_time: float = 0.015  # s


@dataclass(frozen=True)
class Imu:
    """MEMS unit of the ADIS16470 class (Analog Devices, data sheet rev. C, front page and Table 1).

    It delivers mean specific force and mean rate since its last sample (delta velocity and delta
    angle over time). Densities are one-sided: a mean over T has variance density^2 / (2 T).
    """

    gyro_noise: float = 1.4e-4  # rad/s/sqrt(Hz): 0.008 deg/s/sqrt(Hz)
    gyro_bias_start: float = 3.5e-3  # rad/s, 1 sigma from switch-on to switch-on: 0.2 deg/s
    gyro_bias_stability: float = 3.9e-5  # rad/s: 8 deg/h in run
    gyro_scale: float = 1.0e-3  # relative, 1 sigma after factory calibration: guess
    accel_noise: float = 9.8e-4  # m/s^2/sqrt(Hz): 100 micro-g/sqrt(Hz)
    accel_bias_start: float = 0.034  # m/s^2, 1 sigma: 3.5 mg
    accel_bias_stability: float = 1.3e-4  # m/s^2: 13 micro-g in run
    bias_time: float = 100.0  # s, correlation time of the in-run bias: guess


@dataclass(frozen=True)
class Camera:
    """Pinhole camera without distortion; `T_base_camera` in the optical frame."""

    width: int
    height: int
    fovy_deg: float
    T_base_camera: Array

    @property
    def focal(self) -> float:
        """Focal length in pixels, the same along u and v."""
        return 0.5 * self.height / float(np.tan(np.radians(self.fovy_deg) / 2))

    @property
    def matrix(self) -> Array:
        """Intrinsic matrix, principal point at the image centre. Shape (3, 3)."""
        f = self.focal
        return np.array([[f, 0, self.width / 2 - 0.5], [0, f, self.height / 2 - 0.5], [0, 0, 1]])


@dataclass(frozen=True)
class Arm:
    """Six joints, spherical wrist. Lengths of the drawing and the drives' limits.

    Source of the limits: models/arm/README.md.
    """

    shoulder_height: float = 0.160  # mount to shoulder axis
    upper_arm: float = 0.320
    forearm: float = 0.320  # elbow to wrist centre
    flange: float = 0.070  # wrist centre to flange
    tool: float = 0.130  # flange to the point between the fingertips (TCP)
    max_speed: tuple[float, ...] = (3.14,) * 6  # rad/s
    max_acceleration: tuple[float, ...] = (18.0, 13.0, 18.0, 20.0, 20.0, 20.0)  # rad/s^2
    max_jerk: tuple[float, ...] = (500.0, 400.0, 500.0, 500.0, 500.0, 500.0)  # rad/s^3
    max_torque: tuple[float, ...] = (50.0, 50.0, 32.0, 32.0, 32.0, 20.0)  # N m
    lower: tuple[float, ...] = (-3.1, -1.9, -2.75, -3.1, -2.1, -6.2)  # rad
    upper: tuple[float, ...] = (3.1, 1.9, 2.75, 3.1, 2.1, 6.2)


@dataclass(frozen=True)
class Gripper:
    stroke: float = 0.050  # m between the pads
    speed: float = 0.150  # m/s, of the opening
    force: float = 20.0  # N used for grips


@dataclass(frozen=True)
class Tray:
    """Slots on the deck in base coordinates; row-major, x of the columns and y of the rows."""

    columns: tuple[float, ...] = (0.075, 0.015, -0.075, -0.135)
    rows: tuple[float, ...] = (-0.18, -0.12, -0.06, 0.00, 0.06, 0.12, 0.18)
    floor: float = 0.556  # z of the slots' floor, m
    wall: float = 0.006  # height of the walls between slots, m
    pitch: float = 0.060

    def slots(self) -> Array:
        """Centres of the slots' floors. Shape (28, 3)."""
        return np.array([(x, y, self.floor) for x in self.columns for y in self.rows])


@dataclass(frozen=True)
class PartDrawing:
    """What the drawing says of one connector class, lying on the belt in its resting pose.

    The part frame: x along the part's axis (towards the N side; for a tee along its through bore),
    z up, origin at the centroid of the outline seen from above, on the belt.
    """

    length: float  # of the outline along x, m
    width: float  # of the outline along y, m
    height: float  # above the belt, m
    grasp_x: float  # grasp point in the part frame, m
    grasp_y: float
    grasp_z: float  # height of the TCP above the belt, m
    grip_width: float  # between the pads when closed, m
    grip_yaw: float  # closing direction in the part frame, rad
    symmetric: bool  # looks the same turned by half a turn
    mass: float  # kg
    # Convex solids whose union is the part, each by its corners in the part frame, (k, 3), m.
    solids: tuple[Array, ...] = field(default=(), compare=False, repr=False)


@dataclass(frozen=True)
class ParcelDrawing:
    """A carton with a goods code on its lid: models/parcel/README.md.

    Frame: middle of its bottom, x along its length and the code's upper edge, z up.
    """

    length: float = 0.050  # along x, m
    width: float = 0.042  # along y: where the hand grips it
    height: float = 0.040
    grasp_z: float = 0.020  # height of the TCP above the bottom
    mass: float = 0.080  # kg
    code_side: float = 0.041 * 21 / 25  # outer edge of the code, m
    code_modules: int = 21  # along an edge


@dataclass(frozen=True)
class BeaconHead:
    """Scanning head of the photoelectric network: models/beacon/README.md.

    A `beacon_calibrate` run replaces planes and mount by what it measured.
    """

    planes: HeadParameters = field(default_factory=HeadParameters)
    T_base_head: Array = field(  # T0 stands behind the head: there is its x axis
        default_factory=lambda: transform(rot_z(np.pi), (0.318, -0.218, 0.92))
    )
    # Of planes (rad) and mount (shift in base, m, turn in head, rad): what calibration left open.
    covariance: Array = field(default_factory=lambda: np.zeros((9, 9)))
    sequence: SyncSequence = field(default_factory=SyncSequence)
    counter: Counter = field(default_factory=Counter)
    noise: StampNoise = field(default_factory=lambda: StampNoise(crossing=0.387e-6))


@dataclass(frozen=True)
class StackConfig:
    """Everything the stack believes before its first reading."""

    site: Site
    options: Options
    wheels: Wheels = Wheels()
    drive: DriveLimits = DriveLimits()
    imu: Imu = Imu()
    arm: Arm = Arm()
    gripper: Gripper = Gripper()
    tray: Tray = Tray()
    arm_model: Path = field(default_factory=lambda: models_dir() / "arm" / "arm.xml")
    T_base_arm: tuple[Array, ...] = field(default_factory=lambda: arm_mounts())
    T_base_lidar: Array = field(default_factory=lambda: transform(np.eye(3), (0.300, 0.0, 0.18)))
    camera: Camera = field(
        default_factory=lambda: Camera(
            640, 480, 60.0, look_at((0.335, 0.235, 0.97), (0.52, 0.44, 0.70))
        )
    )
    rgbd: Camera = field(
        default_factory=lambda: Camera(
            424, 240, 58.0, look_at((0.335, 0.0, 0.62), (1.335, 0.0, 0.62))
        )
    )
    tag_camera: Camera = field(  # looks straight down through a well; image up is forward
        default_factory=lambda: Camera(
            320, 240, 40.0, look_at((0.0, 0.0, 0.30), (0.0, 0.0, 0.0), up=(1.0, 0.0, 0.0))
        )
    )
    tag_side: float = 0.100  # outer edge of a floor tag's code, quiet zone left out, m
    parts: dict[PartClass, PartDrawing] = field(default_factory=dict)
    parcel: ParcelDrawing = ParcelDrawing()
    beacons: BeaconHead = field(default_factory=BeaconHead)
    stand_height: float = 0.70  # of the goods-in stand's face and of a rack's upper deck, m
    # Where a parcel lies at goods-in, and where it is set down on a rack: in base when the vehicle
    # stands there. In the middle of the front arm's reach to the left.
    parcel_place: tuple[float, float, float] = (0.12, 0.45, 0.0)
    line_hood: float = 0.30  # m from the belt's upstream end to the front of the feeder's hood
    odometry_start_sigma: tuple[float, float, float] = (0.006, 0.006, 0.003)  # of the dock
    # Base x along the belt within which each arm meets parts, m.
    pick_windows: tuple[tuple[float, float], ...] = ((0.03, 0.22), (-0.50, -0.10))
    # TCP of each arm folded for driving, in its mount frame, m: clear of mast and tray.
    stow: tuple[tuple[float, float, float], ...] = ((-0.213, 0.149, 0.160), (-0.200, -0.035, 0.160))
    midplane: float = -0.030  # x in base that no arm crosses while both work, m


def arm_mounts() -> tuple[Array, ...]:
    """`T_base_arm` of front and rear arm: upright on the deck, facing the belt (left)."""
    yaw = rot_z(np.pi / 2)
    return (transform(yaw, (0.21, 0.03, 0.55)), transform(yaw, (-0.27, 0.03, 0.55)))


def nominal_config(site: Site, options: Options) -> StackConfig:
    """The nominal drawing, with the part catalogue."""
    from twin.stack.detection.catalogue import CATALOGUE

    return StackConfig(site=site, options=options, parts=CATALOGUE)

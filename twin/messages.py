"""Every word that plant and stack share: readings going up, commands going down.

All are frozen dataclasses. `stamp` is the time of exposure or sampling in seconds of the run's
clock; a reading arrives later than its stamp, by the sensor's latency. Units are SI. Wheels stand
in the order front-left, front-right, rear-left, rear-right. Arms are numbered 0 (front) and 1
(rear).
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

PartClass = Literal["sma_f_n_m", "sma_m_n_m", "tnc_m_sma_f", "n_tee_m_mm", "n_tee_fff"]
PART_CLASSES: tuple[PartClass, ...] = (
    "sma_f_n_m",  # SMA female to N male
    "sma_m_n_m",  # SMA male to N male
    "tnc_m_sma_f",  # TNC male to SMA female
    "n_tee_m_mm",  # N tee, male with two males
    "n_tee_fff",  # N tee, three females
)


# --- readings -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class EncoderCounts:
    """Hardware quadrature counters of the four wheels, four counts a line, wrapping at 16 bit."""

    stamp: float
    ticks: NDArray[np.uint16]  # (4,)


@dataclass(frozen=True)
class WheelState:
    """What the control unit tells the stack: unwrapped counts, wheel speed, body velocity."""

    stamp: float
    ticks: NDArray[np.int64]  # (4,) counts since the unit was switched on
    wheel_speed: Float  # (4,) rad/s
    body_velocity: Float  # (3,) vx, vy, omega in base, from the counts


@dataclass(frozen=True)
class ImuReading:
    """Specific force and rate of turn in the base frame's axes."""

    stamp: float
    accel: Float  # (3,) m/s^2, gravity included
    gyro: Float  # (3,) rad/s


@dataclass(frozen=True)
class LidarScan:
    """One turn of the 2D lidar. A beam without a return reads inf."""

    stamp: float
    angle_min: float
    angle_increment: float
    ranges: Float  # (n,) m
    range_max: float


@dataclass(frozen=True)
class RgbdFrame:
    """Front depth camera: colour and depth along the optical axis, registered; 0 = no return."""

    stamp: float
    rgb: NDArray[np.uint8]  # (h, w, 3)
    depth_mm: NDArray[np.uint16]  # (h, w)


@dataclass(frozen=True)
class CameraFrame:
    """Industrial camera on the mast."""

    stamp: float
    image: NDArray[np.uint8]  # (h, w, 3) RGB


@dataclass(frozen=True)
class FloorFrame:
    """Camera in the vehicle's floor that looks for tags."""

    stamp: float
    image: NDArray[np.uint8]  # (h, w) grey


@dataclass(frozen=True)
class BeaconStamps:
    """Raw counts of the photoelectric network over a turn of the head, by each node's own clock.

    `stamp` is when plane 1 passed the reference sensor T0 and so ended the turn. Channel 0 is T0,
    channel i + 1 is nodes[i]. Kinds: 0 synchronising light, 1 and 2 the head's planes.
    """

    stamp: float
    nodes: tuple[str, ...]
    channel: NDArray[np.int64]  # (n,)
    kind: NDArray[np.int64]  # (n,)
    ticks: NDArray[np.int64]  # (n,) each channel in the order of events; the counter wraps


@dataclass(frozen=True)
class ArmReading:
    """Joint encoders of one arm."""

    stamp: float
    arm: int
    position: Float  # (6,) rad
    velocity: Float  # (6,) rad/s


@dataclass(frozen=True)
class GripperReading:
    """Opening between the pads and the closing force measured in the drive."""

    stamp: float
    arm: int
    width: float  # m
    force: float  # N, each finger


@dataclass(frozen=True)
class Order:
    """What is wanted: number of parts of each class."""

    stamp: float
    items: tuple[tuple[PartClass, int], ...]


@dataclass(frozen=True)
class Goal:
    """A pose to drive to, under a name for the report."""

    name: str
    pose: tuple[float, float, float]  # x, y, yaw in world


@dataclass(frozen=True)
class DriveOrder:
    """Drive to one goal after the other; one that cannot be reached is given up."""

    stamp: float
    goals: tuple[Goal, ...]


@dataclass(frozen=True)
class CourseOrder:
    """Drive straight from pose to pose, on the spot and sideways too, without looking for a way."""

    stamp: float
    route: tuple[tuple[float, float, float], ...]  # x, y, yaw in world


@dataclass(frozen=True)
class MapOrder:
    """Draw a map while driving to one goal after the other; there is none to drive by yet."""

    stamp: float
    goals: tuple[Goal, ...]


@dataclass(frozen=True)
class ParkOrder:
    """Drive straight from pose to pose; stand still at each, to a millimetre."""

    stamp: float
    poses: tuple[tuple[float, float, float], ...]  # x, y, yaw in world


@dataclass(frozen=True)
class BeaconOrder:
    """Calibrate the photoelectric network's head: straight from stop to stop, measuring at each."""

    stamp: float
    stops: tuple[tuple[float, float, float], ...]  # x, y, yaw in world
    dwell: float  # s at each stop


@dataclass(frozen=True)
class TransportOrder:
    """Fetch what lies at goods-in and bring it to the rack that its code names."""

    stamp: float


AnyOrder = Order | DriveOrder | CourseOrder | MapOrder | TransportOrder | ParkOrder | BeaconOrder

Reading = (
    WheelState
    | ImuReading
    | LidarScan
    | RgbdFrame
    | CameraFrame
    | FloorFrame
    | BeaconStamps
    | ArmReading
    | GripperReading
    | AnyOrder
)


# --- commands -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class BodyVelocity:
    """Velocity of the base in base axes; to the control unit."""

    vx: float = 0.0
    vy: float = 0.0
    omega: float = 0.0

    def as_array(self) -> Float:
        return np.array([self.vx, self.vy, self.omega])


@dataclass(frozen=True)
class ArmCommand:
    """Set-points of one arm's joint drives; the drive adds the torque to its own PD law."""

    arm: int
    position: Float  # (6,) rad
    velocity: Float  # (6,) rad/s
    torque: Float  # (6,) N m, feed-forward


@dataclass(frozen=True)
class GripperCommand:
    """Wanted opening between the pads, and the force at which the fingers give way."""

    arm: int
    width: float  # m
    force: float  # N


@dataclass(frozen=True)
class Commands:
    """All that the stack says in one tick of 10 ms. A device that is not named keeps its last."""

    body_velocity: BodyVelocity = BodyVelocity()
    arms: tuple[ArmCommand, ...] = ()
    grippers: tuple[GripperCommand, ...] = ()
    mast_camera: bool = False  # whether the mast camera is to take pictures


# --- what the stack believes, for recording and evaluation only ----------------------------------


@dataclass(frozen=True)
class Detection:
    """One part seen in one camera frame."""

    part_class: PartClass
    confidence: float
    p_base: Float  # (3,) centroid of the part, base frame at exposure
    yaw: float  # of the part's axis in base, rad
    contour_px: Float  # (k, 2) u, v
    centroid_px: Float  # (2,)
    symmetric: bool  # axis known only up to half a turn


@dataclass(frozen=True)
class TrackedPart:
    """A part followed over frames, in the odometry frame of the fused estimate."""

    track_id: int
    part_class: PartClass
    confidence: float
    p_odom: Float  # (3,)
    velocity_in_odom: Float  # (3,)
    yaw: float  # in odom, rad
    hits: int


@dataclass(frozen=True)
class TagSight:
    """A floor tag that was read, and what became of it."""

    stamp: float  # of exposure
    tag: str
    action: str  # reset, fused or refused
    pose: Float  # (3,) x, y, yaw of the vehicle in world at the exposure, as believed afterwards
    next_nodes: tuple[str, ...] = ()  # its route hint: tags that can be driven to from it


@dataclass(frozen=True)
class BeaconSight:
    """A turn of the photoelectric network's head, and what came of it."""

    stamp: float  # middle of the turn, s
    reason: str  # fused, refused by the estimate, or why there is no pose
    pose: Float | None = None  # (7,) x, y, z, qw, qx, qy, qz of the vehicle in world
    covariance: Float | None = None  # (6, 6) shift in world axes, turn in base axes
    rejected: tuple[tuple[str, int], ...] = ()  # (node, plane) that contradicted the others
    rays: tuple[str, ...] = ()  # nodes in the fix


@dataclass(frozen=True)
class NavigationState:
    """What the navigator is about."""

    goal: str = ""  # name of the goal under way
    outcomes: tuple[tuple[str, str], ...] = ()  # of the goals so far: name, "reached" or why not
    path: Float = field(default_factory=lambda: np.zeros((0, 2)))  # global way in world, m
    trajectory: Float = field(default_factory=lambda: np.zeros((0, 3)))  # poses ahead in world
    recovery: str = ""  # stage under way


@dataclass(frozen=True)
class StackState:
    """Snapshot of the stack's opinion after a tick. Nothing reads it back into the loop."""

    stamp: float
    pose: Float  # (3,) localised x, y, yaw in world
    pose_covariance: Float  # (3, 3)
    odometry_pose: Float  # (3,) wheels alone
    fused_pose: Float  # (3,) wheels and inertial unit, without map and tags
    velocity: Float  # (3,) in base
    task: str  # name of the running behaviour
    tracks: tuple[TrackedPart, ...] = ()
    detections: tuple[Detection, ...] = ()
    detections_stamp: float = -1.0
    events: tuple[str, ...] = ()  # one line each, new in this tick
    distance_to_pick: float = float("nan")  # S, m
    particles: int = 0
    lost: bool = False  # the scan does not fit where the vehicle is believed to be
    sights: tuple[TagSight, ...] = ()  # new in this tick
    beacons: tuple[BeaconSight, ...] = ()  # new in this tick
    pose6: Float | None = None  # (7,) x, y, z, qw, qx, qy, qz in world, where a network tells it
    navigation: NavigationState = NavigationState()
    goals: dict[str, float] = field(default_factory=dict)  # scalars worth plotting

"""The stack: readings in, commands out, wired in order.

What it does is said by the order that it gets over the plant's network; `MISSIONS` names the
behaviour tree of each kind.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from twin.geometry import Array, compose2
from twin.messages import (
    AnyOrder,
    ArmReading,
    BeaconOrder,
    BeaconStamps,
    BodyVelocity,
    CameraFrame,
    Commands,
    CourseOrder,
    Detection,
    DriveOrder,
    FloorFrame,
    Goal,
    GripperReading,
    LidarScan,
    MapOrder,
    Order,
    ParkOrder,
    Reading,
    RgbdFrame,
    StackState,
    TransportOrder,
    WheelState,
)
from twin.stack.config import StackConfig
from twin.stack.detection.contour import ContourDetector
from twin.stack.detection.frames import OUT_OF_VIEW
from twin.stack.detection.network_detector import NetworkDetector
from twin.stack.detection.tracker import Tracker
from twin.stack.estimation.beacon_calibration import BeaconCalibrationRun
from twin.stack.estimation.distance import DistanceToPick
from twin.stack.estimation.localiser import Localiser
from twin.stack.estimation.mapper import Mapper
from twin.stack.estimation.odometry import WheelOdometry
from twin.stack.estimation.site_map import SiteMap, floor_map, load_site_map
from twin.stack.planning.drive import Drive
from twin.stack.planning.leg_watch import leg_blocked
from twin.stack.planning.navigator import Navigator
from twin.stack.tasks.aisle import AisleKeeper
from twin.stack.tasks.arm_worker import ArmWorker
from twin.stack.tasks.beacon_mission import beacon_mission
from twin.stack.tasks.course_mission import course_mission
from twin.stack.tasks.drive_mission import drive_mission
from twin.stack.tasks.map_mission import map_mission
from twin.stack.tasks.mission import Act, Behaviour, end, ended, gave_up, running, sequence
from twin.stack.tasks.parking import Parker, park_mission
from twin.stack.tasks.pick_mission import pick_mission
from twin.stack.tasks.picker import Picker
from twin.stack.tasks.search import Search
from twin.stack.tasks.transport_mission import transport_mission

MISSIONS = {
    Order: pick_mission,
    DriveOrder: drive_mission,
    MapOrder: map_mission,
    TransportOrder: transport_mission,
    CourseOrder: course_mission,
    ParkOrder: park_mission,
    BeaconOrder: beacon_mission,
}


def drivable(config: StackConfig) -> SiteMap:
    """Where the vehicle can go: by the maps of an earlier run, else by the drawing.

    Raises:
        ValueError: one line, for a map that cannot be read or is not of this site.
    """
    if config.options.map is None:
        return floor_map(config.site)
    return load_site_map(Path(config.options.map) / "fused.yaml", config.site)


ASTRAY = 0.5  # m: a straight leg is not driven on from farther away than this


class Stack:
    """Everything between sensors and actuators of one vehicle.

    Args:
        config: the nominal drawing and the options; nothing else is known beforehand.
    """

    def __init__(self, config: StackConfig):
        self.config = config
        start = np.asarray(config.site.dock, dtype=float)
        self.odometry = WheelOdometry(config.wheels, start)
        self.localiser = Localiser(config, start)
        self.mapper: Mapper | None = None  # takes the localiser's place while mapping
        self.navigator = Navigator(config, drivable(config))
        self.drive = Drive(config.drive)  # straight legs
        self._leg_blocked, self._lost_for_good = False, ""
        self.parker = Parker(config.drive)  # straight legs to a millimetre
        self.head: BeaconCalibrationRun | None = None  # while the network is calibrated
        self.aisle = AisleKeeper(config) if config.options.aisle == "line" else None
        self.search = Search(config)
        learned = config.options.detector == "network"
        self.detector = NetworkDetector(config) if learned else ContourDetector(config)
        self._hindrance: str | None = None  # why the last picture could not be looked at
        self.tracker = Tracker(config)
        self.distance = DistanceToPick(config)
        self.arms = (ArmWorker(0, config), ArmWorker(1, config))
        self.picker = Picker(config, self.arms[: config.options.arms])
        self.order: AnyOrder | None = None
        self.on_picture: Callable[[CameraFrame], None] | None = None  # who wants the mast camera
        self.now = 0.0
        self.pose = start  # in world
        self.odom = start  # fused odometry, anchored in world by `anchor`
        self._believed = np.zeros(3)  # world from odom when the vehicle was last sure of it
        self._anchor = np.zeros(3)  # world from odom, held still while parts are tracked
        self._detections: tuple[Detection, ...] = ()
        self._detections_stamp = -1.0
        self.events: list[str] = []
        self._tree: Behaviour = Act("fetch order", lambda: self.order is not None)
        self.state = self._snapshot(())

    # --- the tick --------------------------------------------------------------------------------

    def step(self, stamp: float, readings: Sequence[Reading]) -> Commands:
        """One tick of 10 ms: estimation, detection, task, control.

        Args:
            stamp: time of this tick, s.
            readings: what has arrived since the last one.
        """
        self.now = stamp
        self.localiser.step(stamp, self._for_localiser(readings))
        for reading in readings:
            self._hear(reading)
        fused = self.localiser.fused.pose(stamp)
        self.odom = compose2(self._anchor, fused)
        if self.mapper is None:
            self.pose = self.localiser.pose(stamp)
        else:
            self.pose = compose2(self.mapper.world_from_odom, fused)
        if not self.done:
            self._tree.tick_once()
        body_velocity = self._wheels(stamp)
        parts = self.tracker.predict(stamp)
        self.picker.step(stamp, self.odom, parts)
        arms, grippers = zip(*(w.step(stamp) for w in self.arms), strict=True)
        self.state = self._snapshot(parts)
        return Commands(body_velocity, arms, grippers, self.on_picture is not None)

    def _hear(self, reading: Reading) -> None:
        if isinstance(reading, WheelState):
            self.odometry.update(reading)
        elif isinstance(reading, GripperReading | ArmReading):
            self.arms[reading.arm].hear(reading)
        elif isinstance(reading, CameraFrame):
            if self.on_picture is not None:
                self.on_picture(reading)
        elif isinstance(reading, LidarScan | RgbdFrame):
            self._look(reading)
        elif isinstance(reading, BeaconStamps):
            if self.head is not None:
                self.head.hear(reading)
        elif isinstance(reading, AnyOrder) and self.order is None:
            self.order = reading
            self._tree = sequence(
                "order",
                Act("learn gyro bias", lambda: self.localiser.ready),
                MISSIONS[type(reading)](self),
            )

    def _look(self, reading: LidarScan | RgbdFrame) -> None:
        pose = self.pose_at(reading.stamp)
        if self.mapper is not None:
            self.mapper.hear(reading, self.localiser.fused.history.at(reading.stamp))
        self.search.hear(reading)
        if self.aisle is not None and isinstance(reading, LidarScan):
            self.aisle.hear(reading)
        if not self.localiser.lost:
            self.navigator.hear(reading, pose)
            if not self.drive.done:
                self._leg_blocked = self._check_leg()
        if isinstance(reading, RgbdFrame) and not self.drive.done:
            self.distance.update(reading, pose)

    def _for_localiser(self, readings: Sequence[Reading]) -> Sequence[Reading]:
        """While a map is drawn there is none to be localised on: only odometry goes on."""
        if self.mapper is None:
            return readings
        return [r for r in readings if not isinstance(r, LidarScan | FloorFrame)]

    def _wheels(self, stamp: float) -> BodyVelocity:
        """The search for the vehicle's place, the navigator or straight legs move the wheels."""
        velocity = self.localiser.velocity
        if self._may_search() and not self.search.active:
            self.search.begin(stamp)
            self._believed = self.localiser.world_from_odom.copy()
        if self.search.failed(stamp):
            self.search.give_up()
            self._lost_for_good = "its place was not found in time"
            end(self._tree)
        if self.search.active:
            command = self.search.step(stamp, self.localiser)
            if not self.search.active:
                fused = self.localiser.fused.pose(stamp)
                off = compose2(self._believed, fused) - self.localiser.pose(stamp)
                off = float(np.hypot(*off[:2]))
                self.navigator.restart(off)
                if off > ASTRAY and not self.drive.done:
                    self.drive.give_up(f"the vehicle was carried {off:.1f} m off it")
                self.drive.resume(stamp, self.pose)
            return command
        if self._lost_for_good:
            return BodyVelocity()
        if self.navigator.active:
            return self.navigator.step(stamp, self.pose, velocity)
        if self.parker.active:
            return self.parker.step(stamp, self.pose)
        command = self.drive.step(stamp, self.pose, velocity, self._leg_blocked)
        if self.aisle is None or self.drive.done:
            return command
        return self.aisle.steered(stamp, self.drive.leg, command)

    def _check_leg(self) -> bool:
        """Whether something that is not on the map stands on the straight leg under way."""
        leg, around = self.drive.leg, self.navigator.surroundings
        if leg is None:
            return False
        calibrated = self.mapper is None or self.mapper.calibration is not None
        strangers = around.strangers(self.now, self.pose, by_camera=calibrated)
        return leg_blocked(
            self.pose, leg.goal, self.localiser.velocity, strangers, self.navigator.footprint,
            self.config.drive,
        )  # fmt: skip

    def _may_search(self) -> bool:
        """Whether the vehicle is lost and nothing keeps it where it is: arms out, no order."""
        arms_in = all(w.free and w.motion.idle(self.now) for w in self.arms)
        lost = self.mapper is None and self.localiser.lost
        return lost and arms_in and not self.picker.active and not self.done

    def pose_at(self, stamp: float) -> Array | None:
        """Pose in world at a past time; None where it is not known. Shape (3,)."""
        if self.mapper is None:
            return self.localiser.pose_at(stamp)
        fused = self.localiser.fused.history.at(stamp)
        return None if fused is None else compose2(self.mapper.world_from_odom, fused)

    # --- what missions are made of ---------------------------------------------------------------

    @property
    def done(self) -> bool:
        """Whether the order has been carried out (or given up) and the vehicle stands."""
        return ended(self._tree)

    @property
    def failure(self) -> str:
        """With what the order was given up and why, in one line; empty if it was not."""
        at = gave_up(self._tree)
        outcome = self.navigator.outcome.replace("reached", "")
        why = self._lost_for_good or self.drive.failure or outcome
        return f"{at}: {why}" if at and why else at

    def go(self, goal: Goal) -> Act:
        """Drive to a goal by the map; fails if it is given up."""
        navigator = self.navigator
        return Act(
            f"drive to {goal.name}",
            done=lambda: navigator.outcome == "reached",
            start=lambda: navigator.go(self.now, goal),
            failed=lambda: not navigator.active and navigator.outcome != "reached",
        )

    def straight(self, name: str, *route) -> Act:
        """Drive straight from pose to pose: in to a machine and out again."""
        return self.leg(name, lambda: route)

    def leg(self, name: str, route: Callable[[], Sequence]) -> Act:
        """Likewise, by a route that is known when it begins; fails if it is given up."""

        def start() -> None:
            self._leg_blocked = False
            self.drive.start(self.now, self.pose, route())

        drive = self.drive
        return Act(name, lambda: drive.done, start, lambda: drive.done and bool(drive.failure))

    def watch_belt(self) -> None:
        """From now on follow the parts in the mast camera's pictures, in the odometry's frame."""
        self._anchor = np.asarray(self.localiser.world_from_odom, dtype=float).copy()
        self.odom = compose2(self._anchor, self.localiser.fused.pose(self.now))
        self.on_picture = self._detect

    def _detect(self, frame: CameraFrame) -> None:
        fused = self.localiser.fused.history.at(frame.stamp)
        if fused is None:
            return
        pose = compose2(self._anchor, fused)
        self._detections = self.detector.detect(frame, pose)
        self._detections_stamp = frame.stamp
        self._tell(self.detector.reason)
        self.tracker.update(frame.stamp, self._detections, pose)

    def _tell(self, reason: str | None) -> None:
        """Say it when pictures can no longer be looked at, or can again."""
        if reason == OUT_OF_VIEW and not self.drive.done:
            reason = None  # all is well: the vehicle is still on its way to the belt
        if reason != self._hindrance:
            self._hindrance = reason
            self.events.append(f"mast camera: {reason or 'good pictures again'}")

    # --- for the record --------------------------------------------------------------------------

    def _snapshot(self, parts) -> StackState:
        speakers = (*self.arms, self.navigator, self.drive, self.localiser, self)
        events = tuple(e for s in speakers for e in s.events)
        for speaker in speakers:
            speaker.events.clear()
        localiser = self.localiser
        return StackState(
            stamp=self.now,
            pose=self.pose,
            pose_covariance=(self.mapper or localiser).covariance,
            odometry_pose=self.odometry.pose,
            fused_pose=localiser.fused.pose(self.now),
            velocity=localiser.velocity,
            task=self.search.reason or running(self._tree),
            tracks=parts,
            detections=self._detections,
            detections_stamp=self._detections_stamp,
            events=events,
            distance_to_pick=self.distance.distance(self.pose),
            particles=localiser.particles,
            lost=localiser.lost,
            sights=tuple(localiser.sights),
            beacons=tuple(localiser.beacons),
            pose6=localiser.pose6(self.now),
            navigation=self.navigator.state,
            goals={
                "wanted": float(sum(self.picker.remaining().values())),
                "placed": float(sum(len(w.placed) for w in self.arms)),
            },
        )

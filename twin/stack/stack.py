"""The stack: readings in, commands out, wired in order."""

from collections.abc import Sequence

import numpy as np

from twin.messages import (
    ArmReading,
    CameraFrame,
    Commands,
    Detection,
    GripperReading,
    Order,
    Reading,
    RgbdFrame,
    StackState,
    WheelState,
)
from twin.stack.config import StackConfig
from twin.stack.detection.contour import ContourDetector
from twin.stack.detection.tracker import Tracker
from twin.stack.estimation.distance import DistanceToPick
from twin.stack.estimation.fusion import FusedOdometry
from twin.stack.estimation.odometry import WheelOdometry
from twin.stack.grasping.intercept import arm_start_delay
from twin.stack.planning.drive import Drive
from twin.stack.tasks.arm_worker import ArmWorker
from twin.stack.tasks.mission import Act, running, sequence, together
from twin.stack.tasks.picker import Picker


class Stack:
    """Everything between sensors and actuators of one vehicle.

    Args:
        config: the nominal drawing and the options; nothing else is known beforehand.
    """

    def __init__(self, config: StackConfig):
        self.config = config
        start = np.asarray(config.site.dock, dtype=float)
        self.odometry = WheelOdometry(config.wheels, start)
        self.fused = FusedOdometry(config, start)
        self.detector = ContourDetector(config)
        self.tracker = Tracker(config)
        self.distance = DistanceToPick(config)
        self.drive = Drive(config.drive)
        self.arms = (ArmWorker(0, config), ArmWorker(1, config))
        self.picker = Picker(config, self.arms[: config.options.arms])
        self.order: Order | None = None
        self.now = 0.0
        self._pose = start
        self._detections: tuple[Detection, ...] = ()
        self._detections_stamp = -1.0
        self._arms_sent = False
        self._tree = self._mission()
        self.state = self._snapshot(())

    # --- the tick --------------------------------------------------------------------------------

    def step(self, stamp: float, readings: Sequence[Reading]) -> Commands:
        """One tick of 10 ms: estimation, detection, task, control.

        Args:
            stamp: time of this tick, s.
            readings: what has arrived since the last one.
        """
        self.now = stamp
        self.fused.step(readings)
        self._pose = self.fused.pose(stamp)
        for reading in readings:
            self._hear(reading)
        self._tree.tick_once()
        body_velocity = self.drive.step(stamp, self._pose, self.fused.velocity)
        parts = self.tracker.predict(stamp)
        self.picker.step(stamp, self._pose, parts)
        arms, grippers = zip(*(w.step(stamp) for w in self.arms), strict=True)
        self.state = self._snapshot(parts)
        return Commands(body_velocity, arms, grippers, mast_camera=True)

    def _hear(self, reading: Reading) -> None:
        if isinstance(reading, WheelState):
            self.odometry.update(reading)
        elif isinstance(reading, GripperReading | ArmReading):
            self.arms[reading.arm].hear(reading)
        elif isinstance(reading, CameraFrame):
            pose = self.fused.history.at(reading.stamp)
            if pose is not None:
                self._detections = self.detector.detect(reading, pose)
                self._detections_stamp = reading.stamp
                self.tracker.update(reading.stamp, self._detections, pose)
        elif isinstance(reading, RgbdFrame) and not self.drive.done:
            self.distance.update(reading, self.fused.history.at(reading.stamp))
        elif isinstance(reading, Order):
            self.order = reading

    # --- the mission -----------------------------------------------------------------------------

    def _mission(self):
        site = self.config.site
        to_line, to_receiving = (site.pick_approach, site.pick), (site.pick_leave,)
        return sequence(
            "order",
            together(
                "make ready",
                Act("fetch order", lambda: self.order is not None),
                Act("learn gyro bias", lambda: self.fused.ready),
            ),
            together(
                "go to line",
                Act("drive to line", self._arrived, lambda: self._go(to_line)),
                Act("ready arms", self._arms_ready, self.distance.reset),
            ),
            Act("pick", self._picked, self._start_picking),
            Act(
                "stow arms",
                self._arms_idle,
                lambda: [w.motion.go_stow(self.now) for w in self.arms],
            ),
            Act("deliver", self._arrived, lambda: self._go((*to_receiving, site.receiving))),
            Act("done", lambda: False),
        )

    @property
    def done(self) -> bool:
        """Whether the order has been handed over (or given up) and the vehicle stands."""
        return running(self._tree) == "done"

    def _go(self, route) -> None:
        self.drive.start(self.now, self._pose, route)

    def _arrived(self) -> bool:
        return self.drive.done

    def _arms_idle(self) -> bool:
        return all(w.free and w.motion.idle(self.now) for w in self.arms)

    def _arms_ready(self) -> bool:
        """Sends the arms over the belt so that they are there when the vehicle stops."""
        if not self.config.options.grasp_timing:
            return True
        if not self._arms_sent and self.drive.last_leg:
            workers = self.picker.workers
            needed = max(w.motion.duration_to(self.now, w.motion.ready_position) for w in workers)
            S, speed = self.distance.distance(self._pose), float(self.fused.velocity[0])
            if arm_start_delay(S, speed, self.config.drive.acceleration, needed) <= 0.0:
                for w in workers:
                    w.motion.go_ready(self.now)
                self._arms_sent = True
        return self._arms_sent

    def _start_picking(self) -> None:
        assert self.order is not None
        self.picker.start(self.now, self.order)

    def _picked(self) -> bool:
        if not self.picker.finished(self.now):
            return False
        self.picker.active = False
        return True

    # --- for the record --------------------------------------------------------------------------

    def _snapshot(self, parts) -> StackState:
        events = tuple(e for w in self.arms for e in w.events)
        for w in self.arms:
            w.events.clear()
        return StackState(
            stamp=self.now,
            pose=self._pose,
            pose_covariance=self.fused.covariance,
            odometry_pose=self.odometry.pose,
            fused_pose=self._pose,
            velocity=self.fused.velocity,
            task=running(self._tree),
            tracks=parts,
            detections=self._detections,
            detections_stamp=self._detections_stamp,
            events=events,
            distance_to_pick=self.distance.distance(self._pose),
            goals={
                "wanted": float(sum(self.picker.remaining().values())),
                "placed": float(sum(len(w.placed) for w in self.arms)),
            },
        )

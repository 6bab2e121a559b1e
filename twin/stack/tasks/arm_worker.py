"""One arm at work: meet a part, grip it, make sure of the grip, carry it to a slot.

A grip is believed only as long as the fingers say so: their width must fit the part and the force
must be there, at the lift and all the way to the slot. A lost grip is noticed and reported.
"""

from dataclasses import dataclass
from enum import Enum

import numpy as np

from twin.geometry import Array, apply, rot_z
from twin.messages import (
    ArmCommand,
    ArmReading,
    GripperCommand,
    GripperReading,
    PartClass,
    TrackedPart,
)
from twin.stack.config import StackConfig
from twin.stack.control.arm_kinematics import Unreachable
from twin.stack.control.arm_motion import ArmMotion, Grasp, PickTimes, PlaceTimes

PRE_OPEN = 0.016  # m more than the part between the pads on the way down
RELEASE_OPEN = 0.012  # m more than the part when it is let go: room in the slot is scarce
WIDTH_TOLERANCE = 0.005  # m between the drawing's grip width and the fingers'
LEAST_FORCE = 0.4  # share of the wanted force below which there is no grip
RELEASE_HEIGHT = 0.002  # m of air below the part when it is let go
REPLAN_SHIFT = 0.0005  # m that the meeting point must have moved to be planned anew
BLOCKED_ERROR = 0.12  # rad off the reference: ten times what the drives leave at full speed
BLOCKED_TIME = 0.15  # s that this must last
LAST_REPLAN = 0.04  # s before the descent after which the plan stands


class Phase(Enum):
    IDLE = "idle"
    APPROACH = "approach"
    CLOSING = "closing"
    CARRYING = "carrying"
    RELEASING = "releasing"
    GIVING_UP = "giving up"
    BLOCKED = "blocked"


@dataclass(frozen=True)
class Job:
    """A part being fetched."""

    track_id: int
    part_class: PartClass
    slot: Array  # (3,) in base
    meet: float


def grasp_of(part: TrackedPart, stamp: float, config: StackConfig, T_mount_odom: Array) -> Grasp:
    """Where and how an arm closes on a tracked part (prediction for time `stamp`), in mount.

    The grasp point lies off the part's centroid as the drawing says (PartDrawing); a two-finger
    hand may turn by half a turn.
    """
    drawing = config.parts[part.part_class]
    offset = rot_z(part.yaw) @ np.array([drawing.grasp_x, drawing.grasp_y, 0.0])
    p_odom = np.array([*(part.p_odom + offset)[:2], config.site.line.height + drawing.grasp_z])
    turn = float(np.arctan2(T_mount_odom[1, 0], T_mount_odom[0, 0]))
    velocity = T_mount_odom[:3, :3] @ part.velocity_in_odom
    velocity[2] = 0.0
    return Grasp(stamp, apply(T_mount_odom, p_odom), velocity, part.yaw + turn + drawing.grip_yaw)


class ArmWorker:
    """Runs one arm's job step by step on top of its motion.

    Args:
        index: 0 front, 1 rear.
        config: the stack's belief.
    """

    def __init__(self, index: int, config: StackConfig):
        self.index, self.config = index, config
        self.motion = ArmMotion(index, config)
        self.phase = Phase.IDLE
        self.job: Job | None = None
        self.events: list[str] = []
        self.placed: list[Job] = []  # delivered to their slots, by the fingers' own evidence
        self.lost: list[Job] = []
        self._pick: PickTimes | None = None
        self._place: PlaceTimes | None = None
        self._planned_for = np.zeros(3)
        # Base x runs along minus mount y.
        x = config.T_base_arm[index][0, 3]
        low, high = config.pick_windows[index]
        self._window = (x - high, x - low)
        self._gripper: GripperReading | None = None
        self._joints: ArmReading | None = None
        self._off_since = np.inf
        self._command = GripperCommand(index, config.gripper.stroke / 2, config.gripper.force)

    @property
    def free(self) -> bool:
        return self.phase is Phase.IDLE

    def hear(self, reading: GripperReading | ArmReading) -> None:
        """Take a reading of this arm's gripper or joints; joints that do not follow stop it."""
        if isinstance(reading, GripperReading):
            self._gripper = reading
            return
        self._joints = reading
        off = np.abs(reading.position - self.motion.state(reading.stamp).q)
        if np.max(off) < BLOCKED_ERROR:
            self._off_since = np.inf
            return
        self._off_since = min(self._off_since, reading.stamp)
        if reading.stamp - self._off_since >= BLOCKED_TIME and self.phase is not Phase.BLOCKED:
            self.phase = Phase.BLOCKED
            joint = int(np.argmax(off))
            self.events.append(
                f"arm {self.index} is blocked: joint {joint + 1} is {off[joint]:.2f} rad off;"
                " it stops, and the vehicle stays"
            )

    # --- fingers, also for other tasks than the belt's --------------------------------------------

    def set_fingers(self, width: float) -> None:
        """Open or close to `width` m between the pads, with the force used for grips."""
        self._command = GripperCommand(self.index, width, self.config.gripper.force)

    def grips(self, width: float) -> bool:
        """Whether the fingers say that they hold something `width` m wide."""
        reading = self._gripper
        if reading is None or abs(reading.width - width) >= WIDTH_TOLERANCE:
            return False
        return reading.force > LEAST_FORCE * self.config.gripper.force

    # --- jobs ------------------------------------------------------------------------------------

    def earliest(self, now: float, grasp: Grasp) -> float | None:
        """Earliest time to close on a part within this arm's window; None if it cannot be met."""
        try:
            return self.motion.earliest_meeting(now, grasp, self._window)
        except Unreachable:
            return None

    def take(self, now: float, job: Job, grasp: Grasp) -> bool:
        """Start fetching a part; False if it turns out to be out of reach."""
        try:
            self._pick = self.motion.pick(now, grasp, job.meet)
        except Unreachable:
            return False
        self.job, self.phase = job, Phase.APPROACH
        self._planned_for = grasp.at(job.meet)
        self._open_for(job, PRE_OPEN)
        self.events.append(f"arm {self.index} goes for track {job.track_id} ({job.part_class})")
        return True

    def refine(self, now: float, grasp: Grasp) -> None:
        """Follow what the camera has learnt about the part since the plan was made."""
        job, pick = self.job, self._pick
        if self.phase is not Phase.APPROACH or job is None or pick is None:
            return
        if now > pick.descend - LAST_REPLAN:
            return
        if np.linalg.norm(grasp.at(job.meet) - self._planned_for) < REPLAN_SHIFT:
            return
        try:
            self._pick = self.motion.pick(now, grasp, job.meet)
            self._planned_for = grasp.at(job.meet)
        except Unreachable:
            pass  # the plan under way stands: the shift is below the fingers' opening

    # --- every tick ------------------------------------------------------------------------------

    def step(self, now: float) -> tuple[ArmCommand, GripperCommand]:
        """Advance the job; set-points of this tick."""
        job, pick, place = self.job, self._pick, self._place
        if self.phase is Phase.APPROACH and job and pick and now >= pick.close:
            self.set_fingers(0.0)
            self.phase = Phase.CLOSING
        elif self.phase is Phase.CLOSING and job and pick and now >= pick.lift:
            if self._has_grip(job):
                self._carry(now, job)
            else:
                self._lose(job, "closed on nothing")
        elif self.phase is Phase.CARRYING and job and place:
            if now >= place.open:
                self._open_for(job, RELEASE_OPEN)
                self.phase = Phase.RELEASING
            elif not self._has_grip(job):
                self._lose(job, "lost the part on the way")
        elif self.phase is Phase.RELEASING and job and place and now >= place.done:
            self.placed.append(job)
            self.events.append(f"arm {self.index} placed {job.part_class}")
            self.job, self.phase = None, Phase.IDLE
        elif self.phase is Phase.GIVING_UP and self.motion.idle(now):
            self.job, self.phase = None, Phase.IDLE
        if self.phase is Phase.BLOCKED and self._joints is not None:
            q, still = self._joints.position, np.zeros(6)
            torque = self.motion.dynamics.torque(q, still, still)
            return ArmCommand(self.index, q, still, torque), self._command
        return self.motion.command(now), self._command

    # --- inside ----------------------------------------------------------------------------------

    def _carry(self, now: float, job: Job) -> None:
        drawing = self.config.parts[job.part_class]
        self.motion.dynamics.set_payload(drawing.mass)
        target = job.slot + np.array([0.0, 0.0, drawing.grasp_z + RELEASE_HEIGHT])
        yaw = self._slot_yaw(job)
        self._place = self.motion.place(now, apply(self.motion.T_mount_base, target), yaw)
        self.phase = Phase.CARRYING

    def _slot_yaw(self, job: Job) -> float:
        """Closing direction in mount that lays the part's axis along a side of the slot."""
        return self.config.parts[job.part_class].grip_yaw

    def _lose(self, job: Job, why: str) -> None:
        self.lost.append(job)
        self.events.append(f"arm {self.index} {why} ({job.part_class}, track {job.track_id})")
        self._open_for(job, PRE_OPEN)
        self.phase = Phase.GIVING_UP

    def _has_grip(self, job: Job) -> bool:
        return self.grips(self.config.parts[job.part_class].grip_width)

    def _open_for(self, job: Job, extra: float) -> None:
        self.motion.dynamics.set_payload(0.0)
        wanted = self.config.parts[job.part_class].grip_width + extra
        self.set_fingers(min(wanted, self.config.gripper.stroke))

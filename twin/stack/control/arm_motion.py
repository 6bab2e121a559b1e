"""What one arm does, as a queue of joint motions on the run's clock, sampled at 100 Hz.

All positions are the TCP's, in the arm's mount frame; the hand points down and its two fingers
are alike. A pick is an approach (ruckig, to a point above the part, at the part's velocity), then
straight down in the frame of the moving part, a dwell there while the fingers close, and a lift
out of that frame. Transfers are timed paths (arm_path.py).
"""

from dataclasses import dataclass

import numpy as np
import ruckig

from twin.geometry import Array, inverse, rot2
from twin.messages import ArmCommand
from twin.stack.config import StackConfig
from twin.stack.control.arm_dynamics import ArmDynamics
from twin.stack.control.arm_kinematics import ArmKinematics, Unreachable
from twin.stack.control.arm_path import STEP, JointTable, Travel, hand_path, time_path

DESCENT_HEIGHT, DESCENT_TIME = 0.050, 0.24  # m, s: peak 5.8 h / T^2 = 5 m/s^2
DWELL = 0.24  # s between closing command and lift: 20 mm at 150 mm/s, then 33 ms to full force
LIFT_HEIGHT, LIFT_TIME = 0.065, 0.28  # m, s
RELEASE = 0.14  # s between opening command and going up from a slot
HAND_AIR = 0.08  # m from the belt's rail within which the hand keeps the belt's travel height
LATEST = 6.0  # s ahead that a meeting is looked for


@dataclass(frozen=True)
class Grasp:
    """Where the TCP must be to close on a part that moves with constant velocity, in mount."""

    stamp: float  # time to which `position` belongs, s
    position: Array  # (3,) m
    velocity: Array  # (3,) m/s
    yaw: float  # along which the fingers close, rad

    def at(self, time: float) -> Array:
        return self.position + self.velocity * (time - self.stamp)


@dataclass(frozen=True)
class PickTimes:
    """Moments of a pick on the run's clock, s."""

    descend: float  # until here the pick may be planned anew
    close: float  # TCP at the part: command the fingers
    lift: float
    done: float  # at rest above the belt


@dataclass(frozen=True)
class PlaceTimes:
    """Moments of a placing on the run's clock, s."""

    open: float  # at rest in the slot: command the fingers
    done: float  # fingers open


@dataclass(frozen=True)
class _Segment:
    start: float
    table: JointTable


class TooLate(Unreachable):
    """The arm cannot be there in time."""


class ArmMotion:
    """Reference motion of one arm.

    Args:
        index: 0 front, 1 rear.
        config: the stack's belief; gives mount, limits, belt and tray.
    """

    def __init__(self, index: int, config: StackConfig):
        self.index, self.arm = index, config.arm
        self.kinematics = ArmKinematics(config.arm)
        self.dynamics = ArmDynamics(config.arm_model)
        T_base_mount = config.T_base_arm[index]
        self.T_mount_base = inverse(T_base_mount)
        deck, side = T_base_mount[2, 3], 1.0 if index == 0 else -1.0
        line = config.site.line
        # Distance of the belt's centre line to the left of the vehicle at the pick pose.
        to_line = np.asarray(line.origin) - np.asarray(config.site.pick[:2])
        belt_y = float((rot2(config.site.pick[2]).T @ to_line)[1])
        rail = belt_y - line.width / 2 - 0.02 - T_base_mount[1, 3]
        belt = line.height - deck
        self.travel = Travel(
            belt_edge=rail - HAND_AIR,
            belt_height=belt + 0.070,
            tray_height=config.tray.floor + config.tray.wall + 0.088 - deck,
        )
        window = config.pick_windows[index]
        self.ready_position = np.array(
            [belt_y - T_base_mount[1, 3], T_base_mount[0, 3] - sum(window) / 2, belt + 0.090]
        )
        self.stow_position = np.array([-0.173, side * 0.100, 0.160])
        stow = self.stow_position
        yaw = np.arctan2(stow[1], stow[0]) + np.pi / 2  # joint 6 at zero
        self._rest = self.kinematics.inverse_down(stow[None], np.array([yaw]))[0]
        self._segments: list[_Segment] = []
        self._pick: PickTimes | None = None
        self._approach_start = 0.0
        self._ruckig = ruckig.Ruckig(6)

    # --- state ----------------------------------------------------------------------------------

    @property
    def ends_at(self) -> float:
        """Time at which everything planned is over; -inf if nothing was ever planned."""
        if not self._segments:
            return -np.inf
        return self._segments[-1].start + self._segments[-1].table.duration

    def idle(self, now: float) -> bool:
        """Whether the arm stands still with nothing planned."""
        return now >= self.ends_at - 1e-9

    def state(self, now: float) -> tuple[Array, Array, Array]:
        """Reference joint position, velocity and acceleration. Shapes (6,)."""
        while len(self._segments) > 1 and self._segments[1].start <= now + 1e-9:
            self._segments.pop(0)
        return self._state(now, self._segments)

    def command(self, now: float) -> ArmCommand:
        """Set-points of this tick, with feed-forward torque."""
        q, qd, qdd = self.state(now)
        return ArmCommand(self.index, q, qd, self.dynamics.torque(q, qd, qdd))

    def tcp(self, now: float) -> Array:
        """Reference position of the TCP in mount. Shape (3,)."""
        return self.kinematics.forward(self.state(now)[0])[:3, 3]

    # --- plans ----------------------------------------------------------------------------------

    def move_to(self, now: float, position: Array, yaw: float | None = None) -> float:
        """Go to a standing point by a safe path after what is planned; returns the arrival time.

        Args:
            now: the run's clock, s.
            position: TCP in mount, m. Shape (3,).
            yaw: closing direction; None turns joint 6 to zero.

        Raises:
            Unreachable: nothing is changed.
        """
        start = max(now, self.ends_at)
        table = self._transfer(self._state(start, self._segments)[0], position, yaw)
        self._segments.append(_Segment(start, table))
        return self.ends_at

    def go_ready(self, now: float) -> float:
        """Above the belt, in the middle of this arm's window."""
        return self.move_to(now, self.ready_position)

    def go_stow(self, now: float) -> float:
        """Folded over the vehicle's own deck, for driving."""
        return self.move_to(now, self.stow_position)

    def duration_to(self, now: float, position: Array, yaw: float | None = None) -> float:
        """Seconds from the end of what is planned to standing at a point."""
        start = max(now, self.ends_at)
        return self._transfer(self._state(start, self._segments)[0], position, yaw).duration

    def earliest_meeting(self, now: float, grasp: Grasp) -> float:
        """Earliest time at which the TCP can be at the part, moving with it.

        Solves `duration(approach to the state at T) = T - start` by bisection.

        Raises:
            Unreachable: the part is not met within `LATEST` seconds, or passes out of reach.
        """
        start, _, state = self._approach_from(now)

        def spare(meet: float) -> float:
            above = meet - DESCENT_TIME
            return above - start - self._trajectory(state, grasp, above).duration

        low, high = start + DESCENT_TIME, None
        for meet in np.arange(low, low + LATEST, 0.1):  # the first moment that will do
            try:
                if spare(meet) >= 0.0:
                    high = float(meet)
                    break
            except Unreachable:
                pass  # not yet within reach
            low = float(meet)
        if high is None:
            raise TooLate(f"arm {self.index} cannot meet this part within {LATEST} s")
        for _ in range(10):
            middle = 0.5 * (low + high)
            try:
                good = spare(middle) >= 0.0
            except Unreachable:
                good = False
            low, high = (low, middle) if good else (middle, high)
        return high

    def pick(self, now: float, grasp: Grasp, meet: float) -> PickTimes:
        """Plan a pick whose TCP is at the part at time `meet`; replaces an approach under way.

        Raises:
            TooLate: the arm cannot be there at `meet`; nothing is changed.
            Unreachable: some point of the pick is out of reach; nothing is changed.
        """
        start, before, state = self._approach_from(now)
        above, lift = meet - DESCENT_TIME, meet + DWELL
        approach = self._approach(state, grasp, start, above)
        near = float(approach.q[-1, 5])
        down = self._straight(grasp, near, above, DESCENT_TIME, (DESCENT_HEIGHT, 0.0))
        dwell = self._straight(grasp, near, meet, DWELL, (0.0, 0.0))
        up = self._straight(grasp, near, lift, LIFT_TIME, (0.0, LIFT_HEIGHT), stop=True)
        starts, tables = (start, above, meet, lift), (approach, down, dwell, up)
        self._segments = [*before, *map(_Segment, starts, tables)]
        self._approach_start = start
        self._pick = PickTimes(above, meet, lift, self.ends_at)
        return self._pick

    def place(self, now: float, position: Array, yaw: float | None = None) -> PlaceTimes:
        """Carry to a slot and stay there until the fingers are open. See `move_to`."""
        at_slot = self.move_to(now, position, yaw)
        q = self._segments[-1].table.q[-1]
        still = np.tile(q, (round(RELEASE / STEP) + 1, 1))
        self._segments.append(_Segment(at_slot, JointTable.from_positions(still)))
        return PlaceTimes(at_slot, self.ends_at)

    # --- inside ---------------------------------------------------------------------------------

    def _state(self, time: float, segments: list[_Segment]) -> tuple[Array, Array, Array]:
        for segment in reversed(segments):
            if segment.start <= time + 1e-9:
                if time > segment.start + segment.table.duration + 1e-9:
                    return segment.table.q[-1], np.zeros(6), np.zeros(6)
                return segment.table.sample(time - segment.start)
        return (segments[0].table.q[0] if segments else self._rest), np.zeros(6), np.zeros(6)

    def _transfer(self, q: Array, position: Array, yaw: float | None) -> JointTable:
        here = self.kinematics.forward(q)
        yaw_here = float(np.arctan2(here[1, 1], here[0, 1]))
        if yaw is None:  # joint 6 at zero
            yaw = float(np.arctan2(position[1], position[0]) + np.pi / 2)
        points = hand_path(here[:3, 3], position, self.travel)
        return time_path(points, (yaw_here, yaw), float(q[5]), self.arm)

    def _approach_from(self, now: float):
        """When an approach can begin, the segments that run before it, and the state there."""
        segments = self._segments
        if self._pick is not None and now < self._pick.descend - 1e-9:  # plan this pick anew
            start = max(now, self._approach_start)
            before = [s for s in segments if s.start < self._approach_start - 1e-9]
        else:
            start, before = max(now, self.ends_at), list(segments)
        state = self._state(start, segments)
        if self.kinematics.forward(state[0])[0, 3] < self.travel.belt_edge:  # over the deck: out
            table = self._transfer(state[0], self.ready_position, None)
            before.append(_Segment(start, table))
            start += table.duration
            state = (table.q[-1], np.zeros(6), np.zeros(6))
        return start, before, state

    def _moving_state(self, grasp: Grasp, near: float, time: float):
        """Joint state above a moving part, by differences of the closed form. Shapes (6,)."""
        p = np.array([grasp.at(time + k * STEP) for k in (-1, 0, 1)])
        p[:, 2] += DESCENT_HEIGHT
        q = self.kinematics.inverse_down(p, np.full(3, grasp.yaw), near)
        return q[1], (q[2] - q[0]) / (2 * STEP), (q[2] - 2 * q[1] + q[0]) / STEP**2

    def _trajectory(self, state, grasp: Grasp, time: float, minimum: float | None = None):
        """Ruckig trajectory from a state to the part's side at `time`; at least `minimum` long."""
        task = ruckig.InputParameter(6)
        task.current_position, task.current_velocity, task.current_acceleration = state
        near = float(np.clip(state[0][5], -np.pi / 2, np.pi / 2))  # joint 6 must not wind up
        target = self._moving_state(grasp, near, time)
        task.target_position, task.target_velocity, task.target_acceleration = target
        task.max_velocity = self.arm.max_speed
        task.max_acceleration = self.arm.max_acceleration
        task.max_jerk = self.arm.max_jerk
        if minimum is not None:
            task.minimum_duration = minimum
        trajectory = ruckig.Trajectory(6)
        result = self._ruckig.calculate(task, trajectory)
        if result not in (ruckig.Result.Working, ruckig.Result.Finished):
            raise Unreachable(f"arm {self.index}: no approach found ({result.name})")
        return trajectory

    def _approach(self, state, grasp: Grasp, start: float, end: float) -> JointTable:
        if end - start < STEP:
            raise TooLate(f"arm {self.index}: {end - start:.3f} s are left for the approach")
        trajectory = self._trajectory(state, grasp, end, end - start)
        if trajectory.duration > end - start + 1e-6:
            raise TooLate(
                f"arm {self.index}: the approach takes {trajectory.duration:.3f} s,"
                f" {end - start:.3f} s are left"
            )
        times = np.arange(int(np.ceil((end - start) / STEP)) + 1) * STEP
        q, qd, qdd = (np.array(a) for a in zip(*map(trajectory.at_time, times), strict=True))
        lowest = min(self.kinematics.forward(x)[2, 3] for x in q[::10])
        if lowest < self.travel.belt_height - 0.030:
            raise Unreachable(f"arm {self.index}: the approach would dip to {lowest:.3f} m")
        return JointTable(q, qd, qdd)

    def _straight(
        self,
        grasp: Grasp,
        near: float,
        start: float,
        duration: float,
        heights: tuple[float, float],
        stop: bool = False,
    ) -> JointTable:
        """Straight up or down in the part's frame; `stop` comes to rest in the mount's frame."""
        x = np.linspace(0.0, 1.0, round(duration / STEP) + 1)
        rise = x**3 * (10 - 15 * x + 6 * x**2)
        moved = x - (x**4 * (2.5 - 3 * x + x**2) if stop else 0.0)  # of the frame, in durations
        p = grasp.at(start) + np.outer(duration * moved, grasp.velocity)
        p[:, 2] += heights[0] + (heights[1] - heights[0]) * rise
        return JointTable.from_positions(
            self.kinematics.inverse_down(p, np.full(len(x), grasp.yaw), near)
        )

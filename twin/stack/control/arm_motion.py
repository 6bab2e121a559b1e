"""What one arm does, as a queue of joint motions on the run's clock, sampled at 100 Hz.

All positions are the TCP's, in the arm's mount frame; the hand points down and its two fingers
are alike. A pick is an approach (ruckig, to a point above the part, at the part's velocity), then
straight down in the frame of the moving part, a dwell there while the fingers close, and a lift
out of that frame. Everything else is a timed path (arm_path.py).
"""

from dataclasses import dataclass

import numpy as np

from twin.geometry import Array, inverse, rot2
from twin.messages import ArmCommand
from twin.stack.config import StackConfig
from twin.stack.control.arm_dynamics import ArmDynamics
from twin.stack.control.arm_kinematics import ArmKinematics, Unreachable
from twin.stack.control.arm_path import STEP, JointTable, Travel, hand_path, time_path
from twin.stack.control.arm_trajectory import (
    Grasp,
    JointState,
    TooLate,
    rendezvous,
    state_above,
    straight,
    table_of,
)
from twin.stack.grasping.intercept import intercept

__all__ = ["ArmMotion", "Grasp", "PickTimes", "PlaceTimes", "TooLate"]

DESCENT_HEIGHT, DESCENT_TIME = 0.050, 0.24  # m, s: peak 5.8 h / T^2 = 5 m/s^2
DWELL = 0.20  # s between closing command and lift: 16 mm at 150 mm/s, 33 ms to full force, air
LIFT_HEIGHT, LIFT_TIME = 0.065, 0.26  # m, s: peak 5.6 m/s^2
RELEASE = 0.14  # s between opening command and going up from a slot: 12 mm at 150 mm/s, air
HAND_AIR = 0.08  # m from the belt's rail within which the hand keeps the belt's travel height
DIP = 0.030  # m below the belt's travel height that an approach may pass
TICK = 0.010  # s between set-points
LATEST = 6.0  # s ahead that a meeting is looked for


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

    @property
    def end(self) -> float:
        return self.start + self.table.duration


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
        mount_x, mount_y, deck = T_base_mount[:3, 3]
        line = config.site.line
        # Distance of the belt's centre line to the left of the vehicle at the pick pose.
        to_line = np.asarray(line.origin) - np.asarray(config.site.pick[:2])
        belt_y = float((rot2(config.site.pick[2]).T @ to_line)[1])
        rail, belt = belt_y - line.width / 2 - 0.02 - mount_y, line.height - deck
        self.travel = Travel(
            belt_edge=rail - HAND_AIR,
            belt_height=belt + 0.070,
            tray_height=config.tray.floor + config.tray.wall + 0.088 - deck,
        )
        middle = sum(config.pick_windows[index]) / 2
        self.ready_position = np.array([belt_y - mount_y, mount_x - middle, belt + 0.090])
        # Turned away from the belt. Front: the elbow keeps clear of the mast on the way. Rear:
        # out of the front arm's way, which may use the whole tray when it works alone.
        self.stow_position = np.array(config.stow[index])
        yaw = np.array([_plain_yaw(self.stow_position)])
        self.rest = self.kinematics.inverse_down(self.stow_position[None], yaw)[0]
        self._segments: list[_Segment] = []
        self._pick: PickTimes | None = None
        self._approach_start = 0.0

    # --- state ----------------------------------------------------------------------------------

    @property
    def ends_at(self) -> float:
        """Time at which everything planned is over; -inf if nothing was ever planned."""
        return self._segments[-1].end if self._segments else -np.inf

    def idle(self, now: float) -> bool:
        """Whether the arm stands still with nothing planned."""
        return now >= self.ends_at - 1e-9

    def state(self, time: float) -> JointState:
        """Reference at a time not before the last command's."""
        for segment in reversed(self._segments):
            if segment.start <= time + 1e-9:
                if time > segment.end + 1e-9:
                    return JointState.still(segment.table.q[-1])
                return JointState(*segment.table.sample(time - segment.start))
        return JointState.still(self._segments[0].table.q[0] if self._segments else self.rest)

    def command(self, now: float) -> ArmCommand:
        """Set-points of this tick, with feed-forward torque.

        The drive runs on from the position at the given velocity until the next tick: so that is
        the mean velocity of the tick, and the torque that of its middle.
        """
        while len(self._segments) > 1 and self._segments[1].start <= now + 1e-9:
            self._segments.pop(0)
        q, middle = self.state(now).q, self.state(now + TICK / 2)
        velocity = (self.state(now + TICK).q - q) / TICK
        torque = self.dynamics.torque(middle.q, middle.qd, middle.qdd)
        return ArmCommand(self.index, q, velocity, torque)

    def tcp(self, now: float) -> Array:
        """Reference position of the TCP in mount. Shape (3,)."""
        return self.kinematics.forward(self.state(now).q)[:3, 3]

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
        table = self._transfer(self.state(start).q, position, yaw)
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
        return self._transfer(self.state(start).q, position, yaw).duration

    def earliest_meeting(
        self, now: float, grasp: Grasp, window: tuple[float, float] = (-np.inf, np.inf)
    ) -> float:
        """Earliest time at which the TCP can be at the part, moving with it, within a window.

        The part runs along the mount's y; for each place on its way the time to reach it is that
        of the fastest approach to the state above it, and the descent.

        Args:
            now: the run's clock, s.
            grasp: the moving part.
            window: y in mount within which to meet it, m.

        Raises:
            Unreachable: the part is not met within `LATEST` seconds, or passes out of reach.
        """
        start, _, state = self._approach_from(now)
        y, speed = float(grasp.at(now)[1]), float(grasp.velocity[1])

        def time_to_reach(place: float) -> float:
            meet = now + (place - y) / speed if speed else start + DESCENT_TIME
            try:
                goal = self._above(state, grasp, meet - DESCENT_TIME)
                approach = rendezvous(self.arm, state, goal).duration
            except Unreachable:
                return np.inf
            return start - now + approach + DESCENT_TIME

        found = intercept(now, y, speed, window, time_to_reach, start - now + LATEST)
        if found is None:
            raise TooLate(f"arm {self.index} cannot meet this part within {LATEST} s")
        return found.time

    def pick(self, now: float, grasp: Grasp, meet: float) -> PickTimes:
        """Plan a pick whose TCP is at the part at time `meet`.

        Called again before `PickTimes.descend`, it replaces the plan, the approach under way too.

        Raises:
            TooLate: the arm cannot be there at `meet`; nothing is changed.
            Unreachable: some point of the pick is out of reach; nothing is changed.
        """
        start, before, state = self._approach_from(now)
        above, lift = meet - DESCENT_TIME, meet + DWELL
        approach = self._approach(state, grasp, start, above)
        near, kin = float(approach.q[-1, 5]), self.kinematics
        down = straight(kin, grasp, near, above, DESCENT_TIME, (DESCENT_HEIGHT, 0.0))
        dwell = straight(kin, grasp, near, meet, DWELL, (0.0, 0.0))
        up = straight(kin, grasp, near, lift, LIFT_TIME, (0.0, LIFT_HEIGHT), stop=True)
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

    def _transfer(self, q: Array, position: Array, yaw: float | None) -> JointTable:
        here = self.kinematics.forward(q)
        yaw_here = float(np.arctan2(here[1, 1], here[0, 1]))
        goal = _plain_yaw(position) if yaw is None else yaw
        points = hand_path(here[:3, 3], position, self.travel)
        return time_path(points, (yaw_here, goal), float(q[5]), self.arm)

    def _approach_from(self, now: float) -> tuple[float, list[_Segment], JointState]:
        """When an approach can begin, the segments that run before it, and the state there."""
        segments = self._segments
        if self._pick is not None and now < self._pick.descend - 1e-9:  # plan this pick anew
            start = max(now, self._approach_start)
            before = [s for s in segments if s.start < self._approach_start - 1e-9]
        else:
            start, before = max(now, self.ends_at), list(segments)
        state = self.state(start)
        if self.kinematics.forward(state.q)[0, 3] < self.travel.belt_edge:  # over the deck: out
            table = self._transfer(state.q, self.ready_position, None)
            before.append(_Segment(start, table))
            start, state = start + table.duration, JointState.still(table.q[-1])
        return start, before, state

    def _above(self, state: JointState, grasp: Grasp, time: float) -> JointState:
        near = float(np.clip(state.q[5], -np.pi / 2, np.pi / 2))  # joint 6 must not wind up
        return state_above(self.kinematics, grasp, DESCENT_HEIGHT, near, time)

    def _approach(self, state: JointState, grasp: Grasp, start: float, end: float) -> JointTable:
        if end - start < STEP:
            raise TooLate(f"arm {self.index}: {end - start:.3f} s are left for the approach")
        trajectory = rendezvous(self.arm, state, self._above(state, grasp, end), end - start)
        if trajectory.duration > end - start + 1e-6:
            raise TooLate(
                f"arm {self.index}: the approach takes {trajectory.duration:.3f} s,"
                f" {end - start:.3f} s are left"
            )
        table = table_of(trajectory, end - start)
        lowest = min(self.kinematics.forward(q)[2, 3] for q in table.q[::10])
        if lowest < self.travel.belt_height - DIP:
            raise Unreachable(f"arm {self.index}: the approach would dip to {lowest:.3f} m")
        return table


def _plain_yaw(position: Array) -> float:
    """Closing direction at a point for which joint 6 stands at zero."""
    return float(np.arctan2(position[1], position[0]) + np.pi / 2)

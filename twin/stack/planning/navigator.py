"""From a goal to body velocities, by map and sensors (Li & An 2025, section 2.2).

A* finds the way on the inflated map with the live obstacles, the timed elastic band drives along it
and round what moves, and a follower keeps to the band. Each new reading is checked against the way
ahead; what would be hit within the stopping distance stops the vehicle. Without a plan recovery
takes over. A drive ends at its goal, or standing and saying why.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from twin.geometry import Array, wrap_angle
from twin.messages import BodyVelocity, Goal, LidarScan, NavigationState, RgbdFrame
from twin.stack.config import DriveLimits, StackConfig
from twin.stack.estimation.site_map import SiteMap
from twin.stack.planning.clearance import (
    Footprint,
    room,
    room_back,
    room_to_turn,
    standing,
)
from twin.stack.planning.look_first import LookFirst
from twin.stack.planning.recovery import Recovery, Stage
from twin.stack.planning.route import Route
from twin.stack.planning.surroundings import Surroundings
from twin.stack.planning.teb import Teb, TebPlan
from twin.stack.planning.tracking import TrajectoryFollower, pose_error
from twin.stack.planning.viewpoint import over_known


@dataclass(frozen=True)
class NavigatorOptions:
    """Not tuned, but where a reason is given."""

    band_period: float = 0.2  # s between bands
    jump: float = 0.5  # m between two ticks: no vehicle drives that
    stand: float = 1.0  # s to come to rest after the believed pose has jumped
    retry: float = 0.4  # s between tries of a vehicle that stands without a plan
    reserve: float = 0.15  # share of the limits that bands leave to the follower's feedback
    squeeze: float = 0.03  # m of room for a vehicle that stands and finds no wider way
    astray: float = 0.10  # m off the reference at which the next band starts from the pose
    astray_turn: float = 0.15  # rad likewise
    closing: float = 1.0  # s before the end from which a good band is not replaced
    touch: float = 0.015  # m of room below which the way ahead is not free
    reaction: float = 0.25  # s added to the stopping time: sensors' latency and period
    estimate: float = 0.15  # s by which the speed of what turns about is known late
    caution: float = 0.5  # s more for what moves: it sees a vehicle that stands
    wait: float = 1.0  # s that it stands for what moves: who creeps on is not seen to stand
    patience: float = 2.0  # s without a plan until recovery
    patience_moving: float = 6.0  # s likewise while something moves near by
    tolerance: float = 0.008  # m of the estimate at a reached goal
    tolerance_yaw: float = math.radians(0.4)
    still: float = 0.01  # m/s and rad/s that count as standing
    settle: float = 2.0  # s at the end of a band for the tolerance
    tries: int = 4  # to come within it
    no_progress: float = 15.0  # s without coming nearer until recovery
    recoveries: int = 4  # of one goal, after which it is given up
    dark: float = 0.6  # s more before unknown ground: with less it creeps on over its edge
    looking: float = 0.3  # s that it stands where it looks from: the pictures come late
    keep: float = 1.2  # m within which recovery forgets nothing: out of the camera's picture


class Navigator:
    """Drives to one goal at a time.

    Args:
        config: the stack's belief.
        floor_map: what stands in the way of the vehicle.
        options: how it is done.
    """

    def __init__(
        self, config: StackConfig, floor_map: SiteMap, options: NavigatorOptions | None = None
    ):
        self.options = options or NavigatorOptions()
        self.footprint = Footprint()
        self.surroundings = Surroundings(config, floor_map, self.footprint)
        self.teb = Teb(_with_reserve(config.drive, self.options.reserve), self.footprint)
        self.follower = TrajectoryFollower(config.drive)
        self.recovery = Recovery()
        self.events: list[str] = []
        self.active, self.outcome = False, ""
        self.replans = self.recoveries = 0  # of this goal
        self._outcomes: list[tuple[str, str]] = []
        self._goal: Goal | None = None
        self._reset()

    # --- asked from outside ----------------------------------------------------------------------

    def go(self, now: float, goal: Goal) -> str:
        """Set out for a goal; another one under way is dropped.

        Returns:
            Empty, or in one line why it is refused; then nothing is changed but the outcome of a
            vehicle that has nothing to do.
        """
        why = self.surroundings.refusal(goal)
        if why:
            self.events.append(f"{goal.name}: {why}")
            if not self.active:
                self.outcome = why
                self._outcomes.append((goal.name, why))
            return why
        if self.active and self._goal is not None:
            self._outcomes.append((self._goal.name, "dropped for another goal"))
        self._reset()
        self._goal, self._pose_goal = goal, np.array(goal.pose, dtype=float)
        self._pose_goal[2] = wrap_angle(self._pose_goal[2])
        self.active, self.outcome = True, ""
        self.replans = self.recoveries = 0
        self.events.append(f"on the way to {goal.name}")
        return ""

    def restart(self, jump: float = math.inf) -> None:
        """Others have moved the vehicle: plan anew to the goal.

        Args:
            jump: m by which the believed pose was corrected meanwhile; if it was little, what was
                seen stays true.
        """
        if jump > self.options.astray:
            self.surroundings.forget(np.zeros(3), keep=0.0)
        self.follower.stop()
        self._reset()

    def hear(self, reading: LidarScan | RgbdFrame, pose_at_exposure: Array | None) -> None:
        """Take a scan or a depth picture, and the localised pose at its exposure."""
        self._fresh = self.surroundings.hear(reading, pose_at_exposure) or self._fresh

    @property
    def state(self) -> NavigationState:
        """For the record."""
        trajectory = self.follower.trajectory
        return NavigationState(
            self._goal.name if self._goal is not None and self.active else "",
            tuple(self._outcomes),
            self.route.xy,
            np.zeros((0, 3)) if trajectory is None else trajectory.nodes[:, :3],
            self.recovery.stage.value if self.recovery.active else "",
        )

    # --- every tick ------------------------------------------------------------------------------

    def step(self, now: float, pose: Array, velocity: Array) -> BodyVelocity:
        """Command of this tick.

        Args:
            now: s.
            pose: localised x, y, yaw in world.
            velocity: vx, vy, omega in base.
        """
        if not (np.all(np.isfinite(pose)) and np.all(np.isfinite(velocity))):
            return BodyVelocity()
        last, self._pose = self._pose, np.array(pose, dtype=float)
        if not self.active:
            return BodyVelocity()
        jump = 0.0 if last is None else float(np.hypot(*(pose[:2] - last[:2])))
        if jump > self.options.jump:  # carried off, and a tag said so: the way starts elsewhere
            self.restart(jump)
            self._due = now + self.options.stand
        if self._giving_up:
            if np.abs(velocity).max() < self.options.still:
                self._end(self._giving_up)
            return BodyVelocity()
        if self.recovery.active:
            return self._recover(now, pose)
        if self._fresh:
            self._fresh = False
            self._look_ahead(now)
            self._watch_progress(now, pose)
            if self._giving_up or self.recovery.active:
                return BodyVelocity()
        if self._brake and self.follower.stopped and self.follower.rate == 0.0:
            self.follower.stop()
            self.teb.reset()
            self._brake, self._due = False, max(now, self._wait_until)
        if self.follower.trajectory is not None and self.follower.remaining == 0.0:
            self._at_end(now, pose, velocity)
            if not self.active:
                return BodyVelocity()
        if now >= self._due:
            self._plan(now, pose, velocity)
        return self.follower.step(pose, self._brake)

    def _look_ahead(self, now: float) -> None:
        """Check the way ahead against what is known now: go on, plan anew, or stop."""
        trajectory = self.follower.trajectory
        self._brake = False
        if trajectory is None:
            self._dark = False
            return
        here, _ = self.follower.reference
        near = self._beside(now, trajectory.nodes[:, :2], here)
        o, phase = self.options, self.follower.phase
        need = min(o.touch, 0.5 * room(here, self.footprint, near))
        still = standing(near)
        touch = trajectory.touch(phase, self.footprint, near[still], need)
        meet = trajectory.touch(phase, self.footprint, near[~still], need)
        # At a steady pace the band takes half the stopping time for the stopping distance.
        whole = self.follower.stopping_time() + o.reaction
        stop = 0.5 * self.follower.stopping_time() + o.reaction
        # What moves may turn about: stop while it still stops too.
        threats = self.surroundings.threats(now, whole + o.estimate, here)
        threat = trajectory.touch(phase, self.footprint, threats, need)
        moving = meet < stop + o.caution or threat < stop
        if moving:
            self._wait_until = now + o.wait
        within = stop + o.dark * (2 if self._dark else 1)  # no braking on and off
        self._dark = self.look.time_left(trajectory, phase, here, within) < math.inf
        self._brake = touch < stop or moving or self._dark
        if min(touch, meet) == math.inf:
            return
        self._due, self._in_the_way = now, True

    def _at_end(self, now: float, pose: Array, velocity: Array) -> None:
        """Where the band has ended: reached, still settling, or on with another band."""
        o = self.options
        if self._ended is None:
            self._ended = now
        if self.look.views and self._ends_at_aim:
            if now - self._ended > o.looking:
                self.follower.stop()
                self.look.views.pop(0)
                self._next_aim()
                self._due = now
            return
        off = pose_error(self._pose_goal, pose)
        away, turn = float(np.hypot(*off[:2])), abs(float(off[2]))
        if not self._ends_at_aim:
            self._due, self._ended = now, None
        elif away < o.tolerance and turn < o.tolerance_yaw and np.abs(velocity).max() < o.still:
            self._end("reached")
        elif now - self._ended > o.settle or away > 3 * o.astray:
            self._tries += 1
            if self._tries >= o.tries:
                self._end(f"stopped {1e3 * away:.0f} mm and {math.degrees(turn):.1f} deg off")
                return
            self.follower.stop()
            self.teb.reset()
            self._due, self._ended = now, None

    # --- planning --------------------------------------------------------------------------------

    def _plan(self, now: float, pose: Array, velocity: Array) -> bool:
        """A new band, along a new way where the old one is blocked. Whether there is one."""
        o = self.options
        moving_on = self.follower.trajectory is not None
        closing = moving_on and self._ends_at_aim and self.follower.remaining < o.closing
        if closing and not self._in_the_way:
            self._due = now + o.band_period
            return True
        start, speed = self._start(pose, velocity)
        reason = self._find_path(now, start)
        if not reason:
            # From here on: the band's horizon must not be used up by the way that lies behind.
            near = self._beside(now, self.route.left(start), start)
            plan = self._band(now, start, speed, near, None if moving_on else o.squeeze)
            reason = plan.reason
            if plan.trajectory is not None:
                if not moving_on and self.look.before(now, plan.trajectory, start):
                    self._next_aim()
                    return self._plan(now, pose, velocity)
                if self.follower.trajectory is not plan.trajectory:
                    self._take(now, plan.trajectory, start)
                self._in_the_way = False
                self._look_ahead(now)
                self._due, self._blocked_since, self._ended = now + o.band_period, None, None
                return True
        if self.look.views:
            self.look.give_up(start)
            self._next_aim()
            return self._plan(now, pose, velocity)
        self._without_plan(now, pose, reason)
        return False

    def _next_aim(self) -> None:
        """On by a new way."""
        self.route, self._ends_at_aim = Route(), False
        self.teb.reset()
        self._ended, self._progress = None, (-math.inf, math.inf)

    @property
    def _aim(self) -> Array:
        """Where it is heading now: the goal, or a place to look from on the way there."""
        return self.look.views[0] if self.look.views else self._pose_goal

    def _band(
        self, now: float, start: Array, speed: Array, near: Array, squeeze: float | None
    ) -> TebPlan:
        """The best band that there is: over ground that was looked at, over any, or squeezed."""
        way, yaw = self.route.xy, self._aim[2]
        unseen, last = self.surroundings.unseen(start), self.teb.last
        if len(unseen):
            plan = self.teb.plan(now, start, speed, way, yaw, np.vstack([near, unseen]))
            if plan.trajectory is not None:
                return plan
            if self.look.views:
                return plan  # it was to be seen first: not worth a risk
            self.teb.last = last  # to start from all the same
        plan = self.teb.plan(now, start, speed, way, yaw, near)
        if plan.trajectory is None and squeeze is not None:
            plan = self.teb.plan(now, start, speed, way, yaw, near, squeeze)
        return plan

    def _take(self, now: float, trajectory, start: Array) -> None:
        if trajectory.began == now:
            self.follower.start(trajectory)
        off = pose_error(self._aim, trajectory.nodes[-1, :3])
        self._ends_at_aim = bool(np.hypot(*off[:2]) < 1e-3 and abs(off[2]) < 1e-3)

    def _start(self, pose: Array, velocity: Array) -> tuple[Array, Array]:
        """Where the next band starts: on the reference, so that it goes on smoothly, if near."""
        if self.follower.trajectory is None:
            return np.array(pose, dtype=float), np.zeros(3)
        reference, speed = self.follower.reference
        off = pose_error(reference, pose)
        if np.hypot(*off[:2]) < self.options.astray and abs(off[2]) < self.options.astray_turn:
            return reference, speed
        return np.array(pose, dtype=float), np.array(velocity, dtype=float)

    def _find_path(self, now: float, start: Array) -> str:
        """Keep the way or find a new one; why there is none, in one line."""
        around, aim = self.surroundings, self._aim
        costs = around.costs_with_lanes(now)
        if self.look.views:
            costs = over_known(costs, around.known, start)
        blocked, reason = self.route.renew(
            now, start, aim, costs, around.unknown_ok, around.approach(aim)
        )
        if blocked:
            self.replans += 1
            self.events.append("the way is blocked: another one is taken")
        return reason

    def _without_plan(self, now: float, pose: Array, reason: str) -> None:
        """No band: the last one is driven on while it is free, then stop, wait, recover."""
        o = self.options
        if self._blocked_since is None:
            self._blocked_since = now
        if self.follower.trajectory is not None and not self._in_the_way:
            self._due = now + o.band_period
            self._brake = self._brake or self.follower.remaining < self.follower.stopping_time()
            return
        self._due = now + (o.retry if self.follower.trajectory is None else o.band_period)
        if self.follower.trajectory is not None:
            return
        moving = self.surroundings.moving(now)
        if now - self._blocked_since > (o.patience_moving if moving else o.patience):
            self._start_recovery(now, pose, reason)

    def _start_recovery(self, now: float, pose: Array, reason: str) -> None:
        self.recoveries += 1
        self.events.append(f"stuck: {reason}")
        self._progress = (now, math.inf)
        if self.recoveries > self.options.recoveries:
            self._giving_up = f"given up: {reason} (recovered {self.recoveries - 1} times before)"
        else:
            self.recovery.start(now, pose, reason)

    def _watch_progress(self, now: float, pose: Array) -> None:
        """Recovery for a vehicle that does not come nearer, whatever the plans say."""
        way = self.route.length_left(pose)
        way += 0.3 * abs(float(wrap_angle(self._aim[2] - pose[2])))
        since, least = self._progress
        if way < least - 0.1 or self._blocked_since is not None:
            self._progress = (now, min(way, least))
        elif way > least + 2.0:  # another way, which is longer
            self._progress = (now, way)
        elif now - since > self.options.no_progress and self.follower.stopped:
            self.follower.stop()
            self.teb.reset()
            self._start_recovery(now, pose, f"no progress for {self.options.no_progress:.0f} s")

    def _recover(self, now: float, pose: Array) -> BodyVelocity:
        near = self.surroundings.about(now, pose)
        turn = room_to_turn(pose, self.footprint, near)
        back = room_back(pose, self.footprint, near)
        step = self.recovery.step(now, pose, self._recovered, turn, back)
        self._recovered = False
        if step.event:
            self.events.append(step.event)
        if step.clear_map:
            self.surroundings.forget(pose, self.options.keep)
        if step.replan:
            self._blocked_since = now  # or it would start recovery again
            self._recovered = self._plan(now, pose, np.zeros(3))
        if step.stage is Stage.GIVEN_UP:
            self._giving_up = self.recovery.reason
        if step.stage is Stage.RECOVERED:
            self._blocked_since = None
        return step.velocity

    # --- inside ----------------------------------------------------------------------------------

    def _beside(self, now: float, way: Array, start: Array) -> Array:
        """What counts for a band along a way, rows as in `clearance`."""
        return self.surroundings.along(now, way, start, self.teb.options.horizon + 1.0)

    def _end(self, outcome: str) -> None:
        assert self._goal is not None
        self.active, self.outcome = False, outcome
        self._outcomes.append((self._goal.name, outcome))
        self.events.append(f"{self._goal.name}: {outcome}")
        self.follower.stop()

    def _say(self, line: str) -> None:
        self.events.append(line)

    def _reset(self) -> None:
        self._pose: Array | None = None  # at the last step
        self.route = Route()
        self._due = -math.inf
        self._brake = self._in_the_way = self._ends_at_aim = self._recovered = False
        self._dark = False  # unknown ground ahead
        self.look = LookFirst(self.surroundings, self.footprint, self._say)
        self._fresh, self._tries = False, 0
        self._blocked_since: float | None = None
        self._ended: float | None = None
        self._giving_up, self._wait_until = "", -math.inf
        self._progress = (-math.inf, math.inf)  # since when the way left is no shorter, m
        self.recovery = Recovery()
        self.teb.reset()


def _with_reserve(drive: DriveLimits, reserve: float) -> DriveLimits:
    """Limits for planning: at the vehicle's own there is nothing left to get back on the way."""
    k = 1.0 - reserve
    return replace(
        drive,
        strafe_speed=k * drive.strafe_speed,
        turn_rate=k * drive.turn_rate,
        acceleration=k * drive.acceleration,
        turn_acceleration=k * drive.turn_acceleration,
    )

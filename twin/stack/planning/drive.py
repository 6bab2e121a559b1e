"""Drive to a pose along way-points: straight, strafe and turn on the spot.

Each leg from pose to pose is one path coordinate from 0 to 1, moved along by a time-optimal profile
of limited jerk (ruckig), which `tracking` follows. A leg that is blocked is held, driven on from
where the vehicle stands once it is free, and given up when it stays blocked.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import ruckig

from twin.geometry import Array, between2, wrap_angle
from twin.messages import BodyVelocity
from twin.stack.config import DriveLimits
from twin.stack.planning.tracking import VelocityLaw, pose_error

TOLERANCE, TOLERANCE_YAW = 0.005, np.radians(0.3)  # m, rad: a way-point is reached
CORNER_WAIT = 0.15  # s at most that a corner waits for its tolerance
SETTLE = 15.0  # s after a leg's end that the vehicle may take to come to rest at its goal
FREE_FOR, PATIENCE = 0.5, 20.0  # s that a held leg must be free, or may be blocked
STOPPED, STOPPED_TURN = 0.005, 0.01  # m/s, rad/s: estimated velocity that counts as standing


class Leg:
    """Motion from rest at one pose to rest at another, in a straight line.

    Args:
        limits: of the vehicle.
        start: x, y, yaw in world.
        goal: likewise.
        began: time at which it starts, s.
    """

    def __init__(self, limits: DriveLimits, start: Array, goal: Array, began: float):
        self.start, self.goal, self.began = np.array(start), np.array(goal), began
        self.change = self.goal - self.start
        self.change[2] = wrap_angle(self.change[2])
        self._trajectory = ruckig.Trajectory(1)
        speed, acceleration, jerk = self._path_limits(limits)
        problem = ruckig.InputParameter(1)
        problem.target_position = [1.0]
        problem.max_velocity = [speed]
        problem.max_acceleration = [acceleration]
        problem.max_jerk = [jerk]
        result = ruckig.Ruckig(1).calculate(problem, self._trajectory)
        if result not in (ruckig.Result.Working, ruckig.Result.Finished):
            raise ValueError(f"leg {self.start} -> {self.goal}: no profile ({result})")

    def _path_limits(self, limits: DriveLimits) -> tuple[float, float, float]:
        """Speed, acceleration and jerk of the path coordinate, 1/s, 1/s^2, 1/s^3.

        Mecanum wheels add up what each direction asks of them, so the shares of the limits must
        add up to one. A leg that turns as it goes may point anywhere: it takes the strafe's speed.
        """
        dx, dy = between2(self.start, self.goal)[:2]
        distance, turn = float(np.hypot(dx, dy)), abs(self.change[2])
        if turn > 0.1:
            along = distance / limits.strafe_speed
        else:
            along = abs(dx) / limits.speed + abs(dy) / limits.strafe_speed
        whole = 1e-9  # a leg of no length takes no time
        speed = along + turn / limits.turn_rate + whole
        acceleration = distance / limits.acceleration + turn / limits.turn_acceleration + whole
        jerk = distance / limits.jerk + turn / limits.turn_jerk + whole
        return 1 / speed, 1 / acceleration, 1 / jerk

    @property
    def duration(self) -> float:
        return self._trajectory.duration

    @property
    def ends(self) -> float:
        """Time at which the reference stands at the goal, s."""
        return self.began + self.duration

    def at(self, now: float) -> tuple[Array, Array, Array]:
        """Reference pose, and its velocity and acceleration in world axes. Shapes (3,)."""
        s, ds, dds = self._trajectory.at_time(min(max(now - self.began, 0.0), self.duration))
        return self.start + s[0] * self.change, ds[0] * self.change, dds[0] * self.change


class Drive:
    """Follows a route of way-points with a short settle at each and a full stop at the last.

    Attributes:
        done: nothing is left to drive.
        failure: why the route was given up, in one line; empty otherwise.
        events: what is worth telling.

    Args:
        limits: of the vehicle.
    """

    def __init__(self, limits: DriveLimits):
        self._limits, self._law = limits, VelocityLaw(limits)
        self._legs: list[Leg] = []
        self._index = 0
        self.done, self.failure = True, ""
        self.events: list[str] = []
        self._held = self._blocked = -math.inf  # s, since when, and when last
        self._command, self._now = np.zeros(3), 0.0

    def start(self, now: float, pose: Array, route: Sequence[Sequence[float]]) -> None:
        """Set out from the fused pose along poses (x, y, yaw) in world; the last is the goal."""
        poses = [np.asarray(pose, dtype=float), *(np.asarray(p, dtype=float) for p in route)]
        self._legs, began = [], now
        for a, b in pairwise(poses):
            self._legs.append(Leg(self._limits, a, b, began))
            began = self._legs[-1].ends
        self._index, self.done, self.failure = 0, not self._legs, ""
        self._held = -math.inf

    def give_up(self, why: str) -> None:
        """Stop here, for good."""
        self.done, self.failure = True, f"gave up a straight leg: {why}"
        self.events.append(self.failure)

    @property
    def leg(self) -> Leg | None:
        """The leg under way; the last one after arrival."""
        return self._legs[self._index] if self._legs else None

    @property
    def last_leg(self) -> bool:
        return self._index == len(self._legs) - 1

    def step(self, now: float, pose: Array, velocity: Array, blocked: bool = False) -> BodyVelocity:
        """Command of this tick.

        Args:
            now: s.
            pose: fused x, y, yaw in world.
            velocity: fused vx, vy, omega in base; used to tell when the vehicle stands.
            blocked: something stands on the leg under way.
        """
        dt, self._now = max(now - self._now, 0.0), now
        if self.done:
            return BodyVelocity()
        if blocked or self._held > -math.inf:
            return self._hold(now, pose, velocity, blocked, dt)
        self._next_leg(now, pose, velocity)
        if self.done:
            return BodyVelocity()
        leg = self._legs[self._index]
        reference, _, _ = leg.at(now)
        _, speed, acceleration = leg.at(now + self._limits.dead_time)
        command = self._law.command(pose, reference, speed, acceleration)
        self._command = command.as_array()
        return command

    def resume(self, now: float, pose: Array) -> None:
        """On with the leg under way from rest here."""
        self._held = -math.inf
        if not self.done:
            goal = self._legs[self._index].goal
            self._legs[self._index] = Leg(self._limits, pose, goal, now)

    def _hold(self, now, pose, velocity, blocked: bool, dt: float) -> BodyVelocity:
        """Brake, and stand until the leg has been free for a while."""
        if self._held == -math.inf:
            self._held = now
            self.events.append("straight leg blocked: waiting")
        self._blocked = now if blocked else self._blocked
        limits = self._limits
        most = dt * np.array([limits.acceleration] * 2 + [limits.turn_acceleration])
        self._command = self._command - np.clip(self._command, -most, most)
        if _stands(velocity) and not self._command.any():
            if now - self._held > PATIENCE:
                x, y, _ = self._legs[self._index].goal
                self.give_up(f"something stands on the way to ({x:.2f}, {y:.2f})")
            elif now - self._blocked > FREE_FOR:
                self.resume(now, pose)
        return BodyVelocity(*(float(v) for v in self._command))

    def _next_leg(self, now: float, pose: Array, velocity: Array) -> None:
        leg = self._legs[self._index]
        if now < leg.ends:
            return
        error = pose_error(leg.goal, pose)
        reached = np.hypot(*error[:2]) < TOLERANCE and abs(error[2]) < TOLERANCE_YAW
        if self.last_leg:
            self.done = bool(reached and _stands(velocity))
            if not self.done and now > leg.ends + SETTLE:
                self.give_up(f"still {1e3 * np.hypot(*error[:2]):.0f} mm off after {SETTLE:.0f} s")
        elif reached or now >= leg.ends + CORNER_WAIT:
            # From where it is: what is left of the error goes into the next leg.
            self._index += 1
            goal = self._legs[self._index].goal
            self._legs[self._index] = Leg(self._limits, pose, goal, now)


def _stands(velocity: Array) -> bool:
    return bool(np.hypot(*velocity[:2]) < STOPPED and abs(velocity[2]) < STOPPED_TURN)

"""Timed elastic band for an omnidirectional, rectangular vehicle (Roesmann et al. 2012, 2017).

Li & An 2025, section 2.2, avoid what turns up on the way with it. A band of timed poses is pulled
short in time by Levenberg-Marquardt, under limits of velocity and acceleration and the true
rectangle's room to obstacles, the moving ones where they will be. Bands that pass an obstacle on
either side are tried and the best is driven. The terms are soft; a hard check follows, and a band
that fails it is not handed out.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from twin.geometry import Array, rot2, wrap_angle
from twin.stack.config import DriveLimits
from twin.stack.planning.clearance import (
    AX,
    AY,
    BX,
    BY,
    VX,
    VY,
    Footprint,
    no_obstacles,
    obstacle_fault,
    room,
    standing,
)
from twin.stack.planning.teb_check import fault, room_fault, rooms_kept, shares
from twin.stack.planning.teb_retime import retimed
from twin.stack.planning.teb_seeds import PASSES, bent, headings, smoothed, spaced, timed
from twin.stack.planning.teb_solver import Weights, limits_of, optimise, resized
from twin.stack.planning.teb_trajectory import Trajectory


@dataclass(frozen=True)
class TebOptions:
    """How the band is laid. Not tuned."""

    horizon: float = 5.0  # m of the way that one band covers
    step: float = 0.3  # s between nodes
    most: int = 60  # nodes
    room: float = 0.04  # m that must be kept to every obstacle: the hard check
    first: int = 12  # iterations that every alternative gets
    rounds: tuple[float, ...] = (1.0, 4.0, 12.0)  # weights of limits and room, round by round
    iterations: int = 16  # of each round
    tolerance: float = 5e-4  # relative gain at which a round ends
    keep: float = 0.9  # the last band's cost counts that much: no swinging between sides
    astray: float = 0.05  # m off the last trajectory at which it is given up
    tries: int = 3  # alternatives brought to the end, best first
    weights: Weights = field(default_factory=Weights)


@dataclass(frozen=True)
class TebPlan:
    """A trajectory, or None and why.

    Args:
        trajectory: keeps every limit and the room, and ends at rest.
        reason: one line; empty with a trajectory.
        alternatives: bands that were tried.
    """

    trajectory: Trajectory | None
    reason: str = ""
    alternatives: int = 0


class Teb:
    """Local planner; keeps its last band to start from.

    Args:
        drive: limits of the vehicle.
        footprint: its rectangle.
        options: how the band is laid.
    """

    def __init__(
        self,
        drive: DriveLimits,
        footprint: Footprint | None = None,
        options: TebOptions | None = None,
    ):
        self._limits = limits_of(drive)
        self._speed = drive.speed
        self.footprint, self.options = footprint or Footprint(), options or TebOptions()
        self.last: Trajectory | None = None

    def reset(self) -> None:
        """Forget the last band."""
        self.last = None

    def plan(
        self,
        now: float,
        pose: Array,
        velocity: Array,
        path: Array,
        goal_yaw: float,
        obstacles: Array | None = None,
        keep: float | None = None,
    ) -> TebPlan:
        """Band from a pose along a path, to its end or to the horizon.

        Args:
            now: s.
            pose: x, y, yaw in world. Shape (3,).
            velocity: vx, vy, omega in base. Shape (3,).
            path: of the global planner, in world; its first point near the vehicle. Shape (n, 2).
            goal_yaw: at the path's end, rad.
            obstacles: rows as in `clearance`, where they are now. Shape (m, 7).
            keep: m of room to every obstacle; without it the options' `room`.
        """
        keep = self.options.room if keep is None else keep
        around: Array = no_obstacles() if obstacles is None else obstacles
        pose, velocity, path = (np.asarray(a, dtype=float) for a in (pose, velocity, path))
        reason = self._input_fault(now, pose, velocity, path, goal_yaw, around)
        if reason is not None:
            return TebPlan(None, reason)
        around = np.ascontiguousarray(around, dtype=float)
        reference, goal = self._free_end(pose, path, goal_yaw, around)
        for name, place, near in (
            ("start", pose, around),
            ("goal", goal, around[standing(around)]),
        ):
            if room(place, self.footprint, near) <= 0:
                self.last = None
                return TebPlan(None, f"{name} ({place[0]:.2f}, {place[1]:.2f}) touches an obstacle")
        bands = self._seeds(pose, velocity, reference, goal, around)
        warm = self._moved_on(now, pose, goal)
        if warm is not None:
            bands.insert(0, warm)
        ends = np.zeros((2, 3))
        ends[0, :2], ends[0, 2] = rot2(pose[2]) @ velocity[:2], velocity[2]
        rooms = rooms_kept(pose, goal, self.footprint, around, keep)
        ranked = sorted(
            (self._relaxed(band, ends, around, 0), k, band) for k, band in enumerate(bands)
        )
        if warm is not None:
            ranked = sorted(
                (c * (self.options.keep if k == 0 else 1.0), k, b) for c, k, b in ranked
            )
        reason = "no band"
        for cost, _, band in ranked[: self.options.tries]:
            if not math.isfinite(cost):
                continue
            nodes, why = self._finished(band, ends, around, rooms)
            if why is None:
                self.last = Trajectory(nodes, velocity, now)
                return TebPlan(self.last, "", len(bands))
            reason = why if reason == "no band" else reason
        if self._still_good(now, pose, goal, around, rooms):
            return TebPlan(self.last, "", len(bands))
        self.last = None
        return TebPlan(None, reason, len(bands))

    def _still_good(self, now: float, pose: Array, goal: Array, obstacles: Array, rooms) -> bool:
        """Whether the last trajectory is being followed and keeps its room from here on.

        Its limits were checked when it was made. Close to its end, where there is no slack left,
        a new band may not be found in time although there is nothing wrong with the old one.
        """
        if self.last is None or not 0 <= now - self.last.began < self.last.duration:
            return False
        expected, _ = self.last.at(now)
        off = float(np.hypot(expected[0] - pose[0], expected[1] - pose[1]))
        if off > self.options.astray or abs(wrap_angle(expected[2] - pose[2])) > 0.1:
            return False
        if np.hypot(*(goal[:2] - self.last.nodes[-1, :2])) > 1.0:  # it is for another goal
            return False
        elapsed = now - self.last.began
        then = obstacles.copy()  # where they were, or would have been, when it began
        then[:, [AX, BX]] -= elapsed * obstacles[:, [VX]]
        then[:, [AY, BY]] -= elapsed * obstacles[:, [VY]]
        nodes = self.last.nodes
        first = int(np.searchsorted(nodes[:, 3], elapsed, side="right")) - 1
        start = np.zeros(3)
        start[:2] = rot2(nodes[0, 2]) @ self.last.velocity[:2]
        start[2] = self.last.velocity[2]
        return room_fault(nodes, start, self.footprint, then, rooms, first) is None

    def _input_fault(self, now, pose, velocity, path, goal_yaw, obstacles) -> str | None:
        if pose.shape != (3,) or velocity.shape != (3,):
            return f"pose {pose.shape} and velocity {velocity.shape}: wanted (3,) each"
        if path.ndim != 2 or path.shape[1] != 2 or len(path) == 0:
            return f"path: shape {path.shape}, wanted (n, 2)"
        finite = [np.all(np.isfinite(a)) for a in (now, pose, velocity, path, goal_yaw)]
        if not all(finite):
            return "pose, velocity, path or goal is not finite"
        return obstacle_fault(obstacles)

    def _free_end(self, pose, path, goal_yaw, obstacles) -> tuple[Array, Array]:
        """Reference and the pose at its end; the horizon is drawn in where nothing could stand."""
        still, length = obstacles[standing(obstacles)], self.options.horizon
        still = np.ascontiguousarray(still)
        for share in (1.0, 0.8, 0.6, 0.4):
            reference, goal, whole = self._ahead(pose, path, goal_yaw, share * length)
            if whole:
                return reference, goal
            goal = self._headed(pose, reference, goal, still)
            if room(goal, self.footprint, still) > self.options.room:
                return reference, goal
        reference, goal, _ = self._ahead(pose, path, goal_yaw, length)
        return reference, goal

    def _headed(self, pose: Array, reference: Array, goal: Array, still: Array) -> Array:
        """Pose at the horizon, headed as the way there is driven best: ahead, reversed, as now."""
        best, least = goal, math.inf
        for yaw in (goal[2], goal[2] + math.pi, pose[2]):
            _, cost = headings(reference, pose[2], yaw, self._limits, self.footprint.half, still)
            if self.last is not None and abs(wrap_angle(yaw - self.last.nodes[-1, 2])) < 0.5:
                cost *= self.options.keep
            if cost < least:
                best, least = np.array([goal[0], goal[1], float(wrap_angle(yaw))]), cost
        return best

    def _ahead(
        self, pose: Array, path: Array, goal_yaw: float, horizon: float
    ) -> tuple[Array, Array, bool]:
        """Reference (k, 2) to the horizon, the pose at its end, whether that is the path's end."""
        nearest = int(np.argmin(np.hypot(*(path - pose[:2]).T)))
        rest = path[nearest + 1 :] if nearest + 1 < len(path) else path[-1:]
        points = spaced(np.vstack([pose[:2], rest]))
        s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
        whole = bool(s[-1] <= horizon)
        kept = points if whole else points[s <= horizon]
        kept = smoothed(kept, PASSES)
        if whole:
            return kept, np.array([*kept[-1], goal_yaw]), True
        back = kept[-1] - kept[-min(8, len(kept))]
        return kept, np.array([*kept[-1], math.atan2(back[1], back[0])]), False

    def _seeds(self, pose, velocity, reference, goal, obstacles) -> list[Array]:
        """Bands along the reference and its bends."""
        bands, still = [], np.ascontiguousarray(obstacles[standing(obstacles)])
        o = self.options
        wide = o.weights.room + 0.02
        for path in bent(reference, obstacles, self.footprint, wide, 0.8 * self._speed):
            yaw, _ = headings(path, pose[2], goal[2], self._limits, self.footprint.half, still)
            first = path[min(3, len(path) - 1)] - path[0]
            size = float(np.hypot(*first))
            along = rot2(pose[2]) @ velocity[:2]
            speed = float(along @ first) / size if size > 1e-9 else 0.0
            bands.append(timed(path, yaw, max(speed, 0.0), self._limits, o.step, o.most))
        return bands

    def _moved_on(self, now: float, pose: Array, goal: Array) -> Array | None:
        """The last band from here on, to the goal; None if it does not fit any more."""
        if self.last is None:
            return None
        elapsed = now - self.last.began
        nodes = self.last.nodes
        expected, _ = self.last.at(now)
        off = np.hypot(*(expected[:2] - pose[:2])), abs(wrap_angle(expected[2] - pose[2]))
        left = nodes[nodes[:, 3] > elapsed + 0.3 * self.options.step]
        gap = float(np.hypot(*(goal[:2] - nodes[-1, :2])))
        if elapsed < 0 or len(left) < 4 or off[0] > 0.2 or off[1] > 0.3 or gap > 1.0:
            return None
        here = pose[2] + 2 * math.pi * round((left[0, 2] - pose[2]) / (2 * math.pi))
        band = np.vstack([[*pose[:2], here, elapsed], left])
        band[:, 3] -= elapsed
        final = band[-1, 2] + wrap_angle(goal[2] - band[-1, 2])
        turn = abs(final - band[-1, 2])
        end = [goal[0], goal[1], final, 0.0]
        if gap < 0.15 and turn < 0.3:
            band[-1, :3] = end[:3]
        else:  # the horizon has moved on
            time = gap * self._limits.strafe + turn * self._limits.turn
            pieces = max(math.ceil(time / self.options.step), 1)
            end[3] = band[-1, 3] + time
            more = np.linspace(band[-1], end, pieces + 1)[1:]
            band = np.vstack([band, more])
        return band if len(band) <= self.options.most else None

    def _weights(self, factor: float) -> Weights:
        w = self.options.weights
        return w._replace(
            velocity=w.velocity * factor,
            acceleration=w.acceleration * factor,
            obstacle=w.obstacle * factor,
        )

    def _relaxed(self, band: Array, ends: Array, obstacles: Array, k: int) -> float:
        """Improve a band in place for a few iterations; its time plus what it violates."""
        o = self.options
        cost = optimise(
            band, ends, obstacles, self.footprint.half, self._limits,
            self._weights(o.rounds[k]), o.first if k == 0 else o.iterations, o.tolerance,
        )  # fmt: skip
        pull = float(np.sum((o.weights.time * np.diff(band[:, 3])) ** 2))
        return float(band[-1, 3]) + (cost - pull)

    def _finished(self, band, ends, obstacles, rooms) -> tuple[Array, str | None]:
        """Band after all rounds, and what the hard check has against it."""
        o = self.options
        for k in range(1, len(o.rounds)):
            if k == 1:
                band = resized(band, o.step, o.most)
            self._relaxed(band, ends, obstacles, k)
        w = self.options.weights
        fast = retimed(band, ends[0], self._limits, w.speed_share, w.push_share)
        why: str | None = "no band"
        for times in (fast, band):  # the slower one may let something pass that moves
            times = self._slowed(times, ends)
            why = fault(times, ends, self._limits, self.footprint, obstacles, rooms)
            if why is None:
                return times, None
        return band, why

    def _slowed(self, band: Array, ends: Array) -> Array:
        """What soft limits leave over is taken back by driving a little slower."""
        slower = band.copy()
        for _ in range(6):
            speed, push = shares(slower, ends, self._limits)
            over = max(speed, math.sqrt(push))
            if not 1 < over < 1.5:
                break
            slower[:, 3] *= 1 + 1.1 * (over - 1) + 1e-7  # rounded shares fall a little slower
        return slower

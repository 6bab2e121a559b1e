"""Finding the way back after the vehicle was carried off: drive carefully until the map is sure.

No pose is known, so nothing here asks for one: the vehicle keeps to the middle of whatever way is
free. That changes what the lidar sees, and floor tags lie on the middle of the aisles.
"""

import numpy as np

from twin.geometry import Array
from twin.messages import BodyVelocity
from twin.stack.estimation.localiser import Localiser
from twin.stack.tasks.careful_drive import (
    CarefulLimits,
    DepthMemory,
    best_arc,
    closed_fronts,
    free_length,
    middle,
)

LOOK, LOOK_MOST = 0.8, 4.0  # s standing first: scans of one place gather the particles
AT_REST = 0.03  # m/s and rad/s
BOXED = 1.0  # s without a way after which what is remembered is forgotten, and seen anew
PLAN = 0.05  # s between looks at the way; the lidar sends every 0.1 s
ENOUGH = 0.45  # m of free way that is worth driving off
PLENTY = 0.80  # m of free way after which a turn on the spot ends
ACCELERATION, TURN_ACCELERATION = 0.6, 1.5  # m/s^2, rad/s^2: below what the tyres hold
CENTRING, CENTRING_SPEED = 0.6, 0.08  # 1/s and m/s at most, towards the middle of the way
ESCAPE = 0.12  # m/s out of a place where the vehicle can neither go on nor turn


class Relocaliser:
    """Drives the vehicle while it is lost.

    Call `start` when the localiser is lost and `step` each tick after that, until `done`.

    Attributes:
        done: the localiser is sure again; the command is to stand.
        reason: what it is doing, in a few words.
    """

    def __init__(self, limits: CarefulLimits | None = None):
        self._limits = limits or CarefulLimits()
        self._memory = DepthMemory(self._limits)
        self.start(0.0)

    def start(self, now: float) -> None:
        """Begin anew; what was seen before the vehicle was carried off is forgotten."""
        self._memory.clear()
        self._began, self._planned = now, -np.inf
        self._now = now
        self._wanted = np.zeros(3)
        self._command = np.zeros(3)
        self._turning = 0.0  # direction of a turn on the spot under way
        self._looking, self._boxed_since = True, np.inf
        self.done, self.reason = False, "standing to look around"

    def step(
        self,
        now: float,
        scan_points_base: Array,
        depth_points_base: Array | None,
        localiser: Localiser,
    ) -> BodyVelocity:
        """Command of this tick.

        Args:
            now: s.
            scan_points_base: end points of the last scan in the order of its beams, in base, m.
                Shape (n, 2).
            depth_points_base: what the depth camera sees within the vehicle's height, in base, m.
                Shape (n, 2); None without a new picture.
            localiser: asked for its odometry and whether it is still lost.
        """
        dt, self._now = max(now - self._now, 0.0), now
        if depth_points_base is not None and not self._looking:
            self._memory.add(now, depth_points_base, localiser.fused.pose(now))
        if not localiser.lost:
            self.done, self.reason = True, "found"
            self._wanted = np.zeros(3)
        elif self._looking and not self._looked(now, localiser):
            self._wanted = np.zeros(3)
        elif now - self._planned >= PLAN:
            self._planned = now
            odometry = localiser.fused.pose(now)
            scan = np.asarray(scan_points_base, dtype=float).reshape(-1, 2)
            scan = scan[np.hypot(*scan.T) < 3.0]
            seen = np.concatenate(
                [scan[::3], closed_fronts(scan), self._memory.points(now, odometry)]
            )
            self._wanted = self._plan(seen)
        most = np.array([ACCELERATION, ACCELERATION, TURN_ACCELERATION]) * dt
        self._command = self._command + np.clip(self._wanted - self._command, -most, most)
        return BodyVelocity(*(float(v) for v in self._command))

    def _looked(self, now: float, localiser: Localiser) -> bool:
        """Whether it has stood long enough, at rest in the odometry's eyes too.

        Odometry that has not noticed yet that the vehicle was stopped would smear what is seen.
        """
        waited = now - self._began
        at_rest = float(np.max(np.abs(localiser.velocity))) < AT_REST
        self._looking = not (
            waited >= LOOK and localiser.ready and (at_rest or waited >= LOOK_MOST)
        )
        return not self._looking

    def _plan(self, points: Array) -> Array:
        """Velocity in base that goes on along the free way, shape (3,)."""
        limits = self._limits
        arc, length = best_arc(points, limits, float(self._command[2]))
        if length >= (PLENTY if self._turning else ENOUGH):
            self._turning = 0.0
            self.reason = "driving on along the free way"
            slow = min(1.0, length / limits.ahead + 0.2)
            across = float(np.clip(CENTRING * middle(points), -CENTRING_SPEED, CENTRING_SPEED))
            if free_length(points, (0.0, np.sign(across) * 0.1, 0.0), limits)[0] < 0.10:
                across = 0.0
            return np.array([arc[0] * slow, across, arc[2] * slow])
        return self._turn(points)

    def _turn(self, points: Array) -> Array:
        """On the spot, to the side with more room; sideways or back where it cannot turn."""
        limits = self._limits
        if not self._turning:
            left, right = (self._openness(points, side) for side in (1.0, -1.0))
            self._turning = 1.0 if left >= right else -1.0
        for direction in (self._turning, -self._turning):
            turn = (0.0, 0.0, direction * 0.5 * limits.turn_rate)
            if free_length(points, turn, limits)[0] >= 0.15:
                self._turning = direction
                self.reason = "turning on the spot"
                return np.array(turn)
        ways = [(0.0, ESCAPE, 0.0), (0.0, -ESCAPE, 0.0), (-ESCAPE, 0.0, 0.0), (ESCAPE, 0.0, 0.0)]
        free = [free_length(points, way, limits)[0] for way in ways]
        best = int(np.argmax(free))
        if free[best] < 0.10:
            self.reason = "boxed in: no way is free"
            self._boxed_since = min(self._boxed_since, self._now)
            if self._now - self._boxed_since > BOXED:
                self._memory.clear()
                self._boxed_since = np.inf
            return np.zeros(3)
        self._boxed_since = np.inf
        self.reason = "moving away from what is near"
        return np.array(ways[best])

    @staticmethod
    def _openness(points: Array, side: float) -> float:
        """Mean distance of what is on one side, m."""
        beside = points[side * points[:, 1] > 0.2]
        return float(np.mean(np.hypot(*beside.T))) if len(beside) else 3.0

"""What the timed elastic band hands on: a trajectory."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit

from twin.geometry import Array, rot2
from twin.stack.planning.clearance import Footprint, nearest
from twin.stack.planning.teb_terms import twist_between

STEP, STEP_TURN = 0.02, 0.04  # m, rad between the poses at which the room is checked


@dataclass(frozen=True)
class Trajectory:
    """Timed poses that end at rest.

    Args:
        nodes: x, y, yaw (unwrapped) in world, and time. Shape (n, 4).
        velocity: vx, vy, omega in base at the start. Shape (3,).
        began: time of the first node, s.
    """

    nodes: Array
    velocity: Array
    began: float = 0.0

    @property
    def duration(self) -> float:
        return float(self.nodes[-1, 3])

    @property
    def dt(self) -> Array:
        """Time differences of the band, s. Shape (n - 1,)."""
        return np.diff(self.nodes[:, 3])

    @property
    def length(self) -> float:
        """Metres."""
        return float(np.hypot(*np.diff(self.nodes[:, :2], axis=0).T).sum())

    @cached_property
    def twists(self) -> Array:
        """Twist in base of each piece. Shape (n - 1, 3)."""
        return np.array(
            [twist_between(a, b) for a, b in zip(self.nodes[:-1], self.nodes[1:], strict=True)]
        )

    @cached_property
    def _velocities(self) -> Array:
        """Velocity in world at each node. Shape (n, 3)."""
        start = np.array([*(rot2(self.nodes[0, 2]) @ self.velocity[:2]), self.velocity[2]])
        return node_velocities(self.nodes, start)

    @cached_property
    def _knots(self) -> tuple[Array, Array]:
        """Times from the start, and velocities in base between which is interpolated."""
        times = self.nodes[:, 3]
        middles = np.concatenate([[times[0]], 0.5 * (times[1:] + times[:-1]), [times[-1]]])
        return middles, np.vstack([self.velocity, self.twists, np.zeros(3)])

    def touch(
        self, phase: float, footprint: Footprint, obstacles: Array, need: float = 0.0
    ) -> float:
        """Seconds from `phase` on until the room falls below `need` m; inf if it never does.

        Args:
            phase: s from the start.
            footprint: of the vehicle.
            obstacles: rows as in `clearance`, where they are at `phase`.
            need: m.
        """
        return float(
            first_touch(
                self.nodes, self._velocities, footprint.half, np.ascontiguousarray(obstacles),
                phase, need, STEP, STEP_TURN,
            )
            - phase
        )  # fmt: skip

    def at(self, now: float) -> tuple[Array, Array]:
        """Pose in world and velocity in base at a time; at rest past the end. Shapes (3,)."""
        return self.motion(now - self.began)[:2]

    def motion(self, phase: float) -> tuple[Array, Array, Array]:
        """Pose in world, velocity and its rate of change in base, `phase` s after the start.

        The pose runs smoothly through the nodes. The velocity is interpolated between the middles
        of the pieces: the limits, which are convex, hold for it too. (The pose's own rate of change
        passes them by a few per cent where the velocity bends sharply.)
        """
        t = min(max(phase, 0.0), self.duration)
        return _motion(self.nodes, self._velocities, *self._knots, t)


@njit(cache=True)
def _motion(nodes, velocities, middles, known, t):
    """Pose, velocity and rate of change of the velocity at a time from the start."""
    i = min(max(np.searchsorted(nodes[:, 3], t, side="right") - 1, 0), nodes.shape[0] - 2)
    part = (t - nodes[i, 3]) / (nodes[i + 1, 3] - nodes[i, 3])
    x, y, yaw = between(nodes, velocities, i, part)
    yaw -= 2 * np.pi * np.ceil((yaw - np.pi) / (2 * np.pi))
    pose = np.array([x, y, yaw])
    k = min(max(np.searchsorted(middles, t, side="right") - 1, 0), middles.shape[0] - 2)
    rate = (known[k + 1] - known[k]) / max(middles[k + 1] - middles[k], 1e-9)
    if t >= nodes[-1, 3]:
        return pose, np.zeros(3), np.zeros(3)
    return pose, known[k] + (t - middles[k]) * rate, rate


@njit(cache=True)
def node_velocities(nodes, start):
    """Velocity in world at each node, exact under constant acceleration; rest at the end. (n, 3)"""
    n = nodes.shape[0]
    out = np.zeros((n, 3))
    out[0] = start
    for i in range(1, n - 1):
        d1, d2 = nodes[i, 3] - nodes[i - 1, 3], nodes[i + 1, 3] - nodes[i, 3]
        for k in range(3):
            v1, v2 = (nodes[i, k] - nodes[i - 1, k]) / d1, (nodes[i + 1, k] - nodes[i, k]) / d2
            out[i, k] = (d2 * v1 + d1 * v2) / (d1 + d2)
    return out


@njit(cache=True)
def between(nodes, velocities, i, part):
    """Pose (x, y, yaw) at a part, 0 to 1, of piece i: cubic through poses and velocities."""
    dt = nodes[i + 1, 3] - nodes[i, 3]
    a, b = part * part * (3 - 2 * part), part * (1 - part)
    x = nodes[i, :3] + a * (nodes[i + 1, :3] - nodes[i, :3])
    x += dt * b * ((1 - part) * velocities[i] - part * velocities[i + 1])
    return x[0], x[1], x[2]


@njit(cache=True)
def first_touch(nodes, velocities, half, obstacles, phase, need, step, step_turn):
    """Earliest time, s from the start, at which a band comes nearer than `need`; inf if never.

    Args:
        nodes: shape (n, 4).
        velocities: in world at the nodes. Shape (n, 3).
        half: half length and half width of the footprint. Shape (2,).
        obstacles: rows as in `clearance`, where they are at `phase`. Shape (m, 7).
        phase: from where on to look, s.
        need: m of room.
        step, step_turn: m, rad between the poses that are looked at.
    """
    for i in range(nodes.shape[0] - 1):
        a, b = nodes[i], nodes[i + 1]
        if b[3] <= phase:
            continue
        way = np.hypot(b[0] - a[0], b[1] - a[1]) / step
        pieces = max(int(np.ceil(max(way, abs(b[2] - a[2]) / step_turn))), 1)
        for k in range(pieces + 1):
            t = a[3] + k / pieces * (b[3] - a[3])
            if t < phase:
                continue
            x, y, yaw = between(nodes, velocities, i, k / pieces)
            if nearest(x, y, yaw, t - phase, half, obstacles)[0] < need:
                return t
    return np.inf

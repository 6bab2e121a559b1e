"""What the timed elastic band hands on: a trajectory, and the proof that it keeps its promises."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit

from twin.geometry import Array, rot2
from twin.stack.planning.clearance import Footprint, nearest, room, standing
from twin.stack.planning.teb_terms import (
    Limits,
    acceleration_terms,
    twist_between,
    velocity_terms,
)

STEP, STEP_TURN = 0.02, 0.04  # m, rad between the poses at which the room is checked
SLACK = 1e-6  # of a limit
SHORTEST = 0.02  # s between nodes at least
STRETCH, SWEEPS = 1.02, 60  # by which a piece is slowed at a time; times over the band


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
def shares(nodes, ends, limits):
    """Greatest share of the limits of velocity and of acceleration that a band takes."""
    n = nodes.shape[0]
    J = np.zeros((3, 12))
    speed, push = 0.0, 0.0
    for i in range(n - 1):
        if nodes[i + 1, 3] <= nodes[i, 3]:
            return np.inf, np.inf
        ux, uy, uw = velocity_terms(nodes[i], nodes[i + 1], limits, J[:, :8])
        speed = max(speed, abs(ux) + abs(uy) + abs(uw))
    for i in range(n):
        kind = 1 if i == 0 else (2 if i == n - 1 else 0)
        before = ends[0] if i == 0 else nodes[i - 1]
        after = nodes[i + 1] if i < n - 1 else nodes[i]
        size, turn = acceleration_terms(before, nodes[i], after, ends[1], kind, limits, J[:2])
        push = max(push, size + abs(turn))
    return speed, push


@njit(cache=True)
def least_room(nodes, start, half, obstacles, step, step_turn, first=0):
    """Least room all along a band, as it is driven: metres, row of the obstacle, x, y, yaw, t.

    Args:
        nodes: shape (n, 4).
        start: velocity in world at the start. Shape (3,).
        half: half length and half width of the footprint. Shape (2,).
        obstacles: rows as in `clearance`. Shape (m, 7).
        step, step_turn: m, rad between the poses that are looked at.
        first: piece from which on to look.
    """
    worst = (np.inf, -1, 0.0, 0.0, 0.0, 0.0)
    velocities = node_velocities(nodes, start)
    for i in range(first, nodes.shape[0] - 1):
        a, b = nodes[i], nodes[i + 1]
        way = np.hypot(b[0] - a[0], b[1] - a[1]) / step
        pieces = max(int(np.ceil(max(way, abs(b[2] - a[2]) / step_turn))), 1)
        for k in range(pieces + 1):
            x, y, yaw = between(nodes, velocities, i, k / pieces)
            t = a[3] + k / pieces * (b[3] - a[3])
            d, which = nearest(x, y, yaw, t, half, obstacles)
            if d < worst[0]:
                worst = (d, which, x, y, yaw, t)
    return worst


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


@njit(cache=True)
def retimed(nodes, start, limits, speed_share, push_share):
    """Band along the same poses as fast as the limits allow. Shape (n, 4).

    The solver of the band trades time against soft terms and stops short of the fastest. Here every
    piece begins at its limit of velocity and is slowed only where a node's acceleration asks for
    it, back and forth until all is kept; a way with no such times comes back as it is.

    Args:
        nodes: shape (n, 4).
        start: velocity in world at the start. Shape (3,).
        limits: of the vehicle.
        speed_share, push_share: of the limits of velocity and acceleration that are used.
    """
    n = nodes.shape[0]
    d = np.empty((n + 1, 3))  # from node to node; the first and the last stand for the ends
    dt = np.ones(n + 1)
    J = np.zeros((3, 8))
    d[0], d[n] = start, 0.0
    for i in range(1, n):
        ux, uy, uw = velocity_terms(nodes[i - 1], nodes[i], limits, J)
        share = abs(ux) + abs(uy) + abs(uw)
        dt[i] = max(share * (nodes[i, 3] - nodes[i - 1, 3]) / speed_share, SHORTEST)
        d[i] = nodes[i, :3] - nodes[i - 1, :3]
    kept = False
    for sweep in range(SWEEPS):
        kept = True
        for k in range(1, n + 1):
            j = k if sweep % 2 == 0 else n + 1 - k  # the node between pieces j - 1 and j
            if _excess(d, dt, j, limits, push_share) <= 0:
                continue
            kept = False
            for _ in range(80):
                over = _excess(d, dt, j, limits, push_share)
                if over <= 0:
                    break
                best, which = over, -1
                for piece in (j - 1, j):
                    if 1 <= piece < n:
                        dt[piece] *= STRETCH
                        now = _excess(d, dt, j, limits, push_share)
                        dt[piece] /= STRETCH
                        if now < best:
                            best, which = now, piece
                if which < 0:
                    return nodes.copy()
                dt[which] *= STRETCH
        if kept:
            break
    out = nodes.copy()
    if kept:
        for i in range(1, n):
            out[i, 3] = out[i - 1, 3] + dt[i]
    return out


@njit(cache=True)
def _excess(d, dt, j, limits, push_share):
    """By how much the change of velocity between pieces j - 1 and j passes its limit, seconds."""
    last = d.shape[0] - 1
    first = 0.0 if j == 1 else dt[j - 1]
    second = 0.0 if j == last else dt[j]
    dx = d[j, 0] / dt[j] - d[j - 1, 0] / dt[j - 1]
    dy = d[j, 1] / dt[j] - d[j - 1, 1] / dt[j - 1]
    dw = d[j, 2] / dt[j] - d[j - 1, 2] / dt[j - 1]
    push = limits.push * np.sqrt(dx * dx + dy * dy) + limits.twist * abs(dw)
    return push - push_share * 0.5 * (first + second)


def fault(
    nodes: Array, ends: Array, limits: Limits, footprint: Footprint, obstacles: Array, rooms: Array
) -> str | None:
    """Why a band must not be driven, in one line, or None.

    Args:
        nodes: shape (n, 4).
        ends: velocity in world at start and end. Shape (2, 3).
        limits: of the vehicle.
        footprint: of the vehicle.
        obstacles: rows as in `clearance`. Shape (m, 7).
        rooms: that must be kept to each, m. Shape (m,).
    """
    if not np.all(np.isfinite(nodes)):
        return "the band is not finite"
    speed, push = shares(nodes, ends, limits)
    if speed > 1 + SLACK:
        return f"a limit of velocity is exceeded {speed:.3f} times"
    if push > 1 + SLACK:
        return f"a limit of acceleration is exceeded {push:.3f} times"
    return room_fault(nodes, ends[0], footprint, obstacles, rooms)


def rooms_kept(
    pose: Array, goal: Array, footprint: Footprint, obstacles: Array, most: float
) -> Array:
    """Room to be kept to each obstacle, m: less where it starts or must end closer. Shape (m,)."""
    rooms, still = np.full(len(obstacles), most), standing(obstacles)
    for k in range(len(obstacles)):
        one = obstacles[k : k + 1]
        for place in (pose, goal) if still[k] else (pose,):
            d = room(place, footprint, one)
            if d < rooms[k]:
                # Hardly less than it is: each band starts from the last one's room, and a tenth
                # less every time would soon be none.
                rooms[k] = 0.99 * d
    return rooms


def room_fault(
    nodes: Array, start: Array, footprint: Footprint, obstacles: Array, rooms: Array, first: int = 0
) -> str | None:
    """Where a band comes too near to an obstacle from a piece on, in one line, or None."""
    for need in np.unique(rooms):
        some = np.ascontiguousarray(obstacles[rooms == need])
        least, which, x, y, _, t = least_room(
            nodes, start, footprint.half, some, STEP, STEP_TURN, first
        )
        if which >= 0 and least < need:
            return (
                f"{least:.3f} m of room at ({x:.2f}, {y:.2f}) after {t:.1f} s,"
                f" {need:.3f} m are needed"
            )
    return None

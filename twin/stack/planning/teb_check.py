"""Proof that a timed elastic band keeps its promises: limits, and room all along."""

import numpy as np
from numba import njit

from twin.geometry import Array
from twin.stack.planning.clearance import Footprint, nearest, room, standing
from twin.stack.planning.teb_terms import Limits, acceleration_terms, velocity_terms
from twin.stack.planning.teb_trajectory import STEP, STEP_TURN, between, node_velocities

SLACK = 1e-6  # of a limit


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

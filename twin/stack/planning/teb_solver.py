"""Levenberg-Marquardt for the timed elastic band, on banded normal equations.

A term ties at most three nodes of four variables together, so the normal matrix has 11 diagonals
below its own; it is stored as `A[i, k] = H[i, i - k]` and solved by a banded Cholesky
factorisation, in time linear in the number of nodes.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from twin.stack.planning.clearance import AX, AY, BX, BY, RADIUS, VX, VY, clearance, to_segment
from twin.stack.planning.teb_terms import Limits, acceleration_terms, velocity_terms

BAND = 12  # diagonals stored
PARTS = 3  # lengths tried of one step
HOLD = 1e5  # damping of time differences over that of the rest
MAX_TURN = 2.0  # rad between nodes, past which an arc makes no sense


class Weights(NamedTuple):
    """Square roots of the weights, and where the terms set in. Not tuned but for their order."""

    time: float = 1.0  # 1/s
    velocity: float = 2.0
    acceleration: float = 2.0
    obstacle: float = 10.0  # 1/m
    comfort: float = 1.0  # 1/m
    speed_share: float = 0.985  # of the limits of velocity at which they set in
    push_share: float = 0.94  # of those of acceleration: leaves a new start some slack
    room: float = 0.06  # m to obstacles that must be kept
    comfort_room: float = 0.15  # m that are kept where it costs little
    shortest: float = 0.02  # s between nodes at least


@njit(cache=True)
def linearise(nodes, ends, obstacles, half, limits, weights, A, g):
    """Cost of a band; fills the normal matrix A (4 n, 12) and the gradient g (4 n,) of half of it.

    Args:
        nodes: shape (n, 4).
        ends: velocity (vx, vy, omega) in world at start and end. Shape (2, 3).
        obstacles: rows as in `clearance`. Shape (m, 7).
        half: half length and half width of the footprint. Shape (2,).
        limits: of the vehicle.
        weights: of the terms.
        A, g: overwritten; of length zero, only the cost is computed.
    """
    n = nodes.shape[0]
    wanted = g.shape[0] > 0
    A[:] = 0.0
    g[:] = 0.0
    J, rows = np.zeros(12), np.zeros((3, 12))
    cost = 0.0
    for i in range(n - 1):
        dt = nodes[i + 1, 3] - nodes[i, 3]
        if dt <= 1e-4 or abs(nodes[i + 1, 2] - nodes[i, 2]) > MAX_TURN:
            return math.inf
        J[:] = 0.0
        J[3], J[7] = -weights.time, weights.time
        cost += _add(A, g, wanted, i, J, 0, 8, weights.time * dt)
        if dt < weights.shortest:
            w = 10.0 / weights.shortest
            J[3], J[7] = w, -w
            cost += _add(A, g, wanted, i, J, 0, 8, w * (weights.shortest - dt))
        ux, uy, uw = velocity_terms(nodes[i], nodes[i + 1], limits, rows[:, :8])
        if abs(ux) + abs(uy) + abs(uw) > weights.speed_share:
            for plane in range(8):
                sx, sy, sw = 1 - 2 * (plane & 1), 1 - (plane & 2), 1 - (plane & 4) // 2
                over = sx * ux + sy * uy + sw * uw - weights.speed_share
                if over > 0:
                    w = weights.velocity
                    for k in range(8):
                        J[k] = w * (sx * rows[0, k] + sy * rows[1, k] + sw * rows[2, k])
                    cost += _add(A, g, wanted, i, J, 0, 8, w * over)
    for i in range(n):
        kind = 1 if i == 0 else (2 if i == n - 1 else 0)
        before = ends[0] if i == 0 else nodes[i - 1]
        after = nodes[i + 1] if i < n - 1 else nodes[i]
        push, turn = acceleration_terms(before, nodes[i], after, ends[1], kind, limits, rows[:2])
        low, high = (4 if kind == 1 else 0), (8 if kind == 2 else 12)
        for sign in (-1.0, 1.0):
            over = push + sign * turn - weights.push_share
            if over > 0:
                w = weights.acceleration
                for k in range(low, high):
                    J[k] = w * (rows[0, k] + sign * rows[1, k])
                cost += _add(A, g, wanted, i - 1, J, low, high, w * over)
    reach = math.hypot(half[0], half[1])
    far = max(weights.room, weights.comfort_room)
    for i in range(1, n):
        x, y, yaw, t = nodes[i]
        for k in range(obstacles.shape[0]):
            o = obstacles[k]
            sx, sy = o[VX] * t, o[VY] * t
            ax, ay, bx, by = o[AX] + sx, o[AY] + sy, o[BX] + sx, o[BY] + sy
            if to_segment(x, y, ax, ay, bx, by) > reach + far + o[RADIUS]:
                continue
            d, dx, dy, dyaw = clearance(x, y, yaw, half, ax, ay, bx, by)
            d -= o[RADIUS]
            for tier in range(2):
                w = weights.obstacle if tier == 0 else weights.comfort
                missing = (weights.room if tier == 0 else weights.comfort_room) - d
                if missing > 0 and w > 0:
                    # The room changes with the time as with the obstacle's own way.
                    J[0], J[1], J[2] = -w * dx, -w * dy, -w * dyaw
                    J[3] = w * (dx * o[VX] + dy * o[VY])
                    cost += _add(A, g, wanted, i, J, 0, 4, w * missing)
    return cost


@njit(cache=True)
def _add(A, g, wanted, node, J, low, high, residual):
    """Add a residual whose derivative J[low:high] counts from `node`; returns its square."""
    if wanted:
        for a in range(low, high):
            row = 4 * node + a
            g[row] += J[a] * residual
            for b in range(low, a + 1):
                A[row, a - b] += J[a] * J[b]
    return residual * residual


@njit(cache=True)
def banded_cholesky(A, b):
    """Solve H x = b in place for a banded H as in `A`, which its factor replaces.

    Returns:
        Whether H is positive definite; otherwise b is spoilt.
    """
    n, width = A.shape
    for i in range(n):
        first = max(0, i - width + 1)
        for j in range(first, i + 1):
            total = A[i, i - j]
            for k in range(max(first, j - width + 1), j):
                total -= A[i, i - k] * A[j, j - k]
            if j < i:
                A[i, i - j] = total / A[j, 0]
            elif total <= 0.0 or not math.isfinite(total):
                return False
            else:
                A[i, 0] = math.sqrt(total)
    for i in range(n):
        for k in range(max(0, i - width + 1), i):
            b[i] -= A[i, i - k] * b[k]
        b[i] /= A[i, 0]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, min(n, i + width)):
            b[i] -= A[k, k - i] * b[k]
        b[i] /= A[i, 0]
    return True


@njit(cache=True)
def optimise(nodes, ends, obstacles, half, limits, weights, iterations, tolerance):
    """Improve a band in place; the first node and the last pose stay. Returns its cost."""
    n = 4 * nodes.shape[0]
    A, g = np.zeros((n, BAND)), np.zeros(n)
    empty_A, empty_g = np.zeros((0, BAND)), np.zeros(0)
    trial = nodes.copy()
    damping = 1e-3
    cost = linearise(nodes, ends, obstacles, half, limits, weights, A, g)
    if not math.isfinite(cost):
        return cost
    for _ in range(iterations):
        _hold(A, g, n)
        improved, gain = False, 0.0
        for _attempt in range(5):
            H, step = A.copy(), -g
            for i in range(n):
                H[i, 0] += damping * (H[i, 0] + 1.0)
            # Time differences are held back by themselves: their sum may change much.
            for i in range(7, n, 4):
                hold = damping * HOLD
                H[i, 0] += hold
                if i > 7:  # the first node's time stays
                    H[i - 4, 0] += hold
                    H[i, 4] -= hold
            if banded_cholesky(H, step):
                # Where no limit is felt yet the model runs into it blindly: go part of the way.
                part = _bounded(nodes, step)
                for _shorter in range(PARTS):
                    for i in range(n):
                        trial[i // 4, i % 4] = nodes[i // 4, i % 4] + part * step[i]
                    new = linearise(trial, ends, obstacles, half, limits, weights, empty_A, empty_g)
                    if new < cost:
                        gain = cost - new
                        improved = True
                        break
                    part *= 0.3
            if improved:
                break
            damping *= 10.0
        if not improved:
            break
        nodes[:] = trial
        damping = max(damping / 8.0, 1e-6)
        cost = linearise(nodes, ends, obstacles, half, limits, weights, A, g)
        if gain < tolerance * cost:
            break
    return cost


@njit(cache=True)
def _bounded(nodes, step):
    """Part of a step to take: velocities go with 1 / dt, so no dt changes by more than half."""
    scale = 1.0
    for i in range(nodes.shape[0] - 1):
        dt = nodes[i + 1, 3] - nodes[i, 3]
        change = abs(step[4 * i + 7] - step[4 * i + 3])
        if change * scale > 0.5 * dt:
            scale = 0.5 * dt / change
    return scale


@njit(cache=True)
def _hold(A, g, n):
    """Take the first node and the last pose out of the problem."""
    for i in range(n):
        if 4 <= i < n - 4 or i == n - 1:
            continue
        g[i] = 0.0
        A[i] = 0.0
        A[i, 0] = 1.0
        for k in range(i + 1, min(n, i + BAND)):
            A[k, k - i] = 0.0


@njit(cache=True)
def resized(nodes, step, most):
    """Band with nodes put in where they are far apart in time and taken out where they crowd.

    Args:
        nodes: shape (n, 4).
        step: wanted time between nodes, s.
        most: nodes at most.
    """
    out = np.empty((2 * nodes.shape[0], 4))
    out[0] = nodes[0]
    n = 1
    for i in range(1, nodes.shape[0]):
        last = i == nodes.shape[0] - 1
        dt = nodes[i, 3] - out[n - 1, 3]
        left = nodes.shape[0] - i + n  # nodes if nothing more changes
        if not last and dt < 0.6 * step and left > 5:
            continue
        if dt > 1.4 * step and left < most:
            out[n] = 0.5 * (out[n - 1] + nodes[i])
            n += 1
        out[n] = nodes[i]
        n += 1
    return out[:n].copy()


def limits_of(drive) -> Limits:
    """Inverse limits of `config.DriveLimits`."""
    return Limits(
        1 / drive.speed,
        1 / drive.strafe_speed,
        1 / drive.turn_rate,
        1 / drive.acceleration,
        1 / drive.turn_acceleration,
    )

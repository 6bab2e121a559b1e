"""Nonlinear least squares of the head's pose on all crossings, each at its own instant.

Beside the source, which solves three nodes in closed form and stops there. The measured angle of a
crossing is the spin's angle at its stamp, so an angle over the spin's rate is a time: the
residuals are those of the crossing times. The vehicle moves by a given twist meanwhile; the pose
that is sought is the one in the middle of the revolution.

Pose: R, p of T_world_head. Small errors: shift in world axes (m), then a turn in head axes (rad).
"""

import numpy as np
from numba import njit

from twin.geometry import Array
from twin.stack.estimation.beacons.angles import angle_by_planes, crossing_angle
from twin.stack.estimation.beacons.small import (
    backward,
    cholesky,
    copy_to,
    forward,
    rotation_exp,
    spd_inverse,
)

ITERATIONS = 15
SMALL = 1e-7  # of a step in m and rad, at which iteration ends: far below any noise


@njit(cache=True)
def motion(twist, times):
    """What the head's own motion does to points: p_head(t) = A (R^T (p_world - p)) - s.

    Args:
        twist: of the head in its own axes, constant: velocity (m/s), rate of turn (rad/s). (6,).
        times: since the pose's instant, s. Shape (m,).

    Returns:
        A (m, 3, 3), s (m, 3).
    """
    A, s = np.empty((len(times), 3, 3)), np.empty((len(times), 3))
    vx, vy, vz = twist[0], twist[1], twist[2]
    wx, wy, wz = twist[3], twist[4], twist[5]
    turn, half = np.empty((3, 3)), np.empty((3, 3))
    for i in range(len(times)):
        t = times[i]
        rotation_exp(wx * t, wy * t, wz * t, turn)
        # The chord of the arc lies along the velocity turned by half the angle; its length differs
        # from the arc's by (w t)^2 / 24, less than 1e-5 of a few centimetres here.
        rotation_exp(0.5 * wx * t, 0.5 * wy * t, 0.5 * wz * t, half)
        for a in range(3):
            for b in range(3):
                A[i, a, b] = turn[b, a]
        for a in range(3):
            # R_t^T (R_half v) = R_half^T v
            s[i, a] = t * (half[0, a] * vx + half[1, a] * vy + half[2, a] * vz)
    return A, s


@njit(cache=True)
def _into_head(i, R, p, P, A, s, q, x):
    """Node P in axes of the head at R, p (q), and when crossing i happened (x). Shapes (3,)."""
    dx, dy, dz = P[0] - p[0], P[1] - p[1], P[2] - p[2]
    for a in range(3):
        q[a] = R[0, a] * dx + R[1, a] * dy + R[2, a] * dz
    for a in range(3):
        x[a] = A[i, a, 0] * q[0] + A[i, a, 1] * q[1] + A[i, a, 2] * q[2] - s[i, a]


@njit(cache=True)
def linearise(R, p, rows, nodes, node, plane, theta, normals, A, s, r, J):
    """Residuals theta - predicted, rad, and the prediction's derivatives by shift and turn.

    Args:
        R, p: pose.
        rows: which crossings. Shape (k,).
        nodes: p_world, m. Shape (n, 3).
        node, plane, theta: of all crossings. Shape (m,).
        normals: Eq. 29. Shape (2, 3).
        A, s: of `motion`.
        r, J: results, first k rows. Shapes (>= k,), (>= k, 6).

    Returns:
        False if a plane can never meet its node in this pose.
    """
    q, x, h = np.empty(3), np.empty(3), np.empty(3)
    for k in range(len(rows)):
        i = rows[k]
        _into_head(i, R, p, nodes[node[i]], A, s, q, x)
        angle, gx, gy, gz = crossing_angle(normals[plane[i]], plane[i], x)
        if not np.isfinite(angle):
            return False
        off = theta[i] - angle
        r[k] = off - 2.0 * np.pi * np.round(off / (2.0 * np.pi))
        for a in range(3):
            h[a] = A[i, 0, a] * gx + A[i, 1, a] * gy + A[i, 2, a] * gz
        for a in range(3):
            J[k, a] = -(R[a, 0] * h[0] + R[a, 1] * h[1] + R[a, 2] * h[2])
        J[k, 3] = h[1] * q[2] - h[2] * q[1]
        J[k, 4] = h[2] * q[0] - h[0] * q[2]
        J[k, 5] = h[0] * q[1] - h[1] * q[0]
    return True


@njit(cache=True)
def by_planes(R, p, nodes, node, plane, theta, normals, derivatives, A, s):
    """Derivative of all crossings' angles by phi_1, phi_2, phi_r, the head at R, p. Shape (m, 3).

    Args:
        derivatives: `normal_derivatives`, planes first. Shape (2, 3, 3): plane, parameter, axis.
    """
    out, q, x = np.empty((len(theta), 3)), np.empty(3), np.empty(3)
    for i in range(len(theta)):
        _into_head(i, R, p, nodes[node[i]], A, s, q, x)
        d = angle_by_planes(normals[plane[i]], derivatives[plane[i]], theta[i], x)
        for a in range(3):
            out[i, a] = d[a]
    return out


@njit(cache=True)
def pose_by_angles(
    R, p, rows, nodes, sigma_node, node, plane, theta, normals, A, s, covariance, pose_covariance
):
    """Derivative of the pose that `least_squares` finds by its crossings' angles. Shape (6, k)."""
    k = len(rows)
    r, J, W, out = np.empty(k), np.empty((k, 6)), np.empty((k, k)), np.zeros((6, k))
    linearise(R, p, rows, nodes, node, plane, theta, normals, A, s, r, J)
    weigh(rows, node, covariance, sigma_node, J, W)
    for a in range(6):
        column = np.empty(k)
        for i in range(k):
            column[i] = 0.0
            for b in range(6):
                column[i] += J[i, b] * pose_covariance[a, b]
        forward(W, k, column)
        backward(W, k, column)
        for i in range(k):
            out[a, i] = column[i]
    return out


@njit(cache=True)
def moved(R, p, step, R_out, p_out, turn):
    """Pose after a small error: p + shift, R Exp(turn)."""
    rotation_exp(step[3], step[4], step[5], turn)
    for a in range(3):
        p_out[a] = p[a] + step[a]
        for b in range(3):
            R_out[a, b] = R[a, 0] * turn[0, b] + R[a, 1] * turn[1, b] + R[a, 2] * turn[2, b]


@njit(cache=True)
def weigh(rows, node, covariance, sigma_node, J, W):
    """Lower Cholesky factor into W (k, k) of the crossings' covariance with the survey's error.

    An error of a node's place moves its crossings as the opposite shift of the head would.
    """
    for a in range(len(rows)):
        for b in range(a + 1):
            value = covariance[rows[a], rows[b]]
            if node[rows[a]] == node[rows[b]]:
                along = J[a, 0] * J[b, 0] + J[a, 1] * J[b, 1] + J[a, 2] * J[b, 2]
                value += sigma_node[node[rows[a]]] ** 2 * along
            W[a, b] = W[b, a] = value
    return cholesky(W, len(rows))


@njit(cache=True)
def least_squares(
    R, p, rows, nodes, sigma_node, node, plane, theta, normals, A, s, covariance, iterations
):
    """Levenberg-Marquardt from R, p, which are changed in place.

    Returns:
        Whether it ended well, chi-square, covariance of the pose (6, 6), and for each node the
        chi-square that its crossings cost (n,), 0 where nothing checks them.
    """
    k, six = len(rows), len(normals) * 3
    r, J, W = np.empty(k), np.empty((k, 6)), np.empty((k, k))
    blocks, out = np.zeros(len(nodes)), np.zeros((6, 6))
    if k < 6 or not linearise(R, p, rows, nodes, node, plane, theta, normals, A, s, r, J):
        return False, np.inf, out, blocks
    if not weigh(rows, node, covariance, sigma_node, J, W):
        return False, np.inf, out, blocks
    r2, J2 = np.empty(k), np.empty((k, 6))
    R2, p2, turn = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    N, damped, step = np.empty((6, 6)), np.empty((6, 6)), np.empty(6)
    column = np.empty(k)
    damping, done = 0.0, False
    cost = _whiten(W, k, r, J, column)
    for _ in range(iterations):
        for a in range(6):
            step[a] = 0.0
            for i in range(k):
                step[a] += J[i, a] * r[i]
            for b in range(a + 1):
                total = 0.0
                for i in range(k):
                    total += J[i, a] * J[i, b]
                N[a, b] = N[b, a] = total
        copy_to(N, damped, six)
        for a in range(six):
            damped[a, a] *= 1.0 + damping
        if not cholesky(damped, six):
            damping = max(10.0 * damping, 1e-6)
            if damping > 1e6:
                break
            continue
        forward(damped, six, step)
        backward(damped, six, step)
        moved(R, p, step, R2, p2, turn)
        good = linearise(R2, p2, rows, nodes, node, plane, theta, normals, A, s, r2, J2)
        trial = _whiten(W, k, r2, J2, column) if good else np.inf
        largest = 0.0
        for a in range(6):
            largest = max(largest, abs(step[a]))
        if trial <= cost or (largest < SMALL and trial < cost * (1 + 1e-9) + 1e-12):
            copy_to(R2, R, 3)
            copy_to(J2, J, k)
            for a in range(3):
                p[a] = p2[a]
            for i in range(k):
                r[i] = r2[i]
            cost = trial
            damping *= 0.1
            if largest < SMALL:
                done = True
                break
        else:
            damping = max(10.0 * damping, 1e-4)
            if damping > 1e8:
                break
    for a in range(6):
        for b in range(6):
            total = 0.0
            for i in range(k):
                total += J[i, a] * J[i, b]
            N[a, b] = total
    if not spd_inverse(N, six, out):
        return False, np.inf, out, blocks
    _block_tests(W, k, r, J, out, rows, node, blocks)
    return done, cost, out, blocks


@njit(cache=True)
def _block_tests(W, k, e, J, covariance, rows, node, blocks):
    """Chi-square that a node costs, from the whitened residuals e and rows of J.

    With z = C^-1 r and M = C^-1 Q_r C^-1, Q_r the residuals' covariance, it is z_B^T M_BB^-1 z_B
    over the node's crossings B: by so much chi-square would fall without them.
    """
    Y, U, column = np.zeros((k, k)), np.empty((k, 6)), np.empty(k)
    for i in range(k):  # Y[i] = L^-1 e_i, U[i] = J^T Y[i]
        for j in range(k):
            column[j] = 1.0 if i == j else 0.0
        forward(W, k, column)
        for j in range(k):
            Y[i, j] = column[j]
        for a in range(6):
            total = 0.0
            for j in range(i, k):
                total += J[j, a] * column[j]
            U[i, a] = total
    for i in range(k):
        for j in range(i + 1):
            if node[rows[i]] != node[rows[j]]:
                continue
            n = node[rows[i]]
            # At most two crossings of a node are in a fix.
            zi = zj = mii = mjj = mij = 0.0
            for c in range(k):
                zi += Y[i, c] * e[c]
                zj += Y[j, c] * e[c]
                mii += Y[i, c] * Y[i, c]
                mjj += Y[j, c] * Y[j, c]
                mij += Y[i, c] * Y[j, c]
            total_i, total_j = mii, mjj
            for a in range(6):
                for b in range(6):
                    mii -= U[i, a] * covariance[a, b] * U[i, b]
                    mjj -= U[j, a] * covariance[a, b] * U[j, b]
                    mij -= U[i, a] * covariance[a, b] * U[j, b]
            test = 0.0
            if i == j and mii > 1e-6 * total_i:
                test = zi * zi / mii
            elif i != j:
                det = mii * mjj - mij * mij
                if det > 1e-9 * total_i * total_j:
                    test = (zi * zi * mjj - 2.0 * zi * zj * mij + zj * zj * mii) / det
            blocks[n] = max(blocks[n], test)


@njit(cache=True)
def _whiten(W, k, r, J, column):
    """Residuals and rows of J in units of their joint sigma, in place. Returns the cost."""
    forward(W, k, r)
    for a in range(6):
        for i in range(k):
            column[i] = J[i, a]
        forward(W, k, column)
        for i in range(k):
            J[i, a] = column[i]
    cost = 0.0
    for i in range(k):
        cost += r[i] * r[i]
    return cost


def chi_square_limit(freedom: int, z: float) -> float:
    """Quantile of chi-square at the normal deviate z, by Wilson and Hilferty."""
    a = 2.0 / (9.0 * freedom)
    return freedom * max(1.0 - a + z * a**0.5, 0.0) ** 3


def head_twist(body_twist: Array, T_base_head: Array) -> Array:
    """Twist of the head in its own axes from the base's: velocity, rate of turn. Shape (6,)."""
    R, lever = T_base_head[:3, :3], T_base_head[:3, 3]
    v, w = np.asarray(body_twist[:3], dtype=float), np.asarray(body_twist[3:], dtype=float)
    x, y, z = lever
    swept = np.array([w[1] * z - w[2] * y, w[2] * x - w[0] * z, w[0] * y - w[1] * x])
    return np.concatenate([(v + swept) @ R, w @ R])

"""Rotation and translation between two sets of points by SVD (Liu et al. 2022, Eqs. 15-22)."""

import numpy as np
from numba import njit

from twin.geometry import Array, transform
from twin.stack.estimation.beacons.small import rotation_exp

__all__ = ["cross_matrix", "euler_xyz", "exp_rotation", "log_rotation", "rigid_fit", "rotation_of"]


def rigid_fit(p_a: Array, p_b: Array) -> Array:
    """`T_b_a` with p_b = R p_a + t in least squares, Eqs. 17-22. Shapes (n, 3), n >= 3, to (4, 4).

    Raises:
        ValueError: if the points lie on a line.
    """
    p_a, p_b = np.asarray(p_a, dtype=float), np.asarray(p_b, dtype=float)
    mean_a, mean_b = p_a.mean(axis=0), p_b.mean(axis=0)
    R = np.empty((3, 3))
    work = np.empty((2, 3, 3))
    if not rotation_of((p_a - mean_a).T @ (p_b - mean_b), R, work):
        raise ValueError("rigid_fit: the points lie on a line")
    return transform(R, mean_b - R @ mean_a)


def exp_rotation(vector: Array) -> Array:
    """Rotation matrix of a rotation vector, rad. Shape (3,) to (3, 3)."""
    out = np.empty((3, 3))
    rotation_exp(float(vector[0]), float(vector[1]), float(vector[2]), out)
    return out


def log_rotation(R: Array) -> Array:
    """Rotation vector of a rotation by less than half a turn, rad. Shape (3, 3) to (3,)."""
    v = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    s, c = float(np.linalg.norm(v)), 0.5 * (float(np.trace(R)) - 1.0)
    return v * (np.arctan2(s, c) / s if s > 1e-12 else 1.0)


def cross_matrix(v: Array) -> Array:
    """[v] with [v] u = v x u. Shape (3,) to (3, 3)."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def euler_xyz(rotation: Array) -> Array:
    """r_x, r_y, r_z of R = R_x R_y R_z, Eq. 16. Shape (3,)."""
    r = rotation
    return np.array(
        [
            np.arctan2(-r[1, 2], r[2, 2]),
            np.arctan2(r[0, 2], np.hypot(r[0, 0], r[0, 1])),
            np.arctan2(-r[0, 1], r[0, 0]),
        ]
    )


@njit(cache=True)
def rotation_of(H, R, work):
    """R = V diag(1, 1, det) U^T of H = U S V^T (Eqs. 20, 21), proper whatever H.

    One-sided Jacobi: columns of H V become orthogonal and are U S. The third vectors, which Eq. 21
    takes from the SVD with a sign that is open for flat points, complete right-handed triads here;
    that is the correction by the determinant.

    Args:
        H: sum of (P - mean) (T - mean)^T. Shape (3, 3).
        R: result. Shape (3, 3).
        work: scratch. Shape (2, 3, 3).

    Returns:
        False if H has rank one: points on a line.
    """
    A, V = work[0], work[1]
    for i in range(3):
        for j in range(3):
            A[i, j] = H[i, j]
            V[i, j] = 1.0 if i == j else 0.0
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += H[i, j] * H[i, j]
    for _ in range(12):
        off = 0.0
        for p in range(2):
            for q in range(p + 1, 3):
                app = A[0, p] * A[0, p] + A[1, p] * A[1, p] + A[2, p] * A[2, p]
                aqq = A[0, q] * A[0, q] + A[1, q] * A[1, q] + A[2, q] * A[2, q]
                apq = A[0, p] * A[0, q] + A[1, p] * A[1, q] + A[2, p] * A[2, q]
                # A column of pure rounding has no direction; to turn it towards others is noise.
                if abs(apq) <= 1e-15 * np.sqrt(app * aqq) or min(app, aqq) <= 1e-28 * total:
                    continue
                off = max(off, apq * apq / (app * aqq))
                zeta = (aqq - app) / (2.0 * apq)
                t = 1.0 / (abs(zeta) + np.sqrt(1.0 + zeta * zeta))
                if zeta < 0.0:
                    t = -t
                c = 1.0 / np.sqrt(1.0 + t * t)
                s = c * t
                for i in range(3):
                    a, b = A[i, p], A[i, q]
                    A[i, p], A[i, q] = c * a - s * b, s * a + c * b
                    a, b = V[i, p], V[i, q]
                    V[i, p], V[i, q] = c * a - s * b, s * a + c * b
        if off < 1e-28:
            break
    n0 = A[0, 0] ** 2 + A[1, 0] ** 2 + A[2, 0] ** 2
    n1 = A[0, 1] ** 2 + A[1, 1] ** 2 + A[2, 1] ** 2
    n2 = A[0, 2] ** 2 + A[1, 2] ** 2 + A[2, 2] ** 2
    least = 0 if n0 <= n1 and n0 <= n2 else (1 if n1 <= n2 else 2)
    i, j = (least + 1) % 3, (least + 2) % 3
    s1 = np.sqrt(A[0, i] ** 2 + A[1, i] ** 2 + A[2, i] ** 2)
    s2 = np.sqrt(A[0, j] ** 2 + A[1, j] ** 2 + A[2, j] ** 2)
    if not min(s1, s2) > 1e-9 * max(s1, s2):
        return False
    u1x, u1y, u1z = A[0, i] / s1, A[1, i] / s1, A[2, i] / s1
    u2x, u2y, u2z = A[0, j] / s2, A[1, j] / s2, A[2, j] / s2
    u3x, u3y, u3z = u1y * u2z - u1z * u2y, u1z * u2x - u1x * u2z, u1x * u2y - u1y * u2x
    v3x = V[1, i] * V[2, j] - V[2, i] * V[1, j]
    v3y = V[2, i] * V[0, j] - V[0, i] * V[2, j]
    v3z = V[0, i] * V[1, j] - V[1, i] * V[0, j]
    R[0, 0] = V[0, i] * u1x + V[0, j] * u2x + v3x * u3x
    R[0, 1] = V[0, i] * u1y + V[0, j] * u2y + v3x * u3y
    R[0, 2] = V[0, i] * u1z + V[0, j] * u2z + v3x * u3z
    R[1, 0] = V[1, i] * u1x + V[1, j] * u2x + v3y * u3x
    R[1, 1] = V[1, i] * u1y + V[1, j] * u2y + v3y * u3y
    R[1, 2] = V[1, i] * u1z + V[1, j] * u2z + v3y * u3z
    R[2, 0] = V[2, i] * u1x + V[2, j] * u2x + v3z * u3x
    R[2, 1] = V[2, i] * u1y + V[2, j] * u2y + v3z * u3y
    R[2, 2] = V[2, i] * u1z + V[2, j] * u2z + v3z * u3z
    return True

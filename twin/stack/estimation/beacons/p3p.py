"""Pose of the head from three nodes, the fourth choosing (Liu et al. 2022, Eqs. 9-28), batched.

T_head_world is R, t of Eq. 17: p_head = R p_world + t.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.geometry import Array
from twin.stack.estimation.beacons.quartic import distances
from twin.stack.estimation.beacons.small import copy_to
from twin.stack.estimation.beacons.stamps import NoFix

COLLINEAR = 0.02  # sine of the angle between two sides below which three nodes are a line
# Conditioning below which noise swamps the distances: 35 mm of scatter at 50 microradians and 3 m.
DANGER = 0.02


def conditioning(p_head: Array) -> float:
    """Determinant of Eq. 9 by the distances, rows of length one: 0 on the danger cylinder.

    Args:
        p_head: three nodes in head, m. Shape (3, 3).
    """
    d = np.linalg.norm(p_head, axis=1)
    f = p_head / d[:, None]
    rows = np.zeros((3, 3))
    for row, (i, j) in zip(rows, ((0, 1), (0, 2), (1, 2)), strict=True):
        cosine = f[i] @ f[j]
        row[i], row[j] = d[i] - d[j] * cosine, d[j] - d[i] * cosine
        row /= max(float(np.linalg.norm(row)), 1e-300)
    return abs(float(np.linalg.det(rows)))


@dataclass(frozen=True)
class Poses:
    """Up to four solutions of each of n problems.

    Attributes:
        count: how many there are. Shape (n,).
        R, t: of T_head_world; rows past the count are NaN. Shapes (n, 4, 3, 3), (n, 4, 3).
        distances: head to the three nodes, m. Shape (n, 4, 3).
        conditioning: 0 on the danger cylinder, 1 at best. Shape (n, 4).
    """

    count: NDArray[np.int64]
    R: Array
    t: Array
    distances: Array
    conditioning: Array

    @property
    def position(self) -> Array:
        """Eqs. 27, 28: the head's origin in world, -R^T t. Shape (n, 4, 3)."""
        return -np.einsum("nkji,nkj->nki", self.R, self.t)


def p3p(rays: Array, p_world: Array) -> Poses:
    """All poses that agree with three rays to three nodes.

    Args:
        rays: directions in head, of any length. Shape (n, 3, 3) or (3, 3).
        p_world: the nodes. Shape (n, 3, 3), or (3, 3) for the same nodes in all problems.
    """
    rays = np.ascontiguousarray(np.reshape(rays, (-1, 3, 3)), dtype=np.float64)
    nodes = np.ascontiguousarray(np.reshape(p_world, (-1, 3, 3)), dtype=np.float64)
    if len(nodes) not in (1, len(rays)):
        raise ValueError(f"p3p: {len(rays)} sets of rays, {len(nodes)} sets of nodes")
    return Poses(*_batch(rays, nodes))


def p3p_checked(rays: Array, p_world: Array) -> tuple[Array, Array, Array]:
    """P3P of the first three nodes; the fourth picks the solution (Eqs. 23-26).

    Args:
        rays: directions in head. Shape (n, 4, 3).
        p_world: nodes. Shape (n, 4, 3) or (4, 3).

    Returns:
        R (n, 3, 3) and t (n, 3) of T_head_world, NaN where there is none; error psi (n,) of Eq. 26.
    """
    rays = np.ascontiguousarray(np.reshape(rays, (-1, 4, 3)), dtype=np.float64)
    nodes = np.ascontiguousarray(np.reshape(p_world, (-1, 4, 3)), dtype=np.float64)
    if len(nodes) not in (1, len(rays)):
        raise ValueError(f"p3p: {len(rays)} sets of rays, {len(nodes)} sets of nodes")
    return _checked(rays, nodes)


def triple_fault(p_world: Array) -> NoFix | None:
    """Whether three nodes lie too nearly on a line. Shape (3, 3)."""
    a, b = p_world[1] - p_world[0], p_world[2] - p_world[0]
    c = b - a
    longest = sorted(float(np.linalg.norm(side)) for side in (a, b, c))
    sine = float(np.linalg.norm(np.cross(a, b))) / max(longest[1] * longest[2], 1e-12)
    if sine < COLLINEAR:
        return NoFix("collinear nodes", f"sine between the sides {sine:.4f} < {COLLINEAR}")
    return None


@njit(cache=True)
def solve_triple(f, P, slack, R, t, d, roots):
    """One problem: unit rays f (3, 3), nodes P (3, 3); fills R (4, 3, 3), t (4, 3), d (4, 4).

    For `slack` see `quartic.distances`; 0 for none.
    """
    c12 = f[0, 0] * f[1, 0] + f[0, 1] * f[1, 1] + f[0, 2] * f[1, 2]
    c13 = f[0, 0] * f[2, 0] + f[0, 1] * f[2, 1] + f[0, 2] * f[2, 2]
    c23 = f[1, 0] * f[2, 0] + f[1, 1] * f[2, 1] + f[1, 2] * f[2, 2]
    s12 = (P[0, 0] - P[1, 0]) ** 2 + (P[0, 1] - P[1, 1]) ** 2 + (P[0, 2] - P[1, 2]) ** 2
    s13 = (P[0, 0] - P[2, 0]) ** 2 + (P[0, 1] - P[2, 1]) ** 2 + (P[0, 2] - P[2, 2]) ** 2
    s23 = (P[1, 0] - P[2, 0]) ** 2 + (P[1, 1] - P[2, 1]) ** 2 + (P[1, 2] - P[2, 2]) ** 2
    if not min(s12, s13, s23) > 0.0:
        return 0
    count = distances(c12, c13, c23, s12, s13, s23, slack, d, roots)
    # Eqs. 18-21 in the planes of the two triangles. H has rank two, and its SVD there is one of two
    # rows, whose V U^T is a rotation by a closed form; the normals, drawn by the same order of the
    # nodes, are the third singular vectors. `rigid.rotation_of` gives the same for any points.
    ex, ey, ez = P[1, 0] - P[0, 0], P[1, 1] - P[0, 1], P[1, 2] - P[0, 2]
    ax, ay, az = P[2, 0] - P[0, 0], P[2, 1] - P[0, 1], P[2, 2] - P[0, 2]
    long = np.sqrt(s12)
    ex, ey, ez = ex / long, ey / long, ez / long
    nx, ny, nz = ey * az - ez * ay, ez * ax - ex * az, ex * ay - ey * ax
    high = np.sqrt(nx * nx + ny * ny + nz * nz)
    if not high > 1e-9 * long:
        return 0
    nx, ny, nz = nx / high, ny / high, nz / high
    ox, oy, oz = ny * ez - nz * ey, nz * ex - nx * ez, nx * ey - ny * ex
    foot = ex * ax + ey * ay + ez * az
    # The triangle's corners in its plane about their mean: (u1, v1), (u2, v1), (u3, v3).
    u1, v1 = -(long + foot) / 3.0, -high / 3.0
    u2, u3, v3 = u1 + long, u1 + foot, v1 + high
    for k in range(count):
        d1, d2, d3 = d[k, 0], d[k, 1], d[k, 2]
        tx, ty, tz = d1 * f[0, 0], d1 * f[0, 1], d1 * f[0, 2]
        gx, gy, gz = d2 * f[1, 0] - tx, d2 * f[1, 1] - ty, d2 * f[1, 2] - tz
        bx, by, bz = d3 * f[2, 0] - tx, d3 * f[2, 1] - ty, d3 * f[2, 2] - tz
        long_k = np.sqrt(gx * gx + gy * gy + gz * gz)
        gx, gy, gz = gx / long_k, gy / long_k, gz / long_k
        mx, my, mz = gy * bz - gz * by, gz * bx - gx * bz, gx * by - gy * bx
        high_k = np.sqrt(mx * mx + my * my + mz * mz)
        mx, my, mz = mx / high_k, my / high_k, mz / high_k
        wx, wy, wz = my * gz - mz * gy, mz * gx - mx * gz, mx * gy - my * gx
        foot_k = gx * bx + gy * by + gz * bz
        # b2 and b3 from the first corner; the mean drops out, for u and v sum to zero.
        c = u2 * long_k + u3 * foot_k + v3 * high_k
        s = u3 * high_k - v1 * long_k - v3 * foot_k
        size = np.sqrt(c * c + s * s)
        c, s = c / size, s / size
        hx, hy, hz = c * gx + s * wx, c * gy + s * wy, c * gz + s * wz
        wx, wy, wz = c * wx - s * gx, c * wy - s * gy, c * wz - s * gz
        R[k, 0, 0] = hx * ex + wx * ox + mx * nx
        R[k, 0, 1] = hx * ey + wx * oy + mx * ny
        R[k, 0, 2] = hx * ez + wx * oz + mx * nz
        R[k, 1, 0] = hy * ex + wy * ox + my * nx
        R[k, 1, 1] = hy * ey + wy * oy + my * ny
        R[k, 1, 2] = hy * ez + wy * oz + my * nz
        R[k, 2, 0] = hz * ex + wz * ox + mz * nx
        R[k, 2, 1] = hz * ey + wz * oy + mz * ny
        R[k, 2, 2] = hz * ez + wz * oz + mz * nz
        # Eq. 22 about the means: mean of T = first corner + (b2 + b3) / 3.
        px = P[0, 0] - (ex * u1 + ox * v1)
        py = P[0, 1] - (ey * u1 + oy * v1)
        pz = P[0, 2] - (ez * u1 + oz * v1)
        tx += (gx * long_k + bx) / 3.0
        ty += (gy * long_k + by) / 3.0
        tz += (gz * long_k + bz) / 3.0
        t[k, 0] = tx - (R[k, 0, 0] * px + R[k, 0, 1] * py + R[k, 0, 2] * pz)
        t[k, 1] = ty - (R[k, 1, 0] * px + R[k, 1, 1] * py + R[k, 1, 2] * pz)
        t[k, 2] = tz - (R[k, 2, 0] * px + R[k, 2, 1] * py + R[k, 2, 2] * pz)
    return count


@njit(cache=True)
def _unit(rays, n, out, count):
    for i in range(count):
        x, y, z = rays[n, i, 0], rays[n, i, 1], rays[n, i, 2]
        inverse = 1.0 / np.sqrt(x * x + y * y + z * z)
        out[i, 0], out[i, 1], out[i, 2] = x * inverse, y * inverse, z * inverse


@njit(cache=True)
def _batch(rays, nodes):
    total = len(rays)
    count = np.zeros(total, dtype=np.int64)
    R_all, t_all = np.full((total, 4, 3, 3), np.nan), np.full((total, 4, 3), np.nan)
    d_all, cond = np.full((total, 4, 3), np.nan), np.full((total, 4), np.nan)
    slack = 0.0
    f, d, roots = np.empty((3, 3)), np.empty((4, 4)), np.empty(4)
    for n in range(total):
        _unit(rays, n, f, 3)
        P = nodes[n if len(nodes) > 1 else 0]
        count[n] = solve_triple(f, P, slack, R_all[n], t_all[n], d, roots)
        for k in range(count[n]):
            for i in range(3):
                d_all[n, k, i] = d[k, i]
            cond[n, k] = d[k, 3]
    return count, R_all, t_all, d_all, cond


@njit(cache=True)
def virtual_plane_error(tau, p):
    """Eqs. 25, 26: squared distance of ray and point on the virtual image plane.

    Args:
        tau: unit ray in head. Shape (3,).
        p: point in head, m. Shape (3,).

    Returns:
        Without unit: the plane stands at right angles to the ray at distance 1 (the source's is
        Y = 1, which does not see a node on the X axis). Inf for a point behind the head.
    """
    ahead = tau[0] * p[0] + tau[1] * p[1] + tau[2] * p[2]
    if not ahead > 0.0:
        return np.inf
    x, y, z = p[0] / ahead - tau[0], p[1] / ahead - tau[1], p[2] / ahead - tau[2]
    return x * x + y * y + z * z  # |tau| = 1


@njit(cache=True)
def _checked(rays, nodes):
    total = len(rays)
    R_best, t_best = np.full((total, 3, 3), np.nan), np.full((total, 3), np.nan)
    psi_best = np.full(total, np.inf)
    slack = 0.0
    f, d, roots, p = np.empty((4, 3)), np.empty((4, 4)), np.empty(4), np.empty(3)
    R, t = np.empty((4, 3, 3)), np.empty((4, 3))
    for n in range(total):
        _unit(rays, n, f, 4)
        P = nodes[n if len(nodes) > 1 else 0]
        for k in range(solve_triple(f[:3], P[:3], slack, R, t, d, roots)):
            for i in range(3):  # Eq. 24
                p[i] = R[k, i, 0] * P[3, 0] + R[k, i, 1] * P[3, 1] + R[k, i, 2] * P[3, 2] + t[k, i]
            psi = virtual_plane_error(f[3], p)
            if psi < psi_best[n]:
                psi_best[n] = psi
                copy_to(R[k], R_best[n], 3)
                for i in range(3):
                    t_best[n, i] = t[k, i]
    return R_best, t_best, psi_best

"""Angles of the two laser planes, rays to the nodes, and the same forwards (Eqs. 1, 3-8, 29).

Liu et al. 2022. Frame *head*: z the spin axis, x the trace of plane 1 at the zero instant; angles
of rotation in radians from the zero instant, counter-clockwise about z.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.geometry import Array
from twin.stack.estimation.beacons.clocks import GOOD, Aligned, Spin
from twin.stack.estimation.beacons.stamps import (
    PLANE_1,
    SYNC,
    T0,
    Counter,
    HeadParameters,
    Noise,
    StampBatch,
)

TAU = 2.0 * np.pi
MOST_CROSSINGS = 3  # of a node by a plane in a turn: itself and two mirrors


def rotation_angle(crossing, zero, zero_before):
    """Eqs. 1 and 3: angle turned since the zero instant, at the speed of the revolution before."""
    return (crossing - zero) / (zero - zero_before) * TAU


def normals(head: HeadParameters) -> Array:
    """Eq. 29: unit normals of planes 1 and 2 in head at the zero instant. Shape (2, 3)."""
    s1, c1 = np.sin(head.phi_1), np.cos(head.phi_1)
    s2, c2 = np.sin(head.phi_2), np.cos(head.phi_2)
    sr, cr = np.sin(head.phi_r), np.cos(head.phi_r)
    return np.array([[0.0, -s1, c1], [-sr * s2, cr * s2, c2]])


def normal_derivatives(head: HeadParameters) -> Array:
    """Of `normals` by phi_1, phi_2, phi_r. Shape (3, 2, 3): parameter, plane, axis."""
    s1, c1 = np.sin(head.phi_1), np.cos(head.phi_1)
    s2, c2 = np.sin(head.phi_2), np.cos(head.phi_2)
    sr, cr = np.sin(head.phi_r), np.cos(head.phi_r)
    zero = np.zeros(3)
    return np.array(
        [
            [[0.0, -c1, -s1], zero],
            [zero, [-sr * c2, cr * c2, -s2]],
            [zero, [-cr * s2, -sr * s2, 0.0]],
        ]
    )


def turned(theta, normal: Array) -> Array:
    """Eq. 4 applied: a normal after the head has turned by theta. Shapes (...) to (..., 3)."""
    c, s = np.cos(theta), np.sin(theta)
    x, y, z = normal
    return np.stack([c * x - s * y, s * x + c * y, np.broadcast_to(z, np.shape(theta))], axis=-1)


def rays(theta_1, theta_2, head: HeadParameters) -> Array:
    """Eqs. 6 and 8: unit directions in head of nodes that the planes meet at these angles.

    The line where two planes meet has two directions; the node is before the fan of plane 1, on
    the side of its trace. Shapes (...) to (..., 3).
    """
    n = normals(head)
    direction = np.cross(turned(theta_1, n[0]), turned(theta_2, n[1]))
    trace = turned(theta_1, np.array([1.0, 0.0, 0.0]))
    before = np.where(np.sum(direction * trace, axis=-1) < 0.0, -1.0, 1.0)
    length = np.linalg.norm(direction, axis=-1)
    return direction * (before / np.maximum(length, 1e-300))[..., None]


def azimuth_elevation(direction: Array) -> tuple[Array, Array]:
    """Eq. 7 for z up: azimuth from x towards y, elevation above z = 0. Shapes (..., 3) to (...)."""
    a, b, c = np.moveaxis(np.asarray(direction, dtype=float), -1, 0)
    return np.arctan2(b, a), np.arctan2(c, np.hypot(a, b))


def angles_of(p_head: Array, head: HeadParameters) -> Array:
    """Angles at which planes 1 and 2 meet points. Shapes (n, 3) to (n, 2), in [0, 2 pi).

    NaN where a point is too steep for a plane to meet it.
    """
    n = normals(head)
    points = np.atleast_2d(np.asarray(p_head, dtype=float))
    found = np.array([[crossing_angle(n[k], k, p)[0] for k in range(2)] for p in points])
    return found % TAU


@njit(cache=True)
def crossing_angle(normal, plane, p):
    """Angle theta at which a plane meets p, from (R_theta N) . p = 0, and its gradient by p.

    With N = h (cos nu, sin nu) in the plane z = 0 and p at azimuth az and distance rho from the
    axis: h rho cos(az - theta - nu) + N_z p_z = 0. The fan is one-sided: of the two roots, plane 1
    (plane = 0) has az - theta - nu in (0, pi), plane 2 its negative.

    Returns:
        theta (NaN if never met), and the gradient's three components, rad/m.
    """
    h = np.hypot(normal[0], normal[1])
    rho = np.hypot(p[0], p[1])
    level = -normal[2] * p[2]
    if not abs(level) < h * rho:
        return np.nan, 0.0, 0.0, 0.0
    lead = np.arccos(level / (h * rho))
    if plane == 1:
        lead = -lead
    theta = np.arctan2(p[1], p[0]) - np.arctan2(normal[1], normal[0]) - lead
    c, s = np.cos(theta), np.sin(theta)
    nx, ny = c * normal[0] - s * normal[1], s * normal[0] + c * normal[1]
    turning = -ny * p[0] + nx * p[1]  # derivative of (R_theta N) . p by theta
    return theta, -nx / turning, -ny / turning, -normal[2] / turning


@njit(cache=True)
def angle_by_planes(normal, derivatives, theta, p):
    """Derivative of `crossing_angle` by phi_1, phi_2, phi_r, from (R_theta N) . p = 0.

    Args:
        normal: of the plane. Shape (3,).
        derivatives: of it, from `normal_derivatives`. Shape (3, 3): parameter, axis.
        theta: angle at which it meets p, rad.
        p: in head, m. Shape (3,).
    """
    c, s = np.cos(theta), np.sin(theta)
    x, y, z = c * p[0] + s * p[1], c * p[1] - s * p[0], p[2]
    turning = normal[0] * y - normal[1] * x
    out = np.empty(3)
    for i in range(3):
        d = derivatives[i]
        out[i] = -(d[0] * x + d[1] * y + d[2] * z) / turning
    return out


@dataclass(frozen=True)
class Crossings:
    """Angles measured in one revolution.

    Attributes:
        node: index into the batch's nodes. Shape (m,).
        plane: 0 or 1. Shape (m,).
        theta: angle turned since the zero instant, rad. Shape (m,).
        time: since the middle of the revolution, s. Shape (m,).
        covariance: of theta, with the clocks and the spin that all share, rad^2. Shape (m, m).
        rate: of the spin, rad/s.
    """

    node: NDArray[np.int64]
    plane: NDArray[np.int64]
    theta: Array
    time: Array
    covariance: Array
    rate: float


def measure(
    stamps: StampBatch, aligned: Aligned, turn: Spin, counter: Counter, noise: Noise
) -> Crossings:
    """Crossings of all nodes within the revolution, with their covariance.

    A node that some plane meets more than `MOST_CROSSINGS` times is dazzled, and left out.
    """
    u = aligned.time - turn.start
    use = (stamps.channel != T0) & (stamps.kind != SYNC) & (aligned.status[stamps.channel] == GOOD)
    use &= (u >= 0.0) & (u < turn.length)
    met = np.bincount(stamps.channel[use] * 3 + stamps.kind[use])
    dazzled = np.unique(np.nonzero(met > MOST_CROSSINGS)[0] // 3)
    rows = np.nonzero(use & ~np.isin(stamps.channel, dazzled))[0]
    u, channel, local = u[rows], stamps.channel[rows].astype(np.int64), aligned.local[rows]
    x0, f, c = turn.terms
    bow = u * (u - turn.length) / turn.length**2
    theta = TAU * (x0 + f * u + c * bow)
    by_terms = TAU * np.column_stack([np.ones(len(u)), u, bow])
    covariance = by_terms @ turn.covariance @ by_terms.T
    clocks = aligned.covariance[channel]
    shared = clocks[:, 0, 0] + local * clocks[:, 0, 1]
    tilt = clocks[:, 0, 1] + local * clocks[:, 1, 1]
    same = channel[:, None] == channel
    covariance += same * (TAU * f) ** 2 * (shared[:, None] + tilt[:, None] * local)
    sigma = TAU * f * np.hypot(noise.crossing, counter.tick / np.sqrt(12))
    covariance.ravel()[:: len(u) + 1] += sigma**2
    plane = stamps.kind[rows].astype(np.int64) - PLANE_1
    middle = u - 0.5 * turn.length
    return Crossings(channel - 1, plane, theta, middle, covariance, float(TAU * f))

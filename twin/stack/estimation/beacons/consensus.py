"""Which crossings belong together: P3P of many triples, judged by how many others agree.

A reflection gives a node a second crossing of a plane, or the only one; a blocked node gives none.
Every pairing of a node's crossings of plane 1 and 2 is a ray; triples of rays propose poses, widest
first. Near fits are polished on the crossings that agree, each at its own instant. The cost of a
pose is the sum over node and plane of the least squared residual in sigmas, cut at `CUT`^2.
"""

import numpy as np
from numba import njit

from twin.geometry import Array, inverse
from twin.stack.estimation.beacons.angles import crossing_angle
from twin.stack.estimation.beacons.p3p import COLLINEAR, solve_triple
from twin.stack.estimation.beacons.refine import least_squares, linearise

CUT = 4.0  # sigmas beyond which a crossing is an outlier
LOOSE = 25.0  # sigmas allowed before polishing: a triple's noise grows towards the other nodes
SLACK = 1e-4  # of `quartic.distances`: noise on the danger cylinder is polished away here
LEAST = 4  # crossings within `CUT` of a pose that is handed back
KEPT = 6  # poses with different supports that are handed back
SLACK_FLOOR = 3.0  # on the limits of `upright` before a pose is polished
MOST_TRIPLES = 120  # of ten nodes; more nodes are no likelier to be all wrong


@njit(cache=True)
def find_poses(nodes, sigma_node, node, plane, theta, normals, A, s, covariance, still, floor):
    """Poses that some triple proposes, best first.

    Args:
        nodes, sigma_node: survey of the batch's nodes. Shapes (n, 3), (n,).
        node, plane, theta: crossings. Shape (m,).
        normals: Eq. 29. Shape (2, 3).
        A, s: of `refine.motion`.
        covariance: of theta. Shape (m, m).
        still: whether the vehicle stands, so that rays need no correction for motion.
        floor: of `floor_of`, what is known of the vehicle's stand. Shape (8,).

    Returns:
        R (KEPT, 3, 3), p (KEPT, 3), cost (KEPT,), support (KEPT, m), how many, number of rays'
        nodes, number of triples that are no line.
    """
    m = len(theta)
    R_out, p_out = np.empty((KEPT, 3, 3)), np.empty((KEPT, 3))
    cost_out, support_out = np.full(KEPT, np.inf), np.zeros((KEPT, m), dtype=np.bool_)
    ray_node, ray_rows, f = _rays(node, plane, theta, normals)
    seen = 0
    for k in range(len(ray_node)):
        first = True
        for j in range(k):
            first = first and ray_node[j] != ray_node[k]
        seen += first
    triples = _triples(ray_node, f, nodes)
    found = 0
    sigma = np.empty(m)
    for i in range(m):
        sigma[i] = np.sqrt(covariance[i, i])
    loose, cut = np.float64(LOOSE), np.float64(CUT)
    slack = np.float64(SLACK)
    polish = np.int64(4)  # steps
    wanted = 0  # node and plane pairs with a crossing
    for i in range(m):
        wanted += _first_of_pair(i, node, plane)
    everyone = np.arange(m)
    r, J = np.empty(m), np.empty((m, 6))
    R, t, d, roots = np.empty((4, 3, 3)), np.empty((4, 3)), np.empty((4, 4)), np.empty(4)
    F, P = np.empty((3, 3)), np.empty((3, 3))
    Rw, pw, six = np.empty((3, 3)), np.empty(3), np.empty(6, dtype=np.int64)
    support = np.zeros(m, dtype=np.bool_)
    for triple in triples:
        for a in range(3):
            for b in range(3):
                F[a, b], P[a, b] = f[triple[a], b], nodes[ray_node[triple[a]], b]
            six[2 * a], six[2 * a + 1] = ray_rows[triple[a], 0], ray_rows[triple[a], 1]
        for k in range(solve_triple(F, P, slack, R, t, d, roots)):
            for a in range(3):
                pw[a] = -(R[k, 0, a] * t[k, 0] + R[k, 1, a] * t[k, 1] + R[k, 2, a] * t[k, 2])
                for b in range(3):
                    Rw[a, b] = R[k, b, a]
            if not upright(Rw, pw, floor, SLACK_FLOOR):
                continue
            if not still:
                least_squares(
                    Rw,
                    pw,
                    six,
                    nodes,
                    sigma_node,
                    node,
                    plane,
                    theta,
                    normals,
                    A,
                    s,
                    covariance,
                    polish,
                )
            if not linearise(Rw, pw, everyone, nodes, node, plane, theta, normals, A, s, r, J):
                continue
            _, count = _judge(r, sigma, node, plane, loose, support)
            if count < 7:  # nothing but the triple itself
                continue
            for _ in range(2):
                agreed = np.nonzero(support)[0]
                least_squares(
                    Rw,
                    pw,
                    agreed,
                    nodes,
                    sigma_node,
                    node,
                    plane,
                    theta,
                    normals,
                    A,
                    s,
                    covariance,
                    polish,
                )
                if not linearise(Rw, pw, everyone, nodes, node, plane, theta, normals, A, s, r, J):
                    count = 0
                    break
                cost, count = _judge(r, sigma, node, plane, cut, support)
                if count < 6:  # a false node has pulled it; a start is all that it must be
                    break
            if count < LEAST or not upright(Rw, pw, floor, 1.0):
                continue
            found = _keep(Rw, pw, cost, support, R_out, p_out, cost_out, support_out, found)
        if found and support_out[0].sum() == wanted:
            break  # everybody agrees
    return R_out, p_out, cost_out, support_out, found, seen, len(triples)


def floor_of(T_base_head: Array, height: float, tilt: float) -> Array:
    """What `upright` asks for, of a head on a vehicle that stands on a level floor. Shape (8,).

    Four flat nodes, three of them on a line, fit poses that are decimetres apart; but a vehicle
    does not hover.

    Args:
        T_base_head: mount. Shape (4, 4).
        height: of the base's origin over or under the floor z = 0 at most, m; inf if unknown.
        tilt: of the base at most, rad; inf if unknown.
    """
    level = np.cos(tilt) if tilt < np.pi else -2.0
    return np.concatenate([T_base_head[2, :3], inverse(T_base_head)[:3, 3], [level, height]])


@njit(cache=True)
def upright(R, p, floor, slack):
    """Whether a vehicle whose head is at R, p stands on the floor, within limits times slack."""
    up = R[2, 0] * floor[0] + R[2, 1] * floor[1] + R[2, 2] * floor[2]
    height = p[2] + R[2, 0] * floor[3] + R[2, 1] * floor[4] + R[2, 2] * floor[5]
    return 1.0 - up <= slack**2 * (1.0 - floor[6]) and abs(height) <= slack * floor[7]


@njit(cache=True)
def _first_of_pair(i, node, plane):
    for j in range(i):
        if node[j] == node[i] and plane[j] == plane[i]:
            return 0
    return 1


@njit(cache=True)
def _rays(node, plane, theta, normals):
    """Eq. 8 for all pairings: node (k,), rows of plane 1 and 2 (k, 2), unit direction (k, 3)."""
    m, k = len(theta), 0
    ray_node, rows = np.empty(m * m, dtype=np.int64), np.empty((m * m, 2), dtype=np.int64)
    f = np.empty((m * m, 3))
    for i in range(m):
        if plane[i] != 0:
            continue
        for j in range(m):
            if plane[j] != 1 or node[j] != node[i]:
                continue
            c, s = np.cos(theta[i]), np.sin(theta[i])
            ax, ay = c * normals[0, 0] - s * normals[0, 1], s * normals[0, 0] + c * normals[0, 1]
            az = normals[0, 2]
            tx, ty = c, s  # trace of plane 1
            c, s = np.cos(theta[j]), np.sin(theta[j])
            bx, by = c * normals[1, 0] - s * normals[1, 1], s * normals[1, 0] + c * normals[1, 1]
            bz = normals[1, 2]
            x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            length = np.sqrt(x * x + y * y + z * z)
            if length < 1e-6:
                continue
            if x * tx + y * ty < 0.0:
                length = -length
            f[k, 0], f[k, 1], f[k, 2] = x / length, y / length, z / length
            # Both fans are one-sided: a ray behind the second comes of a false crossing.
            if abs(_off(crossing_angle(normals[1], 1, f[k])[0], theta[j])) < 1e-6:
                ray_node[k], rows[k, 0], rows[k, 1] = node[i], i, j
                k += 1
    return ray_node[:k], rows[:k], f[:k]


@njit(cache=True)
def _off(a, b):
    off = a - b
    return off - 2.0 * np.pi * np.round(off / (2.0 * np.pi))


@njit(cache=True)
def _triples(ray_node, f, nodes):
    """Triples of rays to different nodes that are no line, widest solid angle first."""
    k = len(ray_node)
    most = k * (k - 1) * (k - 2) // 6
    triples, width = np.empty((most, 3), dtype=np.int64), np.empty(most)
    n = 0
    for a in range(k):
        for b in range(a + 1, k):
            for c in range(b + 1, k):
                i, j, h = ray_node[a], ray_node[b], ray_node[c]
                if i == j or j == h or h == i or collinear(nodes[i], nodes[j], nodes[h]):
                    continue
                triples[n, 0], triples[n, 1], triples[n, 2] = a, b, c
                width[n] = abs(
                    f[a, 0] * (f[b, 1] * f[c, 2] - f[b, 2] * f[c, 1])
                    - f[a, 1] * (f[b, 0] * f[c, 2] - f[b, 2] * f[c, 0])
                    + f[a, 2] * (f[b, 0] * f[c, 1] - f[b, 1] * f[c, 0])
                )
                n += 1
    kept = min(n, MOST_TRIPLES)
    ordered = np.empty((kept, 3), dtype=np.int64)
    for k in range(kept):
        widest = 0
        for i in range(n):
            if width[i] > width[widest]:
                widest = i
        width[widest] = -1.0
        for a in range(3):
            ordered[k, a] = triples[widest, a]
    return ordered


@njit(cache=True)
def collinear(a, b, c):
    """Whether three nodes lie too nearly on a line, see `p3p.COLLINEAR`."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    s1, s2 = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz
    s3 = (ux - vx) ** 2 + (uy - vy) ** 2 + (uz - vz) ** 2
    largest = max(s1, s2, s3)
    least = min(s1, s2, s3)
    middle = s1 + s2 + s3 - largest - least
    return x * x + y * y + z * z <= COLLINEAR**2 * largest * middle


@njit(cache=True)
def _judge(r, sigma, node, plane, cut, support):
    """Cost and number of agreeing crossings, at most one of each node and plane; fills support."""
    cost, count = 0.0, 0
    for i in range(len(r)):
        support[i] = False
    for i in range(len(r)):
        if not _first_of_pair(i, node, plane):
            continue
        best, least = i, np.inf
        for j in range(i, len(r)):
            if node[j] == node[i] and plane[j] == plane[i] and abs(r[j]) / sigma[j] < least:
                best, least = j, abs(r[j]) / sigma[j]
        if least < cut:
            support[best] = True
            count += 1
        cost += min(least, cut) ** 2
    return cost, count


@njit(cache=True)
def _keep(R, p, cost, support, R_out, p_out, cost_out, support_out, found):
    """Sorts a pose into those kept, by cost, once for each support."""
    for k in range(found):
        same = True
        for i in range(len(support)):
            same = same and support_out[k, i] == support[i]
        if same:  # up to where polishing ended, the same pose
            return found
    at = found
    while at > 0 and cost_out[at - 1] > cost:
        at -= 1
    if at == KEPT:
        return found
    for k in range(min(found, KEPT - 1), at - 1, -1):
        first = k == at
        cost_out[k] = cost if first else cost_out[k - 1]
        for i in range(len(support)):
            support_out[k, i] = support[i] if first else support_out[k - 1, i]
        for a in range(3):
            p_out[k, a] = p[a] if first else p_out[k - 1, a]
            for b in range(3):
                R_out[k, a, b] = R[a, b] if first else R_out[k - 1, a, b]
    return min(found + 1, KEPT)

"""The times of a band along the same poses, as fast as the limits allow."""

import numpy as np
from numba import njit

from twin.stack.planning.teb_terms import velocity_terms

SHORTEST = 0.02  # s between nodes at least
STRETCH, SWEEPS = 1.02, 60  # by which a piece is slowed at a time; times over the band


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

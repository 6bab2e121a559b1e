"""Residuals of the timed elastic band and their derivatives.

A node of the band is (x, y, yaw, t): pose in world, yaw unwrapped, and the time since the start.
Roesmann et al. (2012) take the time differences as variables; the nodes' times are their running
sum, which leaves the problem the same and keeps it banded where a moving obstacle's place depends
on the time. From node to node the twist in base counts as constant: the limits are put on it.

Mecanum wheels add up what each direction asks of them: a share of 1 is all they can do. The sum of
absolute values has edges, on which a straight drive lies; so the solver takes it as the planes
`+-x +-y +-z <= 1`, each of them smooth.
"""

import math
from typing import NamedTuple

from numba import njit


class Limits(NamedTuple):
    """Inverse limits, so that products are shares."""

    forward: float  # s/m
    strafe: float  # s/m
    turn: float  # s/rad
    push: float  # s^2/m: acceleration in any direction
    twist: float  # s^2/rad: angular acceleration


@njit(cache=True)
def twist_between(a, b):
    """Constant twist (vx, vy, omega) in base that leads from node a to node b."""
    dt, turn = b[3] - a[3], b[2] - a[2]
    k = arc_over_chord(turn)[0]
    c, s = math.cos(0.5 * (a[2] + b[2])), math.sin(0.5 * (a[2] + b[2]))
    dx, dy = b[0] - a[0], b[1] - a[1]
    return k * (c * dx + s * dy) / dt, k * (-s * dx + c * dy) / dt, turn / dt


@njit(cache=True)
def arc_over_chord(turn):
    """Length of an arc that turns by `turn` over its chord's, and its derivative."""
    h = 0.5 * turn
    if abs(h) < 1e-3:
        return 1.0 + h * h / 6.0, h / 6.0
    sine = math.sin(h)
    return h / sine, 0.5 * (sine - h * math.cos(h)) / (sine * sine)


@njit(cache=True)
def velocity_terms(a, b, limits, J):
    """Signed shares of the limits of vx, vy, omega that the twist from a to b takes.

    Fills J (3, 8) by their derivatives, a's part first.
    """
    dt, turn = b[3] - a[3], b[2] - a[2]
    k, k_turn = arc_over_chord(turn)
    c, s = math.cos(0.5 * (a[2] + b[2])), math.sin(0.5 * (a[2] + b[2]))
    dx, dy = b[0] - a[0], b[1] - a[1]
    fx, fy = (c * dx + s * dy) / dt, (-s * dx + c * dy) / dt
    for row in range(2):
        scale = limits.forward if row == 0 else limits.strafe
        f, side = (fx, fy) if row == 0 else (fy, -fx)
        by_dx, by_dy = (c, s) if row == 0 else (-s, c)
        J[row, 4] = scale * k * by_dx / dt
        J[row, 5] = scale * k * by_dy / dt
        J[row, 0], J[row, 1] = -J[row, 4], -J[row, 5]
        J[row, 2] = scale * (0.5 * k * side - k_turn * f)
        J[row, 6] = scale * (0.5 * k * side + k_turn * f)
        J[row, 7] = -scale * k * f / dt
        J[row, 3] = -J[row, 7]
    J[2, :] = 0.0
    J[2, 6], J[2, 7] = limits.turn / dt, -limits.turn * turn / (dt * dt)
    J[2, 2], J[2, 3] = -J[2, 6], -J[2, 7]
    return limits.forward * k * fx, limits.strafe * k * fy, limits.turn * turn / dt


@njit(cache=True)
def acceleration_terms(before, a, b, after, kind, limits, J):
    """Shares of the limits of acceleration (a size) and angular acceleration (signed) at a node.

    They are taken from the mean velocities in world on both sides.

    Args:
        before: kind 0, 2: node before; kind 1 (start of the band): velocity there.
        a: the node.
        b: kind 0, 1: node after.
        after: kind 2 (end of the band): velocity there.
        kind: 0 inside, 1 start, 2 end.
        limits: inverse limits.
        J: filled by the derivatives by the nodes before, at and after; (2, 12).
    """
    J[:] = 0.0
    d1 = a[3] - before[3] if kind != 1 else 0.0
    d2 = b[3] - a[3] if kind != 2 else 0.0
    tau = 0.5 * (d1 + d2)
    if kind == 1:
        first = (before[0], before[1], before[2])
    else:
        first = ((a[0] - before[0]) / d1, (a[1] - before[1]) / d1, (a[2] - before[2]) / d1)
    if kind == 2:
        second = (after[0], after[1], after[2])
    else:
        second = ((b[0] - a[0]) / d2, (b[1] - a[1]) / d2, (b[2] - a[2]) / d2)
    ax, ay = (second[0] - first[0]) / tau, (second[1] - first[1]) / tau
    turn = (second[2] - first[2]) / tau
    size = math.sqrt(ax * ax + ay * ay) + 1e-12
    acceleration = (ax, ay, turn)
    slope = (limits.push * ax / size, limits.push * ay / size, limits.twist)
    for k in range(3):
        row = 0 if k < 2 else 1
        if kind != 2:
            J[row, 8 + k] += slope[k] / (tau * d2)
            J[row, 4 + k] -= slope[k] / (tau * d2)
            by_d2 = slope[k] * (-second[k] / (d2 * tau) - 0.5 * acceleration[k] / tau)
            J[row, 11] += by_d2
            J[row, 7] -= by_d2
        if kind != 1:
            J[row, 4 + k] -= slope[k] / (tau * d1)
            J[row, k] += slope[k] / (tau * d1)
            by_d1 = slope[k] * (first[k] / (d1 * tau) - 0.5 * acceleration[k] / tau)
            J[row, 7] += by_d1
            J[row, 3] -= by_d1
    return limits.push * (size - 1e-12), limits.twist * turn

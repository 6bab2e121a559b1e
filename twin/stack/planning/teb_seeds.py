"""First bands for the optimiser: one for each side on which an obstacle may be passed.

A band is pulled, not pushed through: gradient descent never takes it across an obstacle. So what
stands near the reference is gathered into groups between which the vehicle does not fit, and the
reference is bent to the left and to the right of the first two groups.
"""

import math
from itertools import product

import numpy as np
from numba import njit

from twin.geometry import Array, wrap_angle
from twin.stack.planning.clearance import (
    AX,
    AY,
    BX,
    BY,
    RADIUS,
    VX,
    VY,
    Footprint,
    clearance,
    nearest,
)
from twin.stack.planning.teb_terms import Limits

SPACING = 0.05  # m between points of the reference
RAMP = 0.7  # m along which a bent reference leaves the straight one
WIDEST = 1.6  # m: farther round is the global planner's business
NEAR = 0.25  # m beside the vehicle within which an obstacle may be worth passing otherwise
BLEND = 0.6  # m along which the heading turns into the path's
# What a second of going sideways and of reversing counts: the depth camera looks ahead, and behind
# the lidar is blind too.
SIDEWAYS, BLIND = 1.5, 3.0
AHEAD, ABEAM = math.radians(50.0), math.radians(125.0)  # half the fields of view of both, in part
TOUCH = 1000.0  # s that a metre too little of room counts: as good as closed
GIVE = 0.20  # m by which a path may give way for it
TIGHT = 0.04  # m of room that a heading should leave
# Ahead or reversed, m along the path after which the heading begins to turn into it, and m along
# the path to the point that it looks at: the camera sees the floor from 1.2 m ahead of the vehicle
# on, so what lies behind a corner is only ever seen by one that looks into it before it is there.
MODES = (
    (0.0, 0.0, 2.4),
    (0.0, 0.0, 1.4),
    (0.0, 0.0, 0.0),
    (0.0, 0.4, 0.0),
    (0.0, 0.8, 0.0),
    (0.0, 1.4, 0.0),
    (0.0, 2.4, 0.0),
    (math.pi, 0.0, 0.0),
)
SHORT_SIGHTED = 1.0  # s that a heading costs which looks no farther than it goes: worth a bend
PASSES = 50
FEWEST = 21  # points of a reference: turning on the spot has a profile too
LEAN = 0.9  # of the limits that a first band uses


def spaced(path: Array) -> Array:
    """Path (n, 2) as points `SPACING` apart, both ends kept; short ones finer. Shape (k, 2)."""
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    k = max(math.ceil(lengths[-1] / SPACING) + 1, FEWEST)
    s = np.linspace(0.0, lengths[-1], k)
    return np.column_stack([np.interp(s, lengths, path[:, c]) for c in range(2)])


@njit(cache=True)
def smoothed(values, passes):
    """Rows with corners worn off over SPACING sqrt(passes / 2) m; the ends stay. Shape (k, c)."""
    out, k = values.copy(), values.shape[0]
    for _ in range(passes):
        for c in range(values.shape[1]):
            last = out[0, c]
            for i in range(1, k - 1):
                here = out[i, c]
                out[i, c] = 0.25 * last + 0.5 * here + 0.25 * out[i + 1, c]
                last = here
    return out


def headings(
    points: Array, start: float, goal: float, limits: Limits, half: Array, obstacles: Array
) -> tuple[Array, float]:
    """Unwrapped yaw at each point of a path, ahead, in reverse or sideways, and what it costs.

    The cost is the time at the limits of speed, and more where the rectangle would touch: in an
    aisle too narrow to turn round, reversing is the only way out.

    Args:
        points: shape (k, 2).
        start, goal: yaw at the ends, rad.
        limits: of the vehicle.
        half: half length and half width of the footprint. Shape (2,).
        obstacles: standing ones, rows as in `clearance`.
    """
    step = np.diff(points, axis=0)
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*step.T))])
    plain = start + wrap_angle(goal - start) * (
        s / s[-1] if s[-1] > 0 else np.linspace(0, 1, len(s))
    )
    if s[-1] < 2 * SPACING:
        return plain, _price(points, plain, limits)
    best, least = plain, _price(points, plain, limits)
    least += TOUCH * _tightness(points, plain, half, obstacles, TIGHT)
    blind = SHORT_SIGHTED * min(s[-1] / MODES[0][2], 1.0)
    least += blind
    blend = min(BLEND, 0.4 * s[-1])
    out = np.clip((s[-1] - s) / blend, 0.0, 1.0)
    for turned, pivot, sight in MODES:
        if pivot > s[-1] - 2 * blend and pivot > 0:
            continue
        yaw = _towards(points, s, sight) + turned
        yaw = yaw + 2 * math.pi * round((start - yaw[0]) / (2 * math.pi))
        end = yaw[-1] + wrap_angle(goal - yaw[-1])
        yaw = smoothed(yaw[:, None], PASSES)[:, 0]  # corners of the path turn early
        into = np.clip((s - pivot) / blend, 0.0, 1.0)
        yaw = start + into * (yaw - start)
        yaw = end + out * (yaw - end)
        cost = _price(points, yaw, limits) + blind * (1.0 - sight / MODES[0][2])
        if cost < least:
            cost += TOUCH * _tightness(points, yaw, half, obstacles, TIGHT)
        if cost < least:
            best, least = yaw, cost
    return best, least


def _towards(points: Array, s: Array, sight: float) -> Array:
    """Unwrapped direction at each point of a path to the one `sight` m on. Shape (k,)."""
    on = np.minimum(np.searchsorted(s, s + max(sight, 1e-9)), len(s) - 1)
    on[:-1] = np.maximum(on[:-1], np.arange(1, len(s)))
    d = points[on] - points
    d[-1] = d[-2]
    return np.unwrap(np.arctan2(d[:, 1], d[:, 0]))


@njit(cache=True)
def _tightness(points, yaw, half, obstacles, need):
    """Metres by which the room falls short of `need` at the tightest point but the first.

    Each point may first give way by up to `GIVE` to what is too near, as the optimiser will do;
    between two sides there is nowhere to give way to.
    """
    worst = 0.0
    for i in range(1, points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        d, k = nearest(x, y, yaw[i], 0.0, half, obstacles)
        for _ in range(4):
            if d >= need:
                break
            o = obstacles[k]
            _, dx, dy, _ = clearance(x, y, yaw[i], half, o[AX], o[AY], o[BX], o[BY])
            x, y = x + (need - d + 0.002) * dx, y + (need - d + 0.002) * dy
            if np.hypot(x - points[i, 0], y - points[i, 1]) > GIVE:
                break
            d, k = nearest(x, y, yaw[i], 0.0, half, obstacles)
        worst = max(worst, need - d)
    return worst


def _price(points: Array, yaw: Array, limits: Limits) -> float:
    """Seconds at the limits of speed alone, those that go where no sensor looks counted more."""
    step = np.diff(points, axis=0)
    middle = 0.5 * (yaw[1:] + yaw[:-1])
    off = np.abs(wrap_angle(np.arctan2(step[:, 1], step[:, 0]) - middle))
    price = np.where(off < AHEAD, 1.0, np.where(off < ABEAM, SIDEWAYS, BLIND))
    turn = np.abs(np.diff(yaw)) * limits.turn
    time = _shares(points, yaw, limits)[0]
    return float(np.sum(price * (time - turn) + turn))


def _shares(points: Array, yaw: Array, limits: Limits) -> tuple[Array, Array]:
    """Of each piece: time at the limits of speed, and inverse acceleration it allows. (k - 1,)."""
    d, turn = np.diff(points, axis=0), np.abs(np.diff(yaw))
    middle = 0.5 * (yaw[1:] + yaw[:-1])
    c, s = np.cos(middle), np.sin(middle)
    ahead, aside = np.abs(c * d[:, 0] + s * d[:, 1]), np.abs(-s * d[:, 0] + c * d[:, 1])
    time = ahead * limits.forward + aside * limits.strafe + turn * limits.turn
    return time, np.hypot(*d.T) * limits.push + turn * limits.twist


def timed(points: Array, yaw: Array, speed: float, limits: Limits, step: float, most: int) -> Array:
    """Band along a path, sped up from `speed` and down to rest. Shape (n, 4).

    Args:
        points: shape (k, 2).
        yaw: shape (k,), unwrapped.
        speed: along the path at its start, m/s.
        limits: of the vehicle.
        step: time between nodes, s.
        most: nodes at most.
    """
    slow, push = _shares(points, yaw, limits)
    if slow.sum() < 1e-9:  # nowhere to go
        rows = [[*points[0], yaw[0], k * step] for k in range(4)]
        return np.array(rows)
    # Travel is measured by the time it would take at full speed, so turning on the spot counts.
    travel = np.concatenate([[0.0], np.cumsum(slow)])
    slowest = LEAN / max(float((push / np.maximum(slow, 1e-12)).max()), 1e-6)
    chord = np.hypot(*np.diff(points, axis=0).T).sum() / travel[-1]
    begin = min(speed / max(chord, 0.1), LEAN) if speed > 0 else 0.0
    rate = np.minimum(LEAN, np.sqrt(begin**2 + 2 * slowest * travel))
    rate = np.minimum(rate, np.sqrt(2 * slowest * (travel[-1] - travel)))
    middle = np.maximum(0.5 * (rate[1:] + rate[:-1]), 0.02)
    times = np.concatenate([[0.0], np.cumsum(slow / middle)])
    n = int(np.clip(round(times[-1] / step) + 1, 5, most))
    at = np.linspace(0.0, times[-1], n)
    columns = [np.interp(at, times, c) for c in (points[:, 0], points[:, 1], yaw)]
    return np.column_stack([*columns, at])


def bent(points: Array, obstacles: Array, footprint: Footprint, room: float, pace: float):
    """The reference and its bends round the first two groups of obstacles.

    Args:
        points: the reference, `SPACING` apart. Shape (k, 2).
        obstacles: rows as in `clearance`.
        footprint: of the vehicle.
        room: m to keep.
        pace: m/s at which the reference is travelled, for what moves.

    Returns:
        Paths, each of shape (k, 2); the reference first.
    """
    if len(obstacles) == 0 or len(points) <= FEWEST:
        return [points]
    half = footprint.inscribed
    samples = _sampled(obstacles)
    lateral, where = _beside(points, samples, SPACING / pace)
    group = _groups(samples, 2 * (half + room))
    reach = np.abs(lateral) - samples[:, 4]
    inner = (where > 1) & (where < len(points) - 2)
    facing = np.unique(group[inner & (reach < half + NEAR)])
    facing = sorted(facing, key=lambda k: where[inner & (group == k)].min())[:2]
    bends = []
    for k in facing:
        members = (group == k) & (np.abs(lateral) < WIDEST)
        side, r, w = lateral[members], samples[members, 4], where[members]
        left, right = float((side + r).max()) + half + room, float((side - r).min()) - half - room
        span = (
            w.min() * SPACING - footprint.circumscribed,
            w.max() * SPACING + footprint.circumscribed,
        )
        bends.append([(far, *span) for far in (left, right) if abs(far) < WIDEST])
    out = [points]
    for choice in product(*(b for b in bends if b)):
        if choice:
            out.append(_shifted(points, choice))
    return out


def _shifted(points: Array, choice) -> Array:
    """Reference moved aside by each (offset, from, to), ramps between; the ends stay."""
    s = SPACING * np.arange(len(points))
    offset = np.zeros(len(points))
    for side, first, last in choice:
        ramp = np.clip(1 - np.maximum(first - s, s - last) / RAMP, 0.0, 1.0)
        ramp = side * ramp * ramp * (3 - 2 * ramp)
        offset = np.where(np.abs(ramp) > np.abs(offset), ramp, offset)
    ends = np.clip(np.minimum(s, s[-1] - s) / RAMP, 0.0, 1.0)
    offset *= ends * ends * (3 - 2 * ends)
    tangent = np.gradient(points, axis=0)
    tangent = tangent / np.maximum(np.hypot(tangent[:, 0], tangent[:, 1]), 1e-9)[:, None]
    return points + offset[:, None] * np.column_stack([-tangent[:, 1], tangent[:, 0]])


def _sampled(obstacles: Array) -> Array:
    """Obstacles as points x, y, vx, vy, radius at most 0.25 m apart. Shape (p, 5)."""
    ends = obstacles[:, AX : BY + 1]
    pieces = np.ceil(np.hypot(*(ends[:, 2:] - ends[:, :2]).T) / 0.25).astype(int) + 1
    row = np.repeat(np.arange(len(obstacles)), pieces)
    first = np.concatenate([[0], np.cumsum(pieces)[:-1]])
    k = (np.arange(len(row)) - first[row]) / np.maximum(pieces[row] - 1, 1)
    xy = ends[row, :2] + k[:, None] * (ends[row, 2:] - ends[row, :2])
    return np.column_stack([xy, obstacles[row][:, [VX, VY, RADIUS]]])


@njit(cache=True)
def _beside(points, samples, tick):
    """Signed distance (left positive) and index of the point nearest to each sample. (p,), (p,)."""
    p, k = samples.shape[0], points.shape[0]
    lateral, where = np.empty(p), np.empty(p, dtype=np.int64)
    for i in range(p):
        best = np.inf
        for j in range(k):
            dx = samples[i, 0] + samples[i, 2] * tick * j - points[j, 0]
            dy = samples[i, 1] + samples[i, 3] * tick * j - points[j, 1]
            d2 = dx * dx + dy * dy
            if d2 < best:
                best = d2
                a, b = max(j - 1, 0), min(j + 1, k - 1)
                cross = (points[b, 0] - points[a, 0]) * dy - (points[b, 1] - points[a, 1]) * dx
                lateral[i] = np.sqrt(d2) if cross >= 0 else -np.sqrt(d2)
                where[i] = j
    return lateral, where


@njit(cache=True)
def _groups(samples, gap):
    """Number of the group of each sample: linked where the vehicle does not fit between. (p,)."""
    p = samples.shape[0]
    group = np.arange(p)
    for i in range(p):
        for j in range(i):
            touch = gap + samples[i, 4] + samples[j, 4]
            dx, dy = samples[i, 0] - samples[j, 0], samples[i, 1] - samples[j, 1]
            together = (samples[i, 2] == samples[j, 2]) and (samples[i, 3] == samples[j, 3])
            if together and dx * dx + dy * dy < touch * touch and group[i] != group[j]:
                old, new = max(group[i], group[j]), min(group[i], group[j])
                for m in range(p):
                    if group[m] == old:
                        group[m] = new
    return group

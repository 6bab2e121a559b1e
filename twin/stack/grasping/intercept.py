"""When the arms must start, and where and when an arm meets a part on the moving belt.

Li & An 2025, section 3.2, states the idea: from the distance S that the depth camera measures, the
vehicle's speed and the fixed transforms among base, camera and arms, solve for the time t at which
the arms start to move, so that they are ready when the vehicle arrives. It gives no formula; the
ones here are derived in the docstrings. Pure functions of plain numbers.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

COARSE = 0.1  # s, step in which the first feasible moment is looked for
HALVINGS = 10  # then down to 0.1 ms


# --- grasp timing -------------------------------------------------------------------------------


def time_to_stop(
    distance: float, speed: float, deceleration: float, cruise: float | None = None
) -> float:
    """Seconds until the vehicle stands at the pick pose.

    Trapezoid of speed: from v to the cruise speed c, on at c, then down to rest, all at a:

        braking way   b = c^2 / 2a,      accelerating way   w = (c^2 - v^2) / 2a
        t = (c - v) / a + (S - w - b) / c + c / a            if S >= w + b
        t = (2 p - v) / a,  p^2 = a S + v^2 / 2              if there is no room to reach c

    With less way left than v^2 / 2a it brakes harder, evenly: t = 2 S / v.

    Args:
        distance: S along the way that is left, m.
        speed: v of the vehicle towards the pick pose, m/s.
        deceleration: a, also of speeding up, m/s^2.
        cruise: c, m/s; None if it goes on at its present speed.

    Returns:
        0 at the pick pose, inf if it stands off it and will not move.
    """
    left, v, a = distance, max(speed, 0.0), deceleration
    if left <= 0.0:
        return 0.0
    if v * v / (2 * a) >= left:
        return 2 * left / v
    c = v if cruise is None else max(cruise, v)
    if c <= 0.0:
        return float("inf")
    accelerating, braking = (c * c - v * v) / (2 * a), c * c / (2 * a)
    if left >= accelerating + braking:
        return (c - v) / a + (left - accelerating - braking) / c + c / a
    return (2 * np.sqrt(a * left + v * v / 2) - v) / a


def arm_start_delay(
    distance: float,
    speed: float,
    deceleration: float,
    preparation: float,
    cruise: float | None = None,
) -> float:
    """Seconds from now at which the arms must start; not above 0: now.

        t = time_to_stop(S, v) - preparation

    so that, started after t, they are ready in the moment in which the vehicle stands.

    Args:
        distance: S, m. See `time_to_stop`, also for speed, deceleration and cruise.
        preparation: time that the arms need from stow to ready, s.
    """
    return time_to_stop(distance, speed, deceleration, cruise) - preparation


# --- intercept ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Intercept:
    """Where along the belt and when an arm closes on a part."""

    time: float  # s
    x: float  # along the belt, m


def first_feasible(
    spare: Callable[[float], float], start: float, end: float, coarse: float = COARSE
) -> float | None:
    """Earliest time in [start, end] with `spare(time) >= 0`; None if there is none.

    Looks in coarse steps for the first feasible moment, then bisects the step before it. `spare`
    is the time that is left over when the arm sets out now; it may fall as a part runs away.
    """
    if end < start:
        return None
    low: float | None = None
    for time in [*np.arange(start, end, coarse), end]:
        if spare(float(time)) >= 0.0:
            high = float(time)
            break
        low = float(time)
    else:
        return None
    if low is None:
        return high
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if spare(middle) >= 0.0 else (middle, high)
    return high


def intercept(
    now: float,
    x: float,
    velocity: float,
    window: tuple[float, float],
    time_to_reach: Callable[[float], float],
    latest: float = 10.0,
) -> Intercept | None:
    """First time and place at which an arm can close on a part within its window.

    The part is at x(t) = x + velocity (t - now). Wanted is the smallest t with

        x_lo <= x(t) <= x_hi      and      t - now >= time_to_reach(x(t)).

    Args:
        now: s.
        x: of the part along the belt at `now`, m.
        velocity: of the part along x, m/s, either sign or 0.
        window: x_lo, x_hi of the arm's reach along the belt, m.
        time_to_reach: seconds that the arm needs, set off now, to close at x.
        latest: horizon, s from now.

    Returns:
        None if the part stays outside, passes before the arm is ready, or lies beyond the horizon.
    """
    low, high = window
    if velocity == 0.0:
        begin, end = (now, now + latest) if low <= x <= high else (now, now - 1.0)
    else:
        edges = sorted(now + (edge - x) / velocity for edge in window)
        begin, end = max(edges[0], now), min(edges[1], now + latest)

    def place(time: float) -> float:
        return min(max(x + velocity * (time - now), low), high)  # rounding at the edges

    time = first_feasible(lambda t: t - now - time_to_reach(place(t)), begin, end)
    return None if time is None else Intercept(time, place(time))

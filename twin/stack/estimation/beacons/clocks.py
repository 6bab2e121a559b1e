"""Clocks of nodes and T0 brought to the synchronising light's time (Liu et al. 2022, Eq. 2).

Each channel counts with its own offset, drift, wrap and quantisation. Pulses of the synchronising
light are numbered by their coded spacing, so missed pulses do no harm; a stamp is then carried to
the sequence's time either between the two pulses around it (the source) or by one straight line
through all pulses of the batch, which spreads the pulses' jitter.

Times are seconds of the sequence, from the pulse 0 of the code's turn in which T0's batch begins.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.geometry import Array
from twin.stack.estimation.beacons.stamps import (
    PLANE_1,
    SYNC,
    T0,
    Counter,
    NoFix,
    Noise,
    StampBatch,
    SyncSequence,
)

MATCH = 0.2  # of the code's step by which a pulse may miss its place
LEAST_PULSES = 5  # that must agree on the number: five bits of the code are unique
MOST_DRIFT = 5e-4  # relative: five times the worst quartz; more is a wrong match
GOOD, UNORDERED, UNMATCHED, SHORT = 0, 1, 2, 3


@dataclass(frozen=True)
class Aligned:
    """A batch in the sequence's time.

    Attributes:
        time: of every stamp, s; NaN where its channel is of no use. Shape (n,).
        local: of every stamp, s of its own clock since the channel's first pulse. Shape (n,).
        status: of each channel: `GOOD`, `UNORDERED`, `UNMATCHED` or `SHORT` (too few pulses).
        covariance: of each channel's offset and rate (s, relative) at local 0. Shape (c, 2, 2).
        rate: seconds of the sequence in one of each channel's. Shape (c,).
    """

    time: Array
    local: Array
    status: NDArray[np.int64]
    covariance: Array
    rate: Array


def align(
    stamps: StampBatch,
    sequence: SyncSequence,
    counter: Counter,
    noise: Noise,
    interpolate: bool = False,
) -> Aligned | NoFix:
    """Times of all stamps.

    Args:
        stamps: of all channels.
        sequence, counter: as built into the nodes.
        noise: of the pulses' stamps.
        interpolate: between neighbouring pulses as in Eq. 2; else a line through all of them.
    """
    ticks, channel, kind = stamps.ticks, stamps.channel, stamps.kind
    n = len(stamps.nodes) + 1
    if not all(isinstance(part, np.ndarray) for part in (ticks, channel, kind)):
        return NoFix("malformed stamps", "channel, kind and ticks must be arrays")
    if not (ticks.ndim == 1 and channel.shape == kind.shape == ticks.shape):
        return NoFix("malformed stamps", "channel, kind and ticks differ in length")
    if (
        ticks.dtype.kind not in "iuf"
        or channel.dtype.kind not in "iu"
        or kind.dtype.kind not in "iu"
    ):
        return NoFix("malformed stamps", "ticks must be numbers, channel and kind whole numbers")
    if ticks.dtype.kind == "f":
        if not np.isfinite(ticks).all():
            return NoFix("stamps not finite", f"{int((~np.isfinite(ticks)).sum())} stamps")
        if len(ticks) and np.abs(ticks).max() >= 2.0**62:
            return NoFix("malformed stamps", "a stamp exceeds any counter")
    if (
        not len(ticks)
        or channel.min() < 0
        or channel.max() >= n
        or kind.min() < 0
        or kind.max() > 2
    ):
        return NoFix("malformed stamps", f"no stamps, or a channel beyond {n} or a kind beyond 2")
    sigma = np.hypot(noise.sync, counter.tick / np.sqrt(12))
    return Aligned(
        *_align(
            channel.astype(np.int64),
            kind.astype(np.int64),
            ticks.astype(np.int64),
            n,
            counter.bits,
            counter.tick,
            sequence.period,
            sequence.step,
            np.array(sequence.code, dtype=np.int64),
            sigma,
            interpolate,
        )
    )


@njit(cache=True)
def _align(channel, kind, ticks, n, bits, tick, period, step, code, sigma, interpolate):
    count = len(ticks)
    time, local = np.full(count, np.nan), np.full(count, np.nan)
    status, rate = np.full(n, SHORT), np.ones(n)
    covariance = np.zeros((n, 2, 2))
    at, number = np.empty(count, dtype=np.int64), np.empty(count, dtype=np.int64)
    modulo = np.int64(1) << bits
    half, turn = modulo >> 1, len(code)
    origin = 0  # middle pulse of T0's batch, to which the others' turns of the code are fitted
    for c in range(n):
        first, last, pulses = np.int64(-1), np.int64(0), 0
        for i in range(count):
            if channel[i] != c:
                continue
            if first < 0:
                first, last = i, ticks[i]
            gone = (ticks[i] - last) % modulo
            if gone >= half:  # a step back, once the wrap is undone
                status[c] = UNORDERED
                break
            last = ticks[i]
            if kind[i] == SYNC:
                at[pulses] = i
                pulses += 1
        if status[c] == UNORDERED or pulses < LEAST_PULSES:
            continue
        zero = ticks[at[0]]
        for i in range(count):
            if channel[i] == c:
                gone = (ticks[i] - zero) % modulo
                local[i] = tick * (gone if gone < half else gone - modulo)
        pulses = _number(local, at, number, pulses, period, step, code)
        if pulses == 0:
            status[c] = UNMATCHED
            continue
        if c == T0:
            origin = number[pulses // 2]
        else:  # the turn of the code in which T0's batch lies
            k = np.int64(np.round((origin - number[pulses // 2]) / turn))
            for j in range(pulses):
                number[j] += k * turn
        line = _line(local, at, number, pulses, period, step, code)
        a, b, mean, spread = line
        if abs(b - 1.0) > MOST_DRIFT:
            status[c] = UNMATCHED
            continue
        status[c], rate[c] = GOOD, b
        covariance[c, 1, 1] = sigma * sigma / spread
        covariance[c, 0, 1] = covariance[c, 1, 0] = -mean * covariance[c, 1, 1]
        covariance[c, 0, 0] = sigma * sigma / pulses + mean * mean * covariance[c, 1, 1]
        k = 0
        for i in range(count):
            if channel[i] != c:
                continue
            if interpolate:
                while k < pulses - 2 and local[i] >= local[at[k + 1]]:
                    k += 1
                t0 = number[k] * period + step * code[number[k] % turn]
                t1 = number[k + 1] * period + step * code[number[k + 1] % turn]
                s0, s1 = local[at[k]], local[at[k + 1]]
                time[i] = t0 + (local[i] - s0) * (t1 - t0) / (s1 - s0)
            else:
                time[i] = a + b * local[i]
    return time, local, status, covariance, rate


@njit(cache=True)
def _number(local, at, number, pulses, period, step, code):
    """Numbers the pulses; keeps those that fit the code. Returns how many, 0 if none or unclear."""
    turn, best, second, best_shift, best_anchor = len(code), 0, 0, 0, 0
    for anchor in range(min(3, pulses)):  # a stray first pulse must not spoil all
        for shift in range(turn):
            found, before = 0, np.int64(-(1 << 40))
            for j in range(pulses):
                gone = local[at[j]] - local[at[anchor]]
                n = shift + np.int64(np.round(gone / period))
                off = gone - (n - shift) * period - step * (code[n % turn] - code[shift])
                if abs(off) < MATCH * step and n > before:
                    found += 1
                    before = n
            if found > best:
                if best_anchor == anchor:
                    second = best
                best, best_shift, best_anchor = found, shift, anchor
            elif found > second and anchor == best_anchor:
                second = found
    if best < LEAST_PULSES or second >= best or 2 * best <= pulses:
        return 0
    kept, before = 0, np.int64(-(1 << 40))
    for j in range(pulses):
        gone = local[at[j]] - local[at[best_anchor]]
        n = best_shift + np.int64(np.round(gone / period))
        off = gone - (n - best_shift) * period - step * (code[n % turn] - code[best_shift])
        if abs(off) < MATCH * step and n > before:
            at[kept], number[kept], before = at[j], n, n
            kept += 1
    return kept


@njit(cache=True)
def _line(local, at, number, pulses, period, step, code):
    """Offset and rate of the sequence's time over a clock's, mean and spread of its pulses."""
    mean_s = mean_t = 0.0
    for j in range(pulses):
        mean_s += local[at[j]]
        mean_t += number[j] * period + step * code[number[j] % len(code)]
    mean_s, mean_t = mean_s / pulses, mean_t / pulses
    ss = st = 0.0
    for j in range(pulses):
        ds = local[at[j]] - mean_s
        dt = number[j] * period + step * code[number[j] % len(code)] - mean_t
        ss, st = ss + ds * ds, st + ds * dt
    b = st / ss
    return mean_t - b * mean_s, b, mean_s, ss


@dataclass(frozen=True)
class Spin:
    """How the head turned within one revolution, from T0.

    Turns since the zero instant at `start`: x0 + f u + c u (u - length) / length^2 with
    u = t - start. The last term is a change of speed within the revolution.

    Attributes:
        start, length: of the revolution, s of the sequence's time.
        terms: x0 (turns), f (turns/s), c (turns). Shape (3,).
        covariance: of `terms`. Shape (3, 3).
    """

    start: float
    length: float
    terms: Array
    covariance: Array


def spin(
    stamps: StampBatch, aligned: Aligned, rate: float, counter: Counter, noise: Noise
) -> Spin | NoFix:
    """The last whole revolution in the batch, by T0's sights of plane 1.

    Args:
        stamps, aligned: the batch.
        rate: nominal turns per second, known within a few percent.
        counter, noise: belief in the stamps and in the steadiness of the spin.
    """
    if aligned.status[T0] != GOOD:
        return NoFix("no reference", "T0's clock cannot be aligned to the synchronising light")
    passes = np.nonzero((stamps.channel == T0) & (stamps.kind == PLANE_1))[0]
    times, local = aligned.time[passes], aligned.local[passes]
    gaps = np.diff(times) * rate
    whole = np.nonzero(np.abs(gaps - 1.0) < 0.05)[0]
    if not len(whole):
        return NoFix("no reference", f"T0 saw plane 1 {len(passes)} times, no whole revolution")
    k = int(whole[-1])
    start, length = times[k], times[k + 1] - times[k]
    u = times - start
    turns = np.round(u / length)
    near = np.abs(u / length - turns) < 0.01  # others are reflections
    near[k] = near[k + 1] = True
    u, turns, passes, local = u[near], turns[near], passes[near], local[near]
    sigma = np.hypot(noise.crossing, counter.tick / np.sqrt(12)) / length
    beyond = np.maximum(np.maximum(-turns, turns - 1.0), 0.0)  # revolutions outside this one
    # A speed that jumps by the jitter each revolution and changes evenly between: by so much the
    # parabola may be wrong outside, and by half the step's difference inside.
    variance = sigma**2 + 2.0 * beyond * noise.spin_jitter**2
    A = np.column_stack([np.ones(len(u)), u, u * (u - length) / length**2])
    A_w = A / variance[:, None]
    information = A.T @ A_w
    information[2, 2] += 2.0 / max(noise.spin_jitter, 1e-9) ** 2
    covariance = np.linalg.inv(information)
    terms = covariance @ (A_w.T @ turns)
    # T0's own clock: an error of offset a and rate b moves all passes by a + b local.
    moved = -terms[1] * np.array([[1.0, local[turns == 0][0]], [0.0, 1.0], [0.0, 0.0]])
    covariance = covariance + moved @ aligned.covariance[T0] @ moved.T
    return Spin(float(start), float(length), terms, covariance)

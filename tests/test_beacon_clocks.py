"""Clocks of the photoelectric network: Eq. 2, drift, wrap, missed pulses, the spin; bad stamps."""

from dataclasses import replace

import numpy as np
import pytest
from beacon_world import BeaconWorld

from twin.stack.estimation.beacons.clocks import GOOD, SHORT, UNMATCHED, Aligned, align, spin
from twin.stack.estimation.beacons.stamps import (
    PLANE_1,
    SYNC,
    T0,
    Counter,
    NoFix,
    Noise,
    StampBatch,
    SyncSequence,
    batch,
)

SEQUENCE, COUNTER, NOISE = SyncSequence(), Counter(), Noise()
PULSES = np.arange(3, 12)


def stamped(drift, crossing=0.031, offset=12_345, pulses=PULSES):
    """A channel of Eq. 2: pulses and one crossing at known times of the sequence."""
    sync = SEQUENCE.times(pulses)
    return [((t * (1 + drift)) / COUNTER.tick + offset).round().astype(np.int64)
            for t in (sync, np.array([crossing]))]  # fmt: skip


def two_channels(*args, **kwargs) -> StampBatch:
    reference = stamped(0.0)
    return batch(("A",), [(*reference, []), (*stamped(*args, **kwargs), [])])


def aligned(stamps, **kwargs) -> Aligned:
    found = align(stamps, SEQUENCE, COUNTER, NOISE, **kwargs)
    assert isinstance(found, Aligned)
    return found


def crossing_times(stamps, **kwargs):
    found = aligned(stamps, **kwargs)
    return found.time[np.asarray(stamps.kind) == PLANE_1]


def test_any_five_pulses_in_a_row_tell_their_number():
    code = SEQUENCE.code * 2
    assert len({code[i : i + 5] for i in range(31)}) == 31


def test_eq_2_by_hand():
    # Between the two pulses around the crossing, as the source writes it.
    stamps = two_channels(80e-6)
    sync, ticks = SEQUENCE.times(PULSES), np.asarray(stamps.ticks)
    own = np.asarray(stamps.channel) == 1
    local = ticks[own & (stamps.kind == SYNC)].astype(float)
    p = float(ticks[own & (stamps.kind == PLANE_1)][0])
    n = int(np.searchsorted(local, p)) - 1
    expected = sync[n] + (p - local[n]) * (sync[n + 1] - sync[n]) / (local[n + 1] - local[n])
    assert crossing_times(stamps, interpolate=True)[1] == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("interpolate", [False, True])
@pytest.mark.parametrize("drift", [-100e-6, 100e-6])
def test_drift_of_100_ppm_is_removed(drift, interpolate):
    """Expected result: within a few ticks, where the raw clock is off by 3 microseconds."""
    times = crossing_times(two_channels(drift), interpolate=interpolate)
    assert abs(0.031 * drift) > 3e-6
    assert times == pytest.approx([0.031, 0.031], abs=2e-8)


def test_wrap_of_the_counter():
    stamps = two_channels(30e-6)
    ticks = np.asarray(stamps.ticks)
    own = np.asarray(stamps.channel) == 1
    wrap = 1 << COUNTER.bits
    for at in (2, 5, 9):  # the wrap falls between various stamps
        moved = ticks.copy()
        moved[own] = (moved[own] - moved[own][at]) % wrap
        times = crossing_times(replace(stamps, ticks=moved))
        assert times == pytest.approx([0.031, 0.031], abs=2e-8)


def test_missed_pulses_and_a_stray_one():
    full = two_channels(50e-6)
    few = two_channels(50e-6, pulses=PULSES[[0, 1, 3, 4, 6, 8]])
    stray = two_channels(50e-6)
    ticks = np.asarray(stray.ticks).copy()
    ticks[np.nonzero((stray.channel == 1) & (stray.kind == SYNC))[0][4]] += 40_000
    for stamps in (full, few, replace(stray, ticks=ticks)):
        assert crossing_times(stamps) == pytest.approx([0.031, 0.031], abs=2e-8)


def test_a_node_whose_batch_begins_in_another_turn_of_the_code():
    stamps = two_channels(0.0, crossing=0.16, pulses=np.arange(28, 36))
    reference = stamped(0.0, pulses=np.arange(26, 36))
    stamps = batch(("A",), [(*reference, []), (*stamped(0.0, 0.16, 0, np.arange(28, 36)), [])])
    times = crossing_times(stamps)
    assert times[1] - times[0] == pytest.approx(0.16 - 0.031, abs=2e-8)


def test_channel_without_pulses_or_with_a_foreign_light():
    reference = stamped(0.0)
    lonely = batch(("A",), [(*reference, []), (stamped(0.0)[0][:3], [5_000_000], [])])
    assert aligned(lonely).status.tolist() == [GOOD, SHORT]
    steady = np.arange(9) * 530_000
    assert aligned(batch(("A",), [(*reference, []), (steady, [5], [])])).status[1] == UNMATCHED
    fast = (stamped(0.0)[0] * 1.001).astype(np.int64)  # no quartz is so bad
    assert aligned(batch(("A",), [(*reference, []), (fast, [5], [])])).status[1] == UNMATCHED


def test_covariance_of_the_line():
    stamps = two_channels(0.0)
    found = aligned(stamps)
    rng = np.random.default_rng(0)
    local = SEQUENCE.times(PULSES) - SEQUENCE.times(PULSES)[0]
    sigma = np.hypot(NOISE.sync, COUNTER.tick / np.sqrt(12))
    fits = [np.polyfit(local, sigma * rng.standard_normal(len(local)), 1)[::-1]
            for _ in range(4000)]  # fmt: skip
    assert found.covariance[1] == pytest.approx(np.cov(np.array(fits).T), rel=0.1)


def test_spin_from_t0():
    world = BeaconWorld(revolutions=3, spin_rate=41.0)
    stamps = world.batch(np.random.default_rng(1), noisy=False)
    turn = spin(stamps, aligned(stamps), 40.5, COUNTER, NOISE)  # nominal is off by a percent
    assert not isinstance(turn, NoFix)
    assert turn.terms[1] == pytest.approx(41.0, rel=1e-6)
    assert abs(turn.terms[0]) < 1e-6 and turn.length == pytest.approx(1 / 41, abs=2e-8)


def test_spin_without_a_whole_revolution():
    world = BeaconWorld(revolutions=2)
    stamps = world.batch(np.random.default_rng(1))
    keep = ~((stamps.channel == T0) & (stamps.kind == PLANE_1))
    keep[np.nonzero(~keep)[0][[0, 2]]] = True  # one missed: a gap of two turns
    stamps = StampBatch(stamps.nodes, stamps.channel[keep], stamps.kind[keep], stamps.ticks[keep])
    turn = spin(stamps, aligned(stamps), 30.0, COUNTER, NOISE)
    assert isinstance(turn, NoFix) and turn.reason == "no reference"


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"ticks": lambda t: t.astype(float) * np.nan}, "stamps not finite"),
        ({"ticks": lambda t: t[:-1]}, "malformed stamps"),
        ({"ticks": lambda t: t.astype(float) * 1e300}, "malformed stamps"),
        ({"ticks": lambda t: t.astype(str)}, "malformed stamps"),
        ({"channel": lambda c: c + 1}, "malformed stamps"),
        ({"channel": lambda c: c - 1}, "malformed stamps"),
        ({"channel": lambda c: c.tolist()}, "malformed stamps"),
        ({"kind": lambda k: k + 2}, "malformed stamps"),
        ({"kind": lambda k: k.astype(float)}, "malformed stamps"),
    ],
)
def test_bad_stamps_are_named(change, reason):
    stamps = two_channels(0.0)
    ((name, alter),) = change.items()
    found = align(replace(stamps, **{name: alter(getattr(stamps, name))}), SEQUENCE, COUNTER, NOISE)
    assert isinstance(found, NoFix) and found.reason == reason


def test_empty_batch():
    none = np.zeros(0, dtype=np.int64)
    found = align(StampBatch((), none, none, none), SEQUENCE, COUNTER, NOISE)
    assert isinstance(found, NoFix)

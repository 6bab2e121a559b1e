"""A photoelectric network on paper: truth, clocks, noise and faults to raw stamps, for tests.

Crossing times are found by bisection of the plane equation along the true motion, so nothing of
the estimator's own formulas is used.
"""

from dataclasses import dataclass, field

import numpy as np

from twin.geometry import rot_z, transform
from twin.stack.estimation.beacons.stamps import (
    PLANE_1,
    PLANE_2,
    SYNC,
    Counter,
    HeadParameters,
    NodeSurvey,
    Noise,
    StampBatch,
    SyncSequence,
)

MARGIN = 6e-3  # s before and after the turns that a batch reaches
NAMES = ("T1", "T2", "T3", "T4", "T5", "T6")
# A flat truss of 2 m x 1 m on the wall x = 4 m, seen from the origin; not all on one circle.
TRUSS = np.array(
    [[4, -1, 0.2], [4, 1, 0.2], [4, 1, 1.2], [4, -1, 1.2], [4, -0.25, 1.2], [4, 0.3, 0.2]],
    dtype=float,
)


def exp_twist(twist, t):
    """Motion of t seconds with a constant twist in body axes: the matrix exponential's series.

    Shapes (6,), (...) to (..., 4, 4).
    """
    v, w = np.asarray(twist[:3]), np.asarray(twist[3:])
    M = np.zeros((4, 4))
    M[:3, :3] = [[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]
    M[:3, 3] = v
    M = M * np.asarray(t, dtype=float)[..., None, None]
    out, term = np.eye(4) + 0 * M, np.eye(4) + 0 * M
    for k in range(1, 12 if np.any(twist) else 1):
        term = term @ M / k
        out = out + term
    return out


@dataclass
class BeaconWorld:
    """The plant's side: what is true, and what is wrong."""

    T_world_base: np.ndarray = field(default_factory=lambda: np.eye(4))  # at time 0
    # T0 stands behind the head, so that the zero instant cuts no sight of the truss.
    T_base_head: np.ndarray = field(default_factory=lambda: transform(rot_z(-2.5), (0.1, 0, 0.6)))
    twist: np.ndarray = field(default_factory=lambda: np.zeros(6))  # of the base, own axes
    nodes: np.ndarray = field(default_factory=lambda: TRUSS.copy())
    names: tuple = NAMES
    survey_sigma: float = 30e-6
    head: HeadParameters = field(default_factory=HeadParameters)
    spin_rate: float = 30.0
    noise: Noise = field(default_factory=Noise)
    sequence: SyncSequence = field(default_factory=SyncSequence)
    counter: Counter = field(default_factory=Counter)
    drift: float = 100e-6  # 1 sigma of the clocks' rates
    blocked: tuple = ()  # names
    missed_sync: float = 0.0  # probability
    missed: float = 0.0  # probability that a node misses a plane
    half_seen: dict = field(default_factory=dict)  # name -> kind of the plane that it misses
    reflections: dict = field(default_factory=dict)  # name -> (shift of p_world, keeps true one)
    revolutions: int = 1

    def survey(self, rng=None) -> NodeSurvey:
        error = 0.0 if rng is None else rng.normal(0, self.survey_sigma, self.nodes.shape)
        sigma = np.full(len(self.nodes), self.survey_sigma)
        return NodeSurvey(self.names, self.nodes + error, sigma)

    def head_pose(self, t):
        return self.T_world_base @ exp_twist(self.twist, t) @ self.T_base_head

    def batch(self, rng, noisy=True) -> StampBatch:
        """Raw stamps of `revolutions` turns whose last one has its middle near time 0."""
        n = self.noise if noisy else Noise(0.0, 0.0, 0.0)
        period = 1.0 / self.spin_rate
        knots = 1.0 + n.spin_jitter * rng.standard_normal(self.revolutions + 4)
        begin = -(self.revolutions - 0.5) * period  # first zero instant of the batch

        mean = 0.5 * (knots[:-1] + knots[1:])
        whole = np.concatenate([[0.0], np.cumsum(mean)]) - mean[0]

        def turns(t):  # since the first zero instant; the speed runs evenly from knot to knot
            x = (np.asarray(t) - begin) / period + 1.0
            k = np.clip(np.floor(x).astype(int), 0, len(knots) - 2)
            x = x - k
            return whole[k] + knots[k] * x + 0.5 * (knots[k + 1] - knots[k]) * x * x

        first_pulse = int(rng.integers(0, 10_000))
        window = begin - MARGIN, begin + self.revolutions * period + MARGIN
        phase = rng.uniform(0.0, self.sequence.period)
        p = self.sequence.period
        numbers = first_pulse + np.arange(-1, int((window[1] - window[0]) / p) + 3)
        pulses = self.sequence.times(numbers) - self.sequence.times(first_pulse) + window[0] + phase
        pulses = pulses[(pulses >= window[0]) & (pulses <= window[1])]
        count = np.arange(self.revolutions + 1)
        zeros = begin + count * period
        zeros = _bisect(lambda t: turns(t) - count, zeros - 1e-3, zeros + 1e-3)
        events = [self._events(pulses, zeros, [], n, rng)]
        places, owner = [], []
        for i, (name, node) in enumerate(zip(self.names, self.nodes, strict=True)):
            here = [] if name in self.blocked else [node]
            if name in self.reflections:
                shift, keeps = self.reflections[name]
                here = [node + shift] + (here if keeps else [])
            places += here
            owner += [i] * len(here)
        crossings = [self._crossings(np.array(places), k, turns, begin, period) for k in range(2)]
        for i in range(len(self.names)):
            planes = [[t for t, j in found if owner[j] == i] for found in crossings]
            if self.names[i] in self.half_seen:
                planes[self.half_seen[self.names[i]] - PLANE_1] = []
            if self.missed:
                planes = [[t for t in plane if rng.random() >= self.missed] for plane in planes]
            events.append(self._events(pulses, *planes, n, rng))
        channel, kind, ticks = [], [], []
        for i, (times, kinds) in enumerate(events):
            rate = 1.0 + self.drift * rng.standard_normal()
            offset = rng.integers(0, 1 << self.counter.bits)
            order = np.argsort(times, kind="stable")
            counted = np.floor((times[order] - window[0]) * rate / self.counter.tick)
            ticks.append((counted.astype(np.int64) + offset) % (1 << self.counter.bits))
            channel.append(np.full(len(times), i))
            kind.append(kinds[order])
        return StampBatch(self.names, *(np.concatenate(x) for x in (channel, kind, ticks)))

    def _events(self, pulses, plane_1, plane_2, n, rng):
        kept = pulses[rng.random(len(pulses)) >= self.missed_sync]
        times = [kept + n.sync * rng.standard_normal(len(kept))]
        for plane in (plane_1, plane_2):
            plane = np.array(plane, dtype=float)
            times.append(plane + n.crossing * rng.standard_normal(len(plane)))
        kinds = np.repeat([SYNC, PLANE_1, PLANE_2], [len(t) for t in times])
        return np.concatenate(times), kinds

    def plane_sides(self, nodes, k, turns, t):
        """Distance of nodes from plane k at times t, and how far they are before the fan."""
        angle = 2 * np.pi * turns(t)
        h = self.head
        tilt, lead = ((h.phi_1, 0.0), (-h.phi_2, h.phi_r))[k]
        c, s = np.cos(angle + lead), np.sin(angle + lead)
        T = self.head_pose(t)
        p = np.einsum("...ji,...j->...i", T[..., :3, :3], nodes - T[..., :3, 3])
        along, across = c * p[..., 0] + s * p[..., 1], c * p[..., 1] - s * p[..., 0]
        return np.cos(tilt) * p[..., 2] - np.sin(tilt) * across, along

    def _crossings(self, nodes, k, turns, begin, period):
        """(time, index of the place) of every crossing of plane k."""
        grid = begin + period * np.linspace(-0.02, self.revolutions + 0.02, 40 * self.revolutions)
        side, along = self.plane_sides(nodes[:, None], k, turns, grid)
        ahead = (along[:, :-1] > 0) & (along[:, 1:] > 0)
        i, j = np.nonzero(ahead & (side[:, :-1] * side[:, 1:] < 0))
        sign = np.sign(side[i, j + 1])
        times = _bisect(
            lambda t: sign * self.plane_sides(nodes[i], k, turns, t)[0], grid[j], grid[j + 1]
        )
        return sorted(zip(times.tolist(), i.tolist(), strict=True))


def _bisect(f, low, high):
    for _ in range(46):
        middle = 0.5 * (low + high)
        below = f(middle) < 0
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return 0.5 * (low + high)

"""A photoelectric network on paper: truth, clocks, noise and faults to raw stamps, for tests.

Crossing times are found by bisection of the plane equation along the true motion, so nothing of
the estimator's own formulas is used.
"""

from dataclasses import dataclass, field

import numpy as np

from twin.geometry import apply, inverse, rot_z, transform
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

NAMES = ("T1", "T2", "T3", "T4", "T5", "T6")
# A flat truss of 2 m x 1 m on the wall x = 4 m, seen from the origin; not all on one circle.
TRUSS = np.array(
    [[4, -1, 0.2], [4, 1, 0.2], [4, 1, 1.2], [4, -1, 1.2], [4, -0.25, 1.2], [4, 0.3, 0.2]],
    dtype=float,
)


def exp_twist(twist, t):
    """Motion of t seconds with a constant twist in body axes, by the matrix exponential's series."""
    v, w = np.asarray(twist[:3]) * t, np.asarray(twist[3:]) * t
    M = np.zeros((4, 4))
    M[:3, :3] = [[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]
    M[:3, 3] = v
    out, term = np.eye(4), np.eye(4)
    for k in range(1, 18):
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
    head: HeadParameters = HeadParameters()
    spin_rate: float = 30.0
    noise: Noise = Noise()
    sequence: SyncSequence = SyncSequence()
    counter: Counter = Counter()
    drift: float = 100e-6  # 1 sigma of the clocks' rates
    blocked: tuple = ()  # names
    missed_sync: float = 0.0  # probability
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

        def turns(t):  # since the first zero instant; the speed runs evenly from knot to knot
            x = (t - begin) / period + 1.0
            k = int(np.clip(np.floor(x), 0, len(knots) - 2))
            x -= k
            mean = 0.5 * (knots[:-1] + knots[1:])
            part = knots[k] * x + 0.5 * (knots[k + 1] - knots[k]) * x * x
            return mean[:k].sum() + part - mean[0]

        first_pulse = int(rng.integers(0, 10_000))
        window = begin - 2e-3, begin + self.revolutions * period + 2e-3
        p = self.sequence.period
        numbers = first_pulse + np.arange(-1, int((window[1] - window[0]) / p) + 3)
        pulses = self.sequence.times(numbers) - self.sequence.times(first_pulse) + window[0]
        pulses = pulses[(pulses >= window[0]) & (pulses <= window[1])]
        zeros = [self._solve(lambda t, k=k: turns(t) - k, begin, k * period) for k in
                 range(self.revolutions + 1)]  # fmt: skip
        events = [self._events(pulses, zeros, [], n, rng)]
        for name, node in zip(self.names, self.nodes, strict=True):
            planes = [[], []]
            places = [] if name in self.blocked else [node]
            if name in self.reflections:
                shift, keeps = self.reflections[name]
                places = [node + shift] + (places if keeps else [])
            for place in places:
                for k in range(2):
                    planes[k] += self._crossings(place, k, turns, begin, period)
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

    @staticmethod
    def _solve(f, begin, guess):
        low, high = begin + guess - 1e-3, begin + guess + 1e-3
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if f(middle) < 0 else (low, middle)
        return 0.5 * (low + high)

    def plane_side(self, node, k, turns, t):
        """Distance of a node from plane k at time t, and how far it is before the fan."""
        angle = 2 * np.pi * turns(t)
        h = self.head
        tilt, lead = ((h.phi_1, 0.0), (-h.phi_2, h.phi_r))[k]
        trace = rot_z(angle + lead) @ np.array([1.0, 0, 0])
        up = rot_z(angle + lead) @ np.array([0, np.cos(tilt), np.sin(tilt)])
        p = apply(inverse(self.head_pose(t)), node)
        return float(np.cross(trace, up) @ p), float(trace @ p)

    def _crossings(self, node, k, turns, begin, period):
        grid = begin + period * np.linspace(-0.02, self.revolutions + 0.02, 40 * self.revolutions)
        sides = [self.plane_side(node, k, turns, t) for t in grid]
        found = []
        for (a, fa), (b, fb), low, high in zip(sides, sides[1:], grid, grid[1:], strict=False):
            if fa > 0 and fb > 0 and a * b < 0:
                for _ in range(50):
                    middle = 0.5 * (low + high)
                    side = self.plane_side(node, k, turns, middle)[0]
                    low, high = (middle, high) if side * a > 0 else (low, middle)
                found.append(0.5 * (low + high))
        return found

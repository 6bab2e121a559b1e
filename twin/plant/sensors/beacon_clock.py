"""Time in the photoelectric network: the turning head, the synchronising lamp, the nodes' counters.

Numbers: models/beacon/README.md.
"""

import numpy as np

TICK = 1e-8  # s, nominal, of a node's counter
BITS = 32  # of it
PERIOD, STEP = 5e-3, 5e-4  # s from pulse to pulse, and by which a coded one comes late
CODE = (0, 0, 0, 0, 1, 0, 0, 1, 0, 1, 1, 0, 0, 1, 1, 1, 1, 1, 0, 0, 0, 1, 1, 0, 1, 1, 1, 0, 1, 0, 1)


class NodeClock:
    """A free-running counter: any start, a rate of its own, whole ticks, wrapping.

    Args:
        rng: draws start and rate.
        drift: relative, 1 sigma.
    """

    def __init__(self, rng: np.random.Generator, drift: float):
        self.rate = 1.0 + drift * rng.standard_normal()
        self._start = rng.uniform(0, 2**BITS)

    def ticks(self, time: float) -> int:
        """What it reads."""
        return int(np.floor(self._start + time * self.rate / TICK)) % 2**BITS


class Spin:
    """How far the head has turned; from turn to turn it is a little faster or slower.

    Args:
        rng: draws the speeds.
        rate: turns a second, mean.
        jitter: of the speed at each turn's start, relative, 1 sigma; in between it changes evenly.
    """

    def __init__(self, rng: np.random.Generator, rate: float, jitter: float):
        self._rng, self.rate, self._jitter = rng, rate, jitter
        self._start = float(rng.uniform(0, 1))  # of a turn, at time zero
        self._speed = [self._draw(), self._draw()]
        self._whole = [self._start]

    def _draw(self) -> float:
        return 1.0 + self._jitter * float(self._rng.standard_normal())

    def turns(self, time: float) -> float:
        """Turns since the start, of which the whole ones pass T0."""
        x = time * self.rate
        k = max(int(x), 0)
        speed, whole = self._speed, self._whole
        while len(whole) <= k:
            whole.append(whole[-1] + 0.5 * (speed[-2] + speed[-1]))
            speed.append(self._draw())
        x -= k
        return whole[k] + speed[k] * x + 0.5 * (speed[k + 1] - speed[k]) * x * x


class SyncLamp:
    """The lamp of the synchronising light: when its coded pulses come (Liu et al. 2022, Fig. 3).

    Args:
        rng: draws which pulse is the first, and when.
    """

    def __init__(self, rng: np.random.Generator):
        self._first, self._phase = int(rng.integers(0, 10_000)), float(rng.uniform(0, PERIOD))

    def between(self, low: float, high: float) -> list[float]:
        """Times of the pulses with low < time <= high, s."""
        n = int((low - self._phase) / PERIOD) - 2
        found = []
        while (time := self._at(n)) <= high:
            if time > low:
                found.append(time)
            n += 1
        return found

    def _at(self, n: int) -> float:
        return self._phase + n * PERIOD + STEP * CODE[(self._first + n) % len(CODE)]

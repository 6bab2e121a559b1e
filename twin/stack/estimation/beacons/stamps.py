"""What the photoelectric network gives and what must be known of it.

Frames: *head*, z along the spin axis, x along the trace of plane 1 in the plane z = 0 when plane 1
passes the reference sensor T0 (Liu et al. 2022, Fig. 7); *world*; *base*.
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twin.geometry import Array

SYNC, PLANE_1, PLANE_2 = 0, 1, 2  # kinds of a stamp
T0 = 0  # channel of the reference sensor; node i of a batch is channel i + 1

Reason = Literal[
    "few nodes",  # fewer than three with both planes
    "collinear nodes",
    "danger cylinder",  # head on the cylinder through the nodes: position undetermined
    "no redundancy",  # nothing left that could contradict the fix
    "stamps out of order",
    "stamps not finite",
    "malformed stamps",
    "unknown node",  # not in the survey
    "no reference",  # T0 saw no whole revolution or no synchronising light
    "no solution",  # no pose agrees with enough crossings
    "residuals",  # the best pose does not fit the noise
    "ambiguous",  # two poses fit about as well
    "loose geometry",  # position known worse than allowed
]


@dataclass(frozen=True)
class NoFix:
    """Why there is no pose; `detail` is one line for a log."""

    reason: Reason
    detail: str


@dataclass(frozen=True)
class SyncSequence:
    """The synchronising light, t_a(n) of Liu et al. 2022, Eq. 2.

    Pulse n comes at n * period + step * code[n mod len(code)], so that a few pulses in a row tell
    their number, whatever the offset of the clock that stamped them. The source says nothing about
    how a pulse is known; the code is ours (maximal-length, five bits: any five in a row are
    unique). Period and step are guesses.
    """

    period: float = 5e-3  # s
    step: float = 5e-4  # s
    code: tuple[int, ...] = (
        *(0, 0, 0, 0, 1, 0, 0, 1, 0, 1, 1, 0, 0, 1, 1),
        *(1, 1, 1, 0, 0, 0, 1, 1, 0, 1, 1, 1, 0, 1, 0, 1),
    )  # x^5 + x^2 + 1

    def times(self, n: NDArray[np.integer]) -> Array:
        """Seconds of pulses n since pulse 0."""
        n = np.asarray(n)
        return n * self.period + self.step * np.asarray(self.code)[n % len(self.code)]


@dataclass(frozen=True)
class Counter:
    """Free-running counter that stamps: nominal tick and width. Guess: 100 MHz, 32 bit."""

    tick: float = 1e-8  # s
    bits: int = 32


@dataclass(frozen=True)
class StampBatch:
    """Raw stamps of one revolution or more, as counted by each channel's own clock.

    Attributes:
        nodes: names of the channels after T0's.
        channel: 0 for T0, i + 1 for nodes[i]. Shape (n,).
        kind: `SYNC`, `PLANE_1` or `PLANE_2`: the node's processor marks what it recognised
            (Liu et al. 2022, section 3.1). Shape (n,).
        ticks: counter readings, each channel in the order of events. Shape (n,).
    """

    nodes: tuple[str, ...]
    channel: NDArray[np.integer]
    kind: NDArray[np.integer]
    ticks: NDArray


def batch(nodes: tuple[str, ...], events: list[tuple[ArrayLike, ArrayLike, ArrayLike]]):
    """`StampBatch` from (sync, plane 1, plane 2) ticks of T0 and each node, wrapped or not sorted.

    For tools and tests: sorts each channel by its ticks, so it must not hold a wrap.
    """
    channel, kind, ticks = [], [], []
    for i, triple in enumerate(events):
        parts = [np.atleast_1d(np.asarray(part, dtype=np.int64)) for part in triple]
        t = np.concatenate(parts)
        order = np.argsort(t, kind="stable")
        channel.append(np.full(len(t), i))
        kind.append(np.repeat([SYNC, PLANE_1, PLANE_2], [len(p) for p in parts])[order])
        ticks.append(t[order])
    return StampBatch(nodes, *(np.concatenate(part) for part in (channel, kind, ticks)))


@dataclass(frozen=True)
class NodeSurvey:
    """Nodes as the laser tracker measured them.

    Attributes:
        names: of the nodes.
        p_world: m. Shape (n, 3).
        sigma: standard deviation along each axis, m. Shape (n,).
    """

    names: tuple[str, ...]
    p_world: Array
    sigma: Array
    index: dict[str, int] = field(init=False, repr=False)

    def __post_init__(self):
        index = {name: i for i, name in enumerate(self.names)}
        shaped = np.shape(self.p_world) == (len(index), 3) and np.shape(self.sigma) == (len(index),)
        if len(index) != len(self.names) or not shaped:
            raise ValueError("survey: names must differ, each with a position and a sigma")
        if not (np.all(np.isfinite(self.p_world)) and np.all(np.asarray(self.sigma) >= 0)):
            raise ValueError("survey: a position or sigma is not a number")
        object.__setattr__(self, "index", index)


@dataclass(frozen=True)
class HeadParameters:
    """Tilts of the two planes against z = 0 and the angle between their traces, rad (Eq. 29).

    45 degrees each and a right angle between: "orthogonal" in the source, its values unprinted.
    """

    phi_1: float = float(np.pi / 4)
    phi_2: float = float(np.pi / 4)
    phi_r: float = float(np.pi / 2)

    def as_array(self) -> Array:
        """phi_1, phi_2, phi_r. Shape (3,)."""
        return np.array([self.phi_1, self.phi_2, self.phi_r])


@dataclass(frozen=True)
class Noise:
    """Standard deviations that the estimator believes in.

    `crossing` is 50 microradians at 30 turns a second: what a linearised study needs for the
    source's scatter. The others are guesses.
    """

    crossing: float = 0.265e-6  # s, of one crossing's stamp
    sync: float = 0.05e-6  # s, of one synchronising pulse's stamp
    spin_jitter: float = 1e-5  # of the speed from one revolution to the next, relative

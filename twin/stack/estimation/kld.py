"""How many particles are enough, and drawing that many.

KLD sampling (Xu et al., Eq. 23; Fox 2003, Eq. 7): with probability 1 - delta the cloud differs from
the distribution it stands for by a Kullback-Leibler distance of less than epsilon, if its size
grows with the number k of histogram bins that it fills.
"""

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.geometry import Array


@dataclass(frozen=True)
class Kld:
    """Bounds of the particle count.

    Attributes:
        epsilon: Kullback-Leibler distance allowed.
        delta: probability of more.
        bin_size: edges of a bin in x, y (m) and yaw (rad); an infinite yaw makes bins 2D.
        least, most: number of particles.
    """

    epsilon: float = 0.05
    delta: float = 0.01
    bin_size: tuple[float, float, float] = (0.10, 0.10, float(np.radians(5.0)))
    least: int = 500
    most: int = 10_000

    def __post_init__(self):
        sized = all(size > 0 for size in self.bin_size) and np.all(np.isfinite(self.bin_size[:2]))
        if not (self.epsilon > 0 and 0 < self.delta < 1 and sized and 1 <= self.least <= self.most):
            raise ValueError(f"KLD: {self} is out of range")

    def count(self, bins: int) -> int:
        """Particles needed for a cloud that fills `bins` bins, within the bounds."""
        wanted = self.least if bins < 2 else int(np.ceil(bound(bins, self.epsilon, self.delta)))
        return min(max(wanted, self.least), self.most)


def bound(bins: int, epsilon: float, delta: float) -> float:
    """Xu et al., Eq. 23: Wilson-Hilferty form of the chi-square quantile over 2 epsilon.

    Args:
        bins: filled bins k, at least 2.
        epsilon: Kullback-Leibler distance.
        delta: probability that it is exceeded.
    """
    a = 2.0 / (9.0 * (bins - 1))
    z = NormalDist().inv_cdf(1.0 - delta)
    return (bins - 1) / (2.0 * epsilon) * (1.0 - a + math.sqrt(a) * z) ** 3


def low_variance(weights: Array, count: int, u: float) -> NDArray[np.int64]:
    """Indices drawn in proportion to weights with one random number (Thrun et al. 2005, Table 4.4).

    Args:
        weights: not negative, their sum positive. Shape (n,).
        count: number of draws m.
        u: uniform number of [0, 1).

    Returns:
        Indices in rising order. Each comes floor or ceil of m times its share. Shape (m,).
    """
    return _low_variance(np.ascontiguousarray(weights, dtype=np.float64), count, u)


def count_bins(poses: Array, bin_size: tuple[float, float, float]) -> int:
    """Number of histogram bins that poses (n, 3) fill."""
    return int(_count(bin_keys(poses, bin_size)))


def draw(poses: Array, weights: Array, kld: Kld, u: float) -> NDArray[np.int64]:
    """Indices of the smallest low-variance sample that is as large as its own bins ask for.

    From the least number up: a sample of n fills k(n) bins, and k grows with n, so the first n
    that satisfies its own bound is approached from below.
    """
    n = kld.least
    while True:
        drawn = low_variance(weights, n, u)
        wanted = kld.count(count_bins(np.take(poses, drawn, axis=0), kld.bin_size))
        if wanted <= n:
            return drawn
        n = wanted


@njit(cache=True)
def _low_variance(weights, count, u):
    spacing = np.sum(weights) / count
    drawn = np.empty(count, dtype=np.int64)
    i, reached = 0, weights[0]
    for m in range(count):
        pointer = (u + m) * spacing
        while pointer >= reached and i < len(weights) - 1:
            i += 1
            reached += weights[i]
        drawn[m] = i
    return drawn


@njit(cache=True)
def bin_keys(poses, bin_size):
    """One whole number for the bin of each pose; 21 bits an axis. Shape (n, 3) to (n,)."""
    keys = np.empty(len(poses), dtype=np.int64)
    for i in range(len(poses)):
        key = 0
        for axis in range(3):
            key = (key << 21) | (int(np.floor(poses[i, axis] / bin_size[axis])) & 0x1FFFFF)
        keys[i] = key
    return keys


@njit(cache=True)
def _count(keys):
    """Distinct keys, in a hash table with linear probing at most half full."""
    size = 16
    while size < 2 * len(keys):
        size *= 2
    table = np.empty(size, dtype=np.int64)
    used = np.zeros(size, dtype=np.bool_)
    found = 0
    for key in keys:
        slot = (key ^ (key >> 21) * 0x9E3779B1 ^ (key >> 42) * 0x85EBCA6B) & (size - 1)
        while used[slot] and table[slot] != key:
            slot = (slot + 1) & (size - 1)
        if not used[slot]:
            used[slot], table[slot] = True, key
            found += 1
    return found

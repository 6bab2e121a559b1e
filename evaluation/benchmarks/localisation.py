"""AMCL's full update against the same update in plain NumPy.

    python -m evaluation.benchmarks.localisation [--repeats 30]

A full update moves 10,000 particles, weighs them by 100 beams, redraws and clusters them. The
particle count is held at 10,000, both sides are given the same map, scan and particles, and the
median of the log-likelihoods' difference is printed with the times: they must agree. The beams are
looked up as in the stack, in a table finer than the map; NumPy gets the distances as finely. One
peer works each beam's density out, as the equations stand; the other looks its logarithm up as ours
does, which is what is left when the algorithm is the same.
"""

import argparse
import copy
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from twin.geometry import Array, wrap_angle
from twin.messages import LidarScan
from twin.stack.estimation.amcl import Amcl, AmclSettings
from twin.stack.estimation.beam_model import BeamModel
from twin.stack.estimation.clusters import BIN_SIZE
from twin.stack.estimation.kld import Kld
from twin.stack.estimation.likelihood_field import LikelihoodField
from twin.stack.estimation.motion_models import MotionNoise

PARTICLES, BEAMS = 10_000, 100
RANGE_MAX = 30.0  # m
RESOLUTION, SIDE = 0.05, 400  # m, cells: a hall of 20 m with racks
SPREADS = {"settled (3 cm)": 0.03, "spread (1 m)": 1.0}
STEP = np.array([0.10, 0.0, 0.05])
MODEL = BeamModel()


def hall() -> LikelihoodField:
    """Walls and six racks."""
    cells = np.zeros((SIDE, SIDE), dtype=bool)
    cells[[0, -1], :] = cells[:, [0, -1]] = True
    for row in (80, 180, 280):
        for column in (60, 220):
            cells[row : row + 20, column : column + 100] = True
    return LikelihoodField(cells, (0.0, 0.0), RESOLUTION, 2.0)


def finer(field: LikelihoodField) -> LikelihoodField:
    """The field with its distances interpolated as finely as the stack's table."""
    k, (h, w) = MODEL.finer, field.distances.shape
    fine = copy.copy(field)
    finer_cells = cv2.resize(field.distances, (k * w, k * h), interpolation=cv2.INTER_LINEAR)
    fine.distances = np.asarray(finer_cells, dtype=np.float32)
    fine.resolution = field.resolution / k
    return fine


def scan_in(field: LikelihoodField, pose: Array, stamp: float) -> LidarScan:
    """Ranges along the beams until the map is met, by small steps."""
    angles = -np.radians(135) + np.radians(0.25) * np.arange(1081)
    reach = np.arange(0.1, 25.0, 0.02)
    x = pose[0] + np.cos(angles + pose[2])[:, None] * reach
    y = pose[1] + np.sin(angles + pose[2])[:, None] * reach
    met = field.lookup(np.stack([x.ravel(), y.ravel()], axis=1)).reshape(x.shape) == 0.0
    ranges = np.where(met.any(axis=1), reach[np.argmax(met, axis=1)], np.inf)
    return LidarScan(stamp, float(angles[0]), float(np.radians(0.25)), ranges, RANGE_MAX)


def log_density(distances: NDArray[np.floating]) -> Array:
    """Of a beam that ends so far from the nearest obstacle, Xu et al., Eqs. 19-22."""
    normal = np.exp(-0.5 * (distances / MODEL.sigma) ** 2) / (np.sqrt(2 * np.pi) * MODEL.sigma)
    return np.log(MODEL.z_hit * normal + MODEL.z_rand / RANGE_MAX)


def tabled(field: LikelihoodField) -> LikelihoodField:
    """The field with log-densities in place of distances."""
    table = copy.copy(field)
    table.distances = log_density(field.distances).astype(np.float32)
    table.max_distance = float(log_density(np.array(field.max_distance)))
    return table


def numpy_update(
    particles: Array,
    p_base: Array,
    field: LikelihoodField,
    rng: np.random.Generator,
    density: Callable[[Array], Array] = log_density,
) -> tuple[Array, Array]:
    """The same update in whole-array NumPy. Returns log-likelihoods and the mean pose."""
    noise, n = MotionNoise(), len(particles)
    path, turn = np.hypot(STEP[0], STEP[1]), abs(STEP[2])
    z = rng.standard_normal((n, 3))
    along = path + np.hypot(noise.along_by_path * path, noise.along_by_turn * turn) * z[:, 0]
    across = np.hypot(noise.across_by_path * path, noise.across_by_turn * turn) * z[:, 1]
    moved = np.empty_like(particles)
    c, s = np.cos(particles[:, 2]), np.sin(particles[:, 2])
    moved[:, 0] = particles[:, 0] + c * along - s * across
    moved[:, 1] = particles[:, 1] + s * along + c * across
    spread = np.hypot(noise.turn_by_path * path, noise.turn_by_turn * turn)
    moved[:, 2] = wrap_angle(particles[:, 2] + STEP[2] + spread * z[:, 2])

    log_likelihood = numpy_log_likelihood(moved, p_base, field, density)
    weights = np.exp(MODEL.independent * (log_likelihood - log_likelihood.max()))
    weights /= weights.sum()
    drawn = np.searchsorted(np.cumsum(weights), (rng.random() + np.arange(n)) / n).clip(0, n - 1)
    redrawn = moved[drawn]
    np.unique(packed(np.floor(redrawn / Kld().bin_size).astype(int)))  # bins of the KLD count
    return log_likelihood, numpy_estimate(redrawn)


def packed(cells: NDArray[np.integer]) -> NDArray[np.integer]:
    """One whole number for each triple. Shape (n, 3) to (n,)."""
    return (cells[:, 0] << 42) + (cells[:, 1] << 21) + cells[:, 2]


def numpy_estimate(poses: Array) -> Array:
    """Mean pose of the largest cluster of bins that touch."""
    size = np.array(BIN_SIZE)
    turns = round(2 * np.pi / BIN_SIZE[2])
    cells = np.floor(poses / size).astype(int)
    cells[:, 2] %= turns
    _, first, bin_of = np.unique(packed(cells), return_index=True, return_inverse=True)
    bins = cells[first]
    left = {tuple(b): i for i, b in enumerate(bins.tolist())}
    label, clusters = np.zeros(len(bins), dtype=int), 0
    while left:
        stack = [left.popitem()]
        while stack:
            (x, y, t), i = stack.pop()
            label[i] = clusters
            near = product((x - 1, x, x + 1), (y - 1, y, y + 1), (t - 1, t, t + 1))
            around = ((a, b, c % turns) for a, b, c in near)
            stack += [(key, left.pop(key)) for key in around if key in left]
        clusters += 1
    cluster = label[bin_of]
    inside = poses[cluster == np.argmax(np.bincount(cluster))]
    mean = inside.mean(axis=0)
    mean[2] = np.arctan2(np.sin(inside[:, 2]).mean(), np.cos(inside[:, 2]).mean())
    np.cov(inside.T)
    return mean


def numpy_log_likelihood(
    poses: Array,
    p_base: Array,
    field: LikelihoodField,
    density: Callable[[Array], Array] = log_density,
) -> Array:
    """Mean log-density of the beams for each pose. Shape (n,)."""
    c, s = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
    x = poses[:, 0, None] + c * p_base[:, 0] - s * p_base[:, 1]
    y = poses[:, 1, None] + s * p_base[:, 0] + c * p_base[:, 1]
    column = np.floor((x - field.origin[0]) / field.resolution).astype(int)
    row = np.floor((y - field.origin[1]) / field.resolution).astype(int)
    h, w = field.distances.shape
    inside = (column >= 0) & (column < w) & (row >= 0) & (row < h)
    distance = np.full(x.shape, field.max_distance)
    distance[inside] = field.distances[row[inside], column[inside]]
    return density(distance).mean(axis=1)


def timed(repeats: int, prepare: Callable[[], object], run: Callable[[], object]) -> list[float]:
    """Milliseconds of each of `repeats` runs after one to warm up."""
    found = []
    for i in range(repeats + 1):
        prepare()
        start = time.perf_counter()
        run()
        if i:
            found.append(1e3 * (time.perf_counter() - start))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--repeats", type=int, default=30)
    asked = parser.parse_args()
    field = hall()
    fine = finer(field)
    free = field.distances > 0.3
    pose = np.array([10.0, 7.0, 0.3])
    scan = scan_in(field, pose, 1.0)
    kld = Kld(least=PARTICLES, most=PARTICLES)
    # Redrawn at every update, whatever the weights.
    settings = replace(AmclSettings(), beams=replace(MODEL, beams=BEAMS), kld=kld, redraw_below=1.1)
    amcl = Amcl(field, free, np.eye(4), RANGE_MAX, np.random.default_rng(0), settings)
    p_base, silent = amcl.likelihood.choose(scan, np.eye(4))
    p_wide = np.asarray(p_base, dtype=float)
    assert len(p_base) == BEAMS and silent == 0
    table = Table(
        "cloud", "AMCL ms: median, least", "NumPy", "ms: median, least", "ratio", "agree to"
    )
    peers = {"equations": (fine, log_density), "table": (tabled(fine), np.asarray)}
    for label, spread in SPREADS.items():
        sigma = np.array([spread, spread, 0.3 * spread])
        particles = pose + np.random.default_rng(1).normal(0, 1, (PARTICLES, 3)) * sigma

        def prepare(sigma=sigma):
            amcl.stamp = 0.0
            amcl.initialise(pose, np.diag(sigma**2), np.zeros(3))

        ours = timed(asked.repeats, prepare, lambda: amcl.update(scan, STEP))
        a = amcl.likelihood.log_likelihood(particles, p_base)
        for name, (of, density) in peers.items():
            rng = np.random.default_rng(2)
            work = partial(numpy_update, particles, p_wide, of, rng, density)
            theirs = timed(max(asked.repeats // 5, 3), lambda: None, work)
            b = numpy_log_likelihood(particles, p_wide, of, density)
            ratio = statistics.median(theirs) / statistics.median(ours)
            table.add_row(
                label,
                f"{statistics.median(ours):.2f}, {min(ours):.2f}",
                name,
                f"{statistics.median(theirs):.1f}, {min(theirs):.1f}",
                f"{ratio:.1f}",
                f"{np.median(np.abs(a - b)):.1e}",
            )
    Console().print(f"full update, {PARTICLES} particles x {BEAMS} beams")
    Console().print(table)


if __name__ == "__main__":
    main()

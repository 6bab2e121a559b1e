"""Adaptive Monte Carlo localisation on a known map.

Particles move with the odometry (Xu et al., Eqs. 8-15), are weighed by the scan (Eqs. 19-22) and
redrawn, as many as their spread asks for (Eq. 23). When scans fit worse than they used to, part of
them is drawn where the scan fits on the whole map instead (augmented MCL, Thrun et al. 2005,
Table 8.3), which brings back a vehicle that was carried away.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array, between2, compose2, wrap_angle
from twin.messages import LidarScan
from twin.stack.estimation.beam_model import BeamModel, ScanLikelihood, beam_density
from twin.stack.estimation.clusters import heaviest, mean_and_covariance
from twin.stack.estimation.global_search import GlobalSearch
from twin.stack.estimation.kld import Kld, count_bins, draw, low_variance
from twin.stack.estimation.likelihood_field import LikelihoodField
from twin.stack.estimation.motion_models import MotionNoise, omnidirectional
from twin.stack.estimation.scans import scan_fault

MotionModel = Callable[[Array, Array, MotionNoise, Any], Array]


@dataclass(frozen=True)
class AmclSettings:
    """Tuning of the filter.

    Checked on the plant, seeds 0-4, in the aisles at up to 0.95 m/s without tags: 5-8 mm RMS of
    position, 2-4 mrad of yaw. `kld` was compared with a fixed 10,000: 6.9 against 7.0 mm.
    """

    beams: BeamModel = field(default_factory=BeamModel)
    kld: Kld = field(default_factory=Kld)
    noise: MotionNoise = field(default_factory=MotionNoise)
    motion: MotionModel = omnidirectional
    # A standing vehicle sees the same errors again and again; taken as news they deceive.
    min_path: float = 0.05  # m driven between updates
    min_turn: float = 0.035  # rad turned, likewise
    redraw_below: float = 0.5  # share of effective particles
    slow: float = 0.02  # share by which the long mean of the fit follows, each update
    fast: float = 0.3  # the short mean, likewise
    expected: float = 0.7  # share of beams that the map explains, before any is seen
    slack: float = 0.10  # by which the short mean may fall short of the long one
    most_recovery: float = 0.7  # share of particles that recovery may take


class Amcl:
    """The filter. Readings are passed in order; nothing here reads a clock.

    Args:
        map_field: distances to the map's obstacles.
        free: cells in which the vehicle's centre may be, same shape as the field.
        T_base_lidar: mount of the lidar. Shape (4, 4).
        range_max: of the lidar, m.
        rng: for all that is drawn.
        settings: tuning.

    Raises:
        ValueError: for a mask of free cells of another shape than the map, or without any.
    """

    def __init__(
        self,
        map_field: LikelihoodField,
        free: NDArray[np.bool_],
        T_base_lidar: Array,
        range_max: float,
        rng: np.random.Generator,
        settings: AmclSettings | None = None,
    ):
        free = np.asarray(free, dtype=bool)
        if free.shape != map_field.distances.shape or not free.any():
            raise ValueError(
                f"AMCL: {int(free.sum())} free cells in a mask of shape {free.shape}, "
                f"wanted some in the map's shape {map_field.distances.shape}"
            )
        self.settings = s = settings or AmclSettings()
        self._rng, self._mount = rng, np.asarray(T_base_lidar, dtype=float)
        self.likelihood = ScanLikelihood(map_field, s.beams, range_max)
        self._search = GlobalSearch(map_field, free, s.beams, range_max)
        self._scan: tuple[NDArray[np.float32], int] | None = None  # last one weighed
        self.stamp = -np.inf  # of the last scan, s
        self._odometry: Array | None = None  # at the last update
        self.dropped = 0
        self.updates = 0  # scans weighed
        self.quality = s.expected  # share of the last scan's beams that the map explains
        # Log-density of a beam of nowhere, and how much more one that ends on the map has.
        self._nowhere = float(np.log(s.beams.z_rand / range_max))
        self._on_map = float(np.log(beam_density(0.0, s.beams, range_max))) - self._nowhere
        self._slow = self._fast = s.expected
        self._judged = False  # whether any scan was weighed
        self.scatter()

    def initialise(
        self, pose: Array, covariance: Array, odometry: Array | None = None, stamp: float = -np.inf
    ) -> None:
        """Start anew about a pose: at switch-on, or where a tag says so.

        Args:
            pose: x, y, yaw in world. Shape (3,).
            covariance: shape (3, 3).
            odometry: pose of the odometry at that time; unknown, it is taken from the next scan.
            stamp: time of the pose, s; older scans are dropped from now on.

        Raises:
            ValueError: if pose or covariance are not finite or not of their shape.
        """
        pose, covariance = np.array(pose, dtype=float), np.array(covariance, dtype=float)
        odometry = None if odometry is None else np.array(odometry, dtype=float)
        usable = pose.shape == (3,) and covariance.shape == (3, 3) and np.all(np.isfinite(pose))
        if not (usable and np.all(np.isfinite(covariance)) and _planar(odometry)):
            raise ValueError(f"AMCL: start {pose} with covariance {covariance.tolist()} refused")
        values, axes = np.linalg.eigh(0.5 * (covariance + covariance.T))
        root = axes * np.sqrt(np.maximum(values, 0.0))
        particles = pose + self._rng.standard_normal((self.settings.kld.most, 3)) @ root.T
        particles[:, 2] = wrap_angle(particles[:, 2])
        kept = draw(particles, np.ones(len(particles)), self.settings.kld, self._rng.random())
        self._odometry = odometry
        self.stamp = max(self.stamp, stamp)
        self._set(particles[kept])
        self.pose, self.covariance, self.dominance = pose, root @ root.T, 1.0

    def scatter(self) -> None:
        """Know nothing: the most particles, all over the free cells."""
        self._set(self._search.uniform(self.settings.kld.most, self._rng))
        self._estimate()

    def update(self, scan: LidarScan, odometry: Array) -> str | None:
        """Take a scan with the odometry's pose (x, y, yaw) at its exposure.

        Returns:
            None, or in one line why the scan was dropped; the state is then unchanged.
        """
        fault = scan_fault(scan)
        if fault is None and scan.stamp <= self.stamp:
            fault = f"scan at {scan.stamp:.3f} s dropped: not newer than {self.stamp:.3f} s"
        if fault is None and not _planar(np.asarray(odometry)):
            fault = f"scan at {scan.stamp:.3f} s dropped: its odometry is not a finite pose"
        if fault is not None:
            self.dropped += 1
            return fault
        s, odometry = self.settings, np.array(odometry, dtype=float)
        step = np.zeros(3) if self._odometry is None else between2(self._odometry, odometry)
        p_base, silent = self.likelihood.choose(scan, self._mount)
        self.stamp = scan.stamp
        rest = self._odometry is not None
        rest = rest and np.hypot(*step[:2]) < s.min_path and abs(step[2]) < s.min_turn
        if (
            self._judged
            and rest
            and not self.lost
            and self._fits(compose2(self.pose, step), p_base, silent)
        ):
            return None
        self._odometry, self._scan = odometry, (p_base, silent)
        self.updates += 1
        self.particles = s.motion(self.particles, step, s.noise, self._normals())
        self._weigh(p_base, silent)
        self._redraw(p_base, silent)
        self._estimate()
        return None

    def pose_at(self, odometry: Array) -> Array:
        """Pose in world when the odometry says `odometry`: the last estimate, carried on."""
        if self._odometry is None:
            return self.pose.copy()
        return compose2(self.pose, between2(self._odometry, odometry))

    def fit(self, pose: Array, odometry: Array | None = None) -> float | None:
        """How well the last scan weighed fits a pose: geometric mean of its beams' density, 1/m.

        Args:
            pose: x, y, yaw in world. Shape (3,).
            odometry: what the odometry said at that pose, by which it is carried to the scan's
                exposure; without one the pose is taken as that of the exposure.

        Returns:
            None before the first scan. To be compared with other poses of the same scan.
        """
        if self._scan is None:
            return None
        pose = np.asarray(pose, dtype=float)
        if odometry is not None and self._odometry is not None:
            pose = compose2(pose, between2(odometry, self._odometry))
        return float(np.exp(self.likelihood.log_likelihood(pose[None], *self._scan)[0]))

    def explained(self, pose: Array, odometry: Array) -> float:
        """Share of the last scan's beams that the map explains from a pose; arguments of `fit`."""
        fit = self.fit(pose, odometry)
        return 0.0 if fit is None else float(self._explained(np.log([fit]))[0])

    @property
    def pose_odometry(self) -> Array | None:
        """What the odometry said at the last scan weighed, to which `pose` belongs. Shape (3,)."""
        return self._odometry

    @property
    def lost(self) -> bool:
        """Scans fit worse than they used to, and recovery is under way."""
        return self._recovery() > 0

    @property
    def effective(self) -> float:
        """Effective number of particles, 1 / sum of squared weights."""
        return float(1.0 / np.sum(self.weights**2))

    def _normals(self) -> NDArray[np.float32]:
        """Noise of a step. The second half mirrors the first: half the draws, and no bias."""
        n = len(self.particles)
        half = self._rng.standard_normal(((n + 1) // 2, 3), dtype=np.float32)
        return np.concatenate([half, -half[: n // 2]])

    def _set(self, particles: Array) -> None:
        self.particles = np.ascontiguousarray(particles)
        self.weights = np.full(len(particles), 1.0 / len(particles))

    def _fits(self, pose: Array, p_base: NDArray[np.float32], silent: int) -> bool:
        """Whether a scan at rest fits no worse than usual: a carried vehicle's does not."""
        fit = self.likelihood.log_likelihood(pose[None], p_base, silent)
        self.quality = float(self._explained(fit)[0])
        return self.quality >= (1 - self.settings.slack) * self._slow

    def _explained(self, fit: Array) -> Array:
        """Share of a scan's beams that the map explains at poses of mean log-density `fit` (n,).

        Linear in the number of beams that end off the map, where the density itself would fall to
        half with one beam in ten.
        """
        return np.clip((fit - self._nowhere) / self._on_map, 0.0, 1.0)

    def _weigh(self, p_base: NDArray[np.float32], silent: int) -> None:
        s = self.settings
        fit = self.likelihood.log_likelihood(self.particles, p_base, silent)
        weights = self.weights * np.exp(
            self.likelihood.evidence(len(p_base) + silent) * (fit - np.max(fit))
        )
        self.weights = weights / np.sum(weights)
        # Weighed by the scan, so that particles of recovery that found nothing do not count.
        quality = self.quality = float(self.weights @ self._explained(fit))
        # What a good fit is shows at once and is forgotten slowly: a long mean learnt on the way
        # would call the first wrong place good enough.
        self._slow = max(quality, self._slow + s.slow * (quality - self._slow))
        settled = self._judged or quality < self._fast
        self._fast = self._fast + s.fast * (quality - self._fast) if settled else quality
        self._judged = True

    def _recovery(self) -> float:
        """Share of particles to be drawn where the scan fits."""
        share = 1.0 - self._fast / self._slow
        return 0.0 if share < self.settings.slack else min(share, self.settings.most_recovery)

    def _redraw(self, p_base: NDArray[np.float32], silent: int) -> None:
        recovery = self._recovery()
        if recovery == 0 and self.effective > self.settings.redraw_below * len(self.weights):
            return
        kld = self.settings.kld
        kept = np.take(
            self.particles, draw(self.particles, self.weights, kld, self._rng.random()), axis=0
        )
        self._set(self._mixed(len(kept), recovery, p_base, silent) if recovery else kept)

    def _mixed(self, n: int, recovery: float, p_base: NDArray[np.float32], silent: int) -> Array:
        """The cloud with a share of it drawn anew, as many in all as the places they fill ask for.

        Shape (m, 3), m at least n.
        """
        kld = self.settings.kld
        while True:
            found = int(recovery * n)
            old = low_variance(self.weights, n - found, self._rng.random())
            fresh = self._search.fitting(p_base, silent, found, self._rng)
            cloud = np.concatenate([np.take(self.particles, old, axis=0), fresh])
            wanted = kld.count(count_bins(cloud, kld.bin_size))
            if wanted <= n:
                return cloud
            # More of them fill more places: half again beyond what is wanted ends the search soon.
            n = min(max(wanted, n + n // 2), kld.most)

    def _estimate(self) -> None:
        inside = heaviest(self.particles, self.weights)
        self.dominance = float(self.weights @ inside)  # weight of the cluster that is the estimate
        self.pose, self.covariance = mean_and_covariance(self.particles, self.weights * inside)


def _planar(pose: Array | None) -> bool:
    return pose is None or (pose.shape == (3,) and bool(np.all(np.isfinite(pose))))

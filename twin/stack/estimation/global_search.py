"""Poses all over the map that fit a scan: where the vehicle may have been carried.

Uniform particles hardly ever fall within the few centimetres and degrees in which a scan fits, so
they are annealed: scored with a blurred likelihood, resampled, shaken, and scored with a sharper
one (Deutscher & Reid 2005).
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array, wrap_angle
from twin.stack.estimation.beam_model import BeamModel, ScanLikelihood
from twin.stack.estimation.kld import low_variance
from twin.stack.estimation.likelihood_field import LikelihoodField

SIGMAS = (0.80, 0.40, 0.20, 0.10)  # m, of a beam, level by level; not tuned
INDEPENDENT = 8.0  # beams: flat enough to keep places that look alike
SHAKE = 0.4  # of the level's sigma, in x and y
SHAKE_TURN = 0.2  # rad per m of the level's sigma: the same shift on a wall some metres away


class GlobalSearch:
    """Search over the free cells of a map.

    Args:
        field: distances of the map.
        free: cells in which the vehicle's centre may be. Shape (h, w).
        model: of the beams; its sigma is replaced level by level.
        range_max: of the lidar, m.
        candidates: poses tried at each level.
    """

    def __init__(
        self,
        field: LikelihoodField,
        free: NDArray[np.bool_],
        model: BeamModel,
        range_max: float,
        candidates: int = 5000,
    ):
        self._field, self._candidates = field, candidates
        self._cells = np.argwhere(free)
        self._levels = [
            ScanLikelihood(field, replace(model, sigma=s, finer=1), range_max) for s in SIGMAS
        ]

    def uniform(self, count: int, rng: np.random.Generator) -> Array:
        """Poses spread evenly over the free cells, with any yaw. Shape (count, 3)."""
        cells = self._cells[rng.integers(0, len(self._cells), count)]
        xy = self._field.origin + (cells[:, ::-1] + rng.random((count, 2))) * self._field.resolution
        return np.column_stack([xy, rng.uniform(-np.pi, np.pi, count)])

    def fitting(
        self, p_base: NDArray[np.float32], silent: int, count: int, rng: np.random.Generator
    ) -> Array:
        """Poses drawn where a scan fits, p_base and silent as of `ScanLikelihood.choose`.

        Shape (count, 3).
        """
        poses = self.uniform(self._candidates, rng)
        for level, sigma in zip(self._levels, SIGMAS, strict=True):
            fit = level.log_likelihood(poses, p_base, silent)
            weights = np.exp(INDEPENDENT * (fit - np.max(fit)))
            last = sigma == SIGMAS[-1]
            drawn = low_variance(weights, count if last else self._candidates, rng.random())
            shake = sigma * np.array([SHAKE, SHAKE, SHAKE_TURN])
            poses = poses[drawn] + rng.normal(0, 1, (len(drawn), 3)) * shake
        poses[:, 2] = wrap_angle(poses[:, 2])
        return poses

"""How well a scan fits a map seen from many poses: likelihood-field beams.

Xu et al., Eqs. 19-22 (Thrun et al. 2005, section 6.4): beams are independent (19, 20); the density
of one is a normal of the distance from its end point to the nearest obstacle (21), mixed with a
uniform one and a point mass at the largest range (22). All of (21) and (22) that depends on the
pose is a function of the cell the end point falls into, so its logarithm stands in a table.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.geometry import Array
from twin.messages import LidarScan
from twin.stack.estimation.likelihood_field import LikelihoodField
from twin.stack.estimation.scans import beam_angles


@dataclass(frozen=True)
class BeamModel:
    """Shares and widths of Xu et al., Eq. 22.

    Checked on the plant, seeds 0-4: the map explains 0.99 of the beams, and the filter's errors are
    0.5 to 0.8 of what it says of itself.

    Attributes:
        z_hit, z_rand, z_max: share of beams that end on the map, anywhere, at the largest range;
            they add up to one.
        sigma: of a beam that ends on the map, m: range noise, map and its cells.
        beams: taken from a scan, evenly.
        independent: number of beams that carry independent news. Neighbours see the same surface
            with the same error of the map, and counting them all makes the filter too sure.
        finer: subdivisions of a map's cell in the table, interpolated.
    """

    z_hit: float = 0.85
    z_rand: float = 0.10
    z_max: float = 0.05
    sigma: float = 0.05
    beams: int = 100
    independent: float = 30.0
    finer: int = 2

    def __post_init__(self):
        shares = (self.z_hit, self.z_rand, self.z_max)
        if min(shares) < 0 or abs(sum(shares) - 1) > 1e-9 or self.z_hit == 0 or self.z_rand == 0:
            raise ValueError(
                f"beam model: shares {shares} must add up to 1, z_hit and z_rand positive"
            )
        if self.sigma <= 0 or self.beams < 1 or self.independent <= 0 or self.finer < 1:
            raise ValueError(f"beam model: {self} is out of range")


def beam_density(distance, model: BeamModel, range_max: float):
    """Density of a returned beam whose end lies `distance` from the map, 1/m (Xu et al., Eq. 22).

    Any shape in and out.
    """
    normal = np.exp(-0.5 * np.square(np.asarray(distance) / model.sigma))
    return model.z_hit * normal / (np.sqrt(2 * np.pi) * model.sigma) + model.z_rand / range_max


class ScanLikelihood:
    """Log-likelihood of scans on one map.

    Args:
        field: distances of the map.
        model: of the beams.
        range_max: of the lidar, m.
    """

    def __init__(self, field: LikelihoodField, model: BeamModel, range_max: float):
        self.model, self.range_max = model, float(range_max)
        k = model.finer
        h, w = field.distances.shape
        distances = field.distances
        if k > 1:
            distances = cv2.resize(distances, (k * w, k * h), interpolation=cv2.INTER_LINEAR)
        table = np.log(beam_density(distances, model, range_max))
        # A border of one cell is what every point off the map reads.
        outside = float(np.log(beam_density(field.max_distance, model, range_max)))
        self._table = np.pad(table, 1, constant_values=outside).astype(np.float32)
        self._scale = k / field.resolution
        self._origin = field.origin - 1.0 / self._scale  # corner of the border
        self._at_most = float(np.log(model.z_max)) if model.z_max > 0 else 0.0

    def choose(self, scan: LidarScan, T_base_lidar: Array) -> tuple[NDArray[np.float32], int]:
        """Beams of a scan that are weighed.

        Returns:
            End points in base of the beams that returned, (k, 2) m, and how many others read the
            largest range or nothing. Broken beams (NaN, negative) are left out of both.
        """
        ranges = np.asarray(scan.ranges, dtype=float)
        with np.errstate(invalid="ignore"):
            valid = np.nonzero(ranges > 0)[0]
        n = min(self.model.beams, len(valid))
        if n == 0:
            return np.zeros((0, 2), dtype=np.float32), 0
        chosen = valid[((np.arange(n) + 0.5) * len(valid) / n).astype(int)]
        r, a = ranges[chosen], beam_angles(scan)[chosen]
        back = r < min(scan.range_max, self.range_max)
        p_lidar = np.stack([r * np.cos(a), r * np.sin(a)])[:, back]
        p_base = T_base_lidar[:2, :2] @ p_lidar + T_base_lidar[:2, 3, None]
        return np.ascontiguousarray(p_base.T, dtype=np.float32), int(n - np.sum(back))

    def log_likelihood(self, poses: Array, p_base: NDArray[np.float32], silent: int = 0) -> Array:
        """Mean log-density of a beam for each pose, that is (19) to the power 1 / beams.

        Args:
            poses: base in world. Shape (n, 3).
            p_base: end points of beams in base. Shape (k, 2).
            silent: beams at the largest range: the same factor z_max for every pose.

        Returns:
            Shape (n,); 0 without beams. Multiply by `evidence` to weigh particles.
        """
        beams = len(p_base) + silent
        if beams == 0:
            return np.zeros(len(poses))
        scaled = np.ascontiguousarray(p_base.T * np.float32(self._scale), dtype=np.float32)
        x, y = ((poses[:, :2] - self._origin) * self._scale).T.astype(np.float32)
        yaw = poses[:, 2].astype(np.float32)
        total = _sum_beams(x, y, np.cos(yaw), np.sin(yaw), scaled[0], scaled[1], self._table)
        return (total + silent * self._at_most) / beams

    def evidence(self, beams: int) -> float:
        """Number of independent beams that the mean log-density of so many stands for."""
        return min(float(beams), self.model.independent)


@njit(cache=True, fastmath=True, error_model="numpy")
def _sum_beams(x, y, c, s, xs, ys, table):
    """Sums of the table over beams, all in cells. Free of branches: many beams at a time."""
    total = np.empty(len(x), dtype=np.float64)
    h, w = table.shape
    flat = table.reshape(-1)
    right, top, zero = np.float32(w - 1), np.float32(h - 1), np.float32(0.0)
    width = np.int32(w)
    for i in range(len(x)):
        log_density = zero
        for j in range(np.uint32(len(xs))):
            column = min(max(x[i] + c[i] * xs[j] - s[i] * ys[j], zero), right)
            row = min(max(y[i] + s[i] * xs[j] + c[i] * ys[j], zero), top)
            log_density += flat[np.uint32(np.int32(row) * width + np.int32(column))]
        total[i] = log_density
    return total

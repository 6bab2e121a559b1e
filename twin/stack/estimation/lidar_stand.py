"""How the lidar hangs: its height and its tilt, from sloping boards that the depth camera sees too.

Upright walls look the same to a lidar that is a little higher, lower or tilted; a board that leans
does not. Its plane comes from the camera, whose pose against a level frame at the lidar is known
from walls and floor by then, and each end point of the scan on it must lie in it:
n . (x, y, dz + roll y - pitch x) = d, for small angles.
"""

from dataclasses import dataclass, field

import numpy as np

from twin.geometry import Array, rot_x, rot_y, transform

# m, rad, rad: of height, roll and pitch before anything was seen, 1 sigma; a bracket is bolted on
# better, so that this hardly counts where boards are seen from near and far
PRIOR = np.array([0.01, 0.01, 0.01])
BEAM_NOISE = 0.010  # m, 1 sigma: data sheet
CAMERA_NOISE = 0.002  # m, 1 sigma, of a plane by what is left wrong in the camera's pose
ROBUST, ROUNDS = 2.5, 10  # sigmas from which a board counts linearly


@dataclass(frozen=True)
class BoardObservation:
    """A sloping plane of the camera, n . p = offset, and the end points of the scan on it.

    Both in a level frame at the lidar's drawn height.
    """

    normal: Array  # (3,) unit
    offset: float  # m
    beams: Array  # (k, 2), m
    sigma: float = 0.001  # m, of the offset by the noise of depth


@dataclass(frozen=True)
class LidarStand:
    """Height over the drawn one, m, roll about x and pitch about y, rad."""

    values: tuple[float, float, float] = (0.0, 0.0, 0.0)
    covariance: Array = field(default_factory=lambda: np.diag(PRIOR**2))  # (3, 3)
    boards: int = 0  # observations

    @property
    def T_level_lidar(self) -> Array:
        """Of the lidar as it hangs in a level frame at its drawn height. Shape (4, 4)."""
        height, roll, pitch = self.values
        return transform(rot_y(pitch) @ rot_x(roll), (0.0, 0.0, height))


def find_stand(boards: list[BoardObservation]) -> LidarStand:
    """Least squares over height and tilt, with Huber weights.

    Args:
        boards: of all pairs.

    Returns:
        What is known; the prior where no board was seen.
    """
    J, r = np.zeros((len(boards), 3)), np.zeros(len(boards))
    for i, board in enumerate(boards):
        (nx, ny, nz), (x, y) = board.normal, board.beams.mean(axis=0)
        level = float(np.hypot(nx, ny))  # share of a beam's noise across the plane, at most
        sigma = np.hypot(
            board.sigma, np.hypot(CAMERA_NOISE, level * BEAM_NOISE / len(board.beams) ** 0.5)
        )
        J[i] = nz / sigma, nz * y / sigma, -nz * x / sigma
        r[i] = (board.offset - nx * x - ny * y) / sigma
    found, covariance = np.zeros(3), np.diag(PRIOR**2)
    for _ in range(ROUNDS):
        weight = np.minimum(1.0, ROBUST / np.maximum(np.abs(r - J @ found), 1e-12))
        covariance = np.linalg.inv((J.T * weight) @ J + np.diag(PRIOR**-2))
        found = covariance @ ((J.T * weight) @ r)
    up, roll, pitch = found.tolist()
    return LidarStand((up, roll, pitch), np.asarray(covariance, float), len(boards))

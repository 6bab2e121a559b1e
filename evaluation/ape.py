"""Absolute pose error (APE) of an estimated trajectory. Unaligned: the world frame is known.

Agrees with `evo_ape tum truth.tum estimate.tum` where both are sampled at the same stamps.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evaluation.run import Trajectory
from twin.geometry import wrap_angle


@dataclass(frozen=True)
class PoseErrors:
    """Errors of an estimate at the truth's stamps.

    Attributes:
        stamps: Shape (n,), s.
        translation: distance between estimated and true position. Shape (n,), m.
        yaw: estimated less true heading, in (-pi, pi]. Shape (n,), rad.
    """

    stamps: NDArray[np.float64]
    translation: NDArray[np.float64]
    yaw: NDArray[np.float64]

    def where(self, mask) -> "PoseErrors":
        """Only some of the stamps, such as those at which the vehicle moves. Mask of shape (n,)."""
        return PoseErrors(self.stamps[mask], self.translation[mask], self.yaw[mask])

    @property
    def rmse(self) -> float:
        """Root of the mean square distance, m; NaN without a sample."""
        return _rms(self.translation)

    @property
    def maximum(self) -> float:
        """Greatest distance, m; NaN without a sample."""
        return float(self.translation.max()) if len(self.translation) else float("nan")

    @property
    def yaw_rmse_deg(self) -> float:
        """Root of the mean square heading error, degrees; NaN without a sample."""
        return float(np.degrees(_rms(self.yaw)))


def pose_errors(truth: Trajectory, estimate: Trajectory) -> PoseErrors:
    """Errors of `estimate`, interpolated linearly at those stamps of `truth` that it covers.

    Args:
        truth: stamps in rising order and poses in world.
        estimate: the same of the estimate; any rate.
    """
    stamps = np.asarray(truth[0], dtype=float)
    t = np.asarray(estimate[0], dtype=float)
    if len(stamps) == 0 or len(t) == 0:
        empty = np.zeros(0)
        return PoseErrors(empty, empty, empty)
    covered = (stamps >= t[0]) & (stamps <= t[-1])
    stamps = stamps[covered]
    p_true, yaw_true = position(truth[1])[covered], heading(truth[1])[covered]
    p, yaw = position(estimate[1]), np.unwrap(heading(estimate[1]))
    p = np.column_stack([np.interp(stamps, t, p[:, i]) for i in range(3)])
    yaw = np.interp(stamps, t, yaw)
    distance = np.linalg.norm(p - p_true, axis=1)
    return PoseErrors(stamps, distance, wrap_angle(yaw - yaw_true))


def position(poses) -> NDArray[np.float64]:
    """x, y, z of poses (n, 3) or (n, 7); planar poses lie on the floor. Shape (n, 3), m."""
    poses = np.asarray(poses, dtype=float)
    if poses.shape[1] == 7:
        return poses[:, :3]
    return np.column_stack([poses[:, :2], np.zeros(len(poses))])


def heading(poses) -> NDArray[np.float64]:
    """Yaw of poses (n, 3) or (n, 7) with the quaternion as w, x, y, z. Shape (n,), rad."""
    poses = np.asarray(poses, dtype=float)
    if poses.shape[1] == 3:
        return poses[:, 2]
    w, x, y, z = poses[:, 3:].T
    return np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def _rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")

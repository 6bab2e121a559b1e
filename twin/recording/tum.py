"""Trajectories in TUM format: a line a pose, `stamp x y z qx qy qz qw`."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Fixed point, so that the same run gives the same bytes: nanometres are finer than any metric.
_FORMAT = "%.6f %.9f %.9f %.9f %.9f %.9f %.9f %.9f"


def write_tum(path: Path, stamps, poses) -> None:
    """Write poses in world.

    Args:
        path: file to write.
        stamps: Shape (n,), s.
        poses: Shape (n, 3) as x, y, yaw, or (n, 7) as x, y, z, qw, qx, qy, qz.
    """
    stamps, poses = np.asarray(stamps, dtype=float), np.asarray(poses, dtype=float)
    if poses.ndim != 2 or poses.shape[1] not in (3, 7) or len(poses) != len(stamps):
        raise ValueError(f"{path.name}: poses of shape {poses.shape} for {len(stamps)} stamps")
    if poses.shape[1] == 3:
        zero, half = np.zeros(len(poses)), poses[:, 2] / 2
        columns = [poses[:, 0], poses[:, 1], zero, zero, zero, np.sin(half), np.cos(half)]
    else:
        columns = [*poses[:, :3].T, *poses[:, 4:7].T, poses[:, 3]]
    np.savetxt(path, np.column_stack([stamps, *columns]), fmt=_FORMAT)


def read_tum(path: Path) -> tuple[Array, Array]:
    """Stamps, shape (n,), and poses, shape (n, 7) as x, y, z, qw, qx, qy, qz."""
    table = np.loadtxt(path, ndmin=2)
    if table.size == 0:
        return np.zeros(0), np.zeros((0, 7))
    return table[:, 0], table[:, [1, 2, 3, 7, 4, 5, 6]]

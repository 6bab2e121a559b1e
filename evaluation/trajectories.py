"""Paths of a run: true, localised, fused odometry, wheels alone."""

import numpy as np

from evaluation.run import Trajectory
from twin.geometry import Array, quat_wxyz
from twin.loop import Tick

NAMES = ("truth", "estimate", "fused", "odometry")
MOVING = 0.02  # m/s or rad/s of the true velocity: faster than this the vehicle moves


class TrajectoryMonitor:
    """Collects poses at every tick of the stack."""

    def __init__(self):
        self._stamps: list[float] = []
        self._poses: dict[str, list] = {n: [] for n in NAMES}
        self._moving: list[bool] = []

    def observe(self, tick: Tick) -> None:
        self._stamps.append(tick.stamp)
        spatial = tick.state.pose6 is not None
        self._poses["truth"].append(pose7(tick.truth.T_world_base) if spatial else tick.truth.pose)
        self._poses["estimate"].append(tick.state.pose6 if spatial else tick.state.pose)
        self._poses["fused"].append(tick.state.fused_pose)
        self._poses["odometry"].append(tick.state.odometry_pose)
        self._moving.append(bool(np.any(np.abs(tick.truth.velocity) > MOVING)))

    def moving(self):
        """Whether the vehicle truly moved, at each stamp. Shape (n,)."""
        return np.array(self._moving, dtype=bool)

    def trajectories(self) -> dict[str, Trajectory]:
        """Stamps (n,) and poses of each path: (n, 3), or (n, 7) where the estimate is spatial."""
        stamps = np.array(self._stamps)
        return {
            name: (stamps, np.array(poses) if poses else np.zeros((0, 3)))
            for name, poses in self._poses.items()
        }


def pose7(T: Array) -> Array:
    """x, y, z, qw, qx, qy, qz of a transform. Shape (7,)."""
    return np.concatenate([T[:3, 3], quat_wxyz(T[:3, :3])])

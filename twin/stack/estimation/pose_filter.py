"""Kalman filter of the pose in space: carried by dead reckoning, corrected by 6-DoF fixes.

The error is a shift in world axes (m) and a turn in base axes (rad), as in `beacons.refine`. The
floor is level, so dead reckoning moves the pose within the floor; height and tilt only creep.
"""

import numpy as np

from twin.geometry import Array, between2, pose2_to_transform, rot_z, transform
from twin.stack.estimation.beacons.rigid import cross_matrix, exp_rotation, log_rotation

GATE = 27.86  # squared Mahalanobis distance: chi-square, 6 degrees of freedom, 99.99 %
# What is believed of a vehicle on a level floor before the first fix, m and rad; guess.
HEIGHT, TILT = 0.002, 0.003
# Growth while time passes, per root of a second, and on the way, per root of a metre or radian.
# The first keeps the filter from believing that errors common to all fixes average out; not tuned.
# On the way the rollers rock the deck by 0.1 to 0.2 mrad, which single fixes see.
CREEP = np.array([1e-4] * 3 + [0.5e-4] * 3)  # m, rad
PATH = np.array([2.0e-3, 2.0e-3, 1.0e-3, 1.5e-3, 1.5e-3, 1.0e-3])  # m, rad
TURN = np.array([1.5e-3, 1.5e-3, 1.0e-3, 1.5e-3, 1.5e-3, 1.5e-3])


class PoseFilter:
    """The filter.

    Args:
        pose: x, y, yaw in world. Shape (3,).
        covariance: of it. Shape (3, 3).
        odometry: x, y, yaw of the dead reckoning at that time. Shape (3,).
        stamp: of that time, s.
    """

    def __init__(self, pose: Array, covariance: Array, odometry: Array, stamp: float):
        self.T = pose2_to_transform(pose)
        self.P = np.diag([0.0, 0.0, HEIGHT**2, TILT**2, TILT**2, 0.0])
        planar = np.ix_((0, 1, 5), (0, 1, 5))
        self.P[planar] = covariance
        self.common = np.zeros((6, 6))  # of an error that all fixes share, beside P
        self.odometry, self.stamp = np.array(odometry, dtype=float), stamp

    def at(self, odometry: Array) -> Array:
        """`T_world_base` where the dead reckoning says `odometry`. Shape (4, 4)."""
        return np.asarray(self.T @ pose2_to_transform(between2(self.odometry, odometry)))

    @property
    def planar(self) -> tuple[Array, Array]:
        """x, y, yaw in world, (3,), and their covariance, (3, 3). Tilt is too small to matter."""
        pose = np.array([self.T[0, 3], self.T[1, 3], np.arctan2(self.T[1, 0], self.T[0, 0])])
        return pose, (self.P + self.common)[np.ix_((0, 1, 5), (0, 1, 5))]

    def carry(self, odometry: Array, stamp: float, growth: Array) -> None:
        """Bring the state to another pose of the dead reckoning.

        Args:
            odometry: that pose. Shape (3,).
            stamp: of it, s.
            growth: covariance in the dead reckoning's axes by which it grew unsure. Shape (3, 3).
        """
        step = between2(self.odometry, odometry)
        new = self.at(odometry)
        F = np.eye(6)
        F[:3, 3:] = -self.T[:3, :3] @ cross_matrix(np.array([step[0], step[1], 0.0]))
        F[3:, 3:] = rot_z(step[2]).T
        turn = rot_z(np.arctan2(new[1, 0], new[0, 0]) - odometry[2])
        Q = np.zeros((6, 6))
        Q[np.ix_((0, 1, 5), (0, 1, 5))] = turn @ growth @ turn.T  # z of base and world agree
        noise = PATH**2 * float(np.hypot(*step[:2])) + TURN**2 * abs(float(step[2]))
        noise = noise + CREEP**2 * abs(stamp - self.stamp)
        self.P = F @ self.P @ F.T + Q + np.diag(noise)
        self.T, self.odometry, self.stamp = new, np.array(odometry, dtype=float), stamp

    def update(self, T_world_base: Array, covariance: Array) -> bool:
        """Correct by a fix at the state's own pose of the dead reckoning.

        Returns:
            False if it lies outside the gate; the state is then unchanged.
        """
        R = self.T[:3, :3]
        off = np.concatenate(
            [T_world_base[:3, 3] - self.T[:3, 3], log_rotation(R.T @ T_world_base[:3, :3])]
        )
        total = self.P + covariance
        if off @ np.linalg.solve(total, off) > GATE:
            return False
        gain = np.linalg.solve(total, self.P).T
        step, rest = gain @ off, np.eye(6) - gain
        self.T = transform(R @ exp_rotation(step[3:]), self.T[:3, 3] + step[:3])
        self.P = rest @ self.P @ rest.T + gain @ covariance @ gain.T
        return True

"""Where dead reckoning stands in the world: a Kalman filter over its correction by map and tags.

Odometry is smooth and drifts; a pose by scan or tag scatters and does not. The state is the
vehicle's pose in world at a known pose of the odometry, which fixes `world_from_odom`; carried
along with the odometry it loses certainty only by what the odometry is unsure of over that way.
"""

import numpy as np

from twin.geometry import Array, between2, compose2, rot2, wrap_angle

GATE = 16.27  # squared Mahalanobis distance: chi-square, 3 degrees of freedom, 99.9 %
# What a metre and a radian add beside what the odometry says of itself; tuned on the plant.
PATH = np.array([0.003, 0.003, 0.0010])  # m, m, rad per square root of a metre
TURN = np.array([0.002, 0.002, 0.0010])  # likewise of a radian


class MapCorrection:
    """The filter; poses are x, y, yaw.

    Args:
        pose: of the vehicle in world.
        covariance: of it, shape (3, 3).
        odometry: pose of the vehicle in the odometry's frame at that time.
    """

    def __init__(self, pose: Array, covariance: Array, odometry: Array):
        self.reset(pose, covariance, odometry)

    def reset(self, pose: Array, covariance: Array, odometry: Array) -> None:
        """Take over a pose; nothing is kept."""
        self.pose, self.covariance = np.array(pose, dtype=float), np.array(covariance, dtype=float)
        self.odometry = np.array(odometry, dtype=float)

    @property
    def world_from_odom(self) -> Array:
        """Pose of the odometry's frame in world. Shape (3,)."""
        return compose2(self.pose, between2(self.odometry, np.zeros(3)))

    def at(self, odometry: Array) -> Array:
        """Pose in world where the odometry says `odometry`. Shape (3,)."""
        return compose2(self.pose, between2(self.odometry, odometry))

    def carry(self, odometry: Array, growth: Array) -> None:
        """Bring the state to another pose of the odometry.

        Args:
            odometry: the other pose, in the odometry's frame.
            growth: covariance in the odometry's axes by which it grew unsure. Shape (3, 3).
        """
        step = between2(self.odometry, odometry)
        new = self.at(odometry)
        F = transport(new[:2] - self.pose[:2])
        turn = np.eye(3)
        turn[:2, :2] = rot2(new[2] - odometry[2])
        path = float(np.hypot(*step[:2]))
        noise = PATH**2 * path + TURN**2 * abs(step[2])
        self.covariance = F @ self.covariance @ F.T + turn @ growth @ turn.T + np.diag(noise)
        self.pose, self.odometry = new, np.array(odometry, dtype=float)

    def update(self, measured: Array, covariance: Array) -> bool:
        """Correct by a pose in world at the state's own pose of the odometry.

        Returns:
            False if it lies outside the gate; the state is then unchanged.
        """
        off = measured - self.pose
        off[2] = wrap_angle(off[2])
        total = self.covariance + covariance
        if off @ np.linalg.solve(total, off) > GATE:
            return False
        gain = self.covariance @ np.linalg.inv(total)
        rest = np.eye(3) - gain
        self.pose = self.pose + gain @ off
        self.pose[2] = wrap_angle(self.pose[2])
        self.covariance = rest @ self.covariance @ rest.T + gain @ covariance @ gain.T
        return True


def transport(way: Array) -> Array:
    """Derivative of a pose at the end of a way (2,) by the one at its start. Shape (3, 3)."""
    F = np.eye(3)
    F[:2, 2] = -way[1], way[0]
    return F


def growth(before: Array, after: Array, way: Array) -> Array:
    """By how much an odometry's covariance grew over a way (2,) in its axes; never negative.

    What it was before swings round with the way and is no news. Shapes (3, 3).
    """
    F = transport(way)
    values, axes = np.linalg.eigh(after - F @ before @ F.T)
    return (axes * np.maximum(values, 0.0)) @ axes.T

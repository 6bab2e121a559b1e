"""Inertial unit: mean specific force and mean rate over each sampling interval.

The ADIS16470 (Analog Devices, data sheet rev. C) averages its 2 kHz samples down to the output
rate and offers delta velocity and delta angle; so the reading is the exact mean over the interval,
not a sample of it, and roller vibration does not alias. Error model: white noise, a bias drawn at
switch-on, a slow in-run bias (Gauss-Markov) and a scale error of the gyroscope.
"""

import mujoco
import numpy as np

from twin.geometry import Array, rotation_from_quat
from twin.messages import ImuReading
from twin.plant.sensors.mount import Mount

GYRO_NOISE = np.radians(0.008)  # rad/s/sqrt(Hz), one-sided: front page
GYRO_BIAS_START = np.radians(0.2)  # rad/s, 1 sigma: bias repeatability
GYRO_BIAS_STABILITY = np.radians(8.0 / 3600)  # rad/s: in-run bias stability, front page
GYRO_SCALE = 1.0e-3  # relative, 1 sigma: guess
ACCEL_NOISE = 100e-6 * 9.81  # m/s^2/sqrt(Hz), one-sided
ACCEL_BIAS_START = 3.5e-3 * 9.81  # m/s^2, 1 sigma: bias repeatability
ACCEL_BIAS_STABILITY = 13e-6 * 9.81  # m/s^2: in-run bias stability, front page
BIAS_TIME = 100.0  # s, correlation time of the in-run bias: guess


class ImuSensor:
    """IMU at site `agv/imu`, in base axes. The first sample, without an interval, is at rest."""

    period = 0.010
    latency = 0.002  # s: filter and SPI transfer; guess

    def __init__(self, model: mujoco.MjModel, rng: np.random.Generator, noise_scale: float = 1.0):
        self._rng, self._k = rng, noise_scale
        self._mount = Mount(model, "agv/imu")
        start = [GYRO_BIAS_START] * 3 + [ACCEL_BIAS_START] * 3
        self._in_run = np.array([GYRO_BIAS_STABILITY] * 3 + [ACCEL_BIAS_STABILITY] * 3)
        self._bias_start = rng.normal(0, start)
        self._bias = rng.normal(0, self._in_run)
        self._scale = 1 + noise_scale * rng.normal(0, GYRO_SCALE, 3)
        self._last: tuple[float, Array, Array] | None = None

    def sample(self, stamp: float, model, data) -> ImuReading:
        R_world_imu = self._mount.pose(data)[:3, :3]
        velocity = self._mount.velocity(data)
        if self._last is None:
            rate, force = np.zeros(3), -R_world_imu.T @ model.opt.gravity
            interval = self.period
        else:
            before, R_world_before, velocity_before = self._last
            interval = stamp - before
            turn = rotation_vector(R_world_before.T @ R_world_imu)  # delta angle
            rate = turn / interval
            half = rotation_matrix(turn / 2)
            change = (velocity - velocity_before) / interval - model.opt.gravity
            force = (R_world_before @ half).T @ change
        self._last = (stamp, R_world_imu, velocity)

        keep = np.exp(-interval / BIAS_TIME)
        self._bias = keep * self._bias + self._rng.normal(0, self._in_run * np.sqrt(1 - keep**2))
        white = np.array([GYRO_NOISE] * 3 + [ACCEL_NOISE] * 3) / np.sqrt(2 * interval)
        error = self._k * (self._bias_start + self._bias + self._rng.normal(0, white))
        return ImuReading(stamp, force + error[3:], rate * self._scale + error[:3])


def rotation_vector(R: Array) -> Array:
    """Axis times angle of a rotation well below half a turn. Shape (3,)."""
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, R.flatten())
    vector = np.zeros(3)
    mujoco.mju_quat2Vel(vector, quat, 1.0)
    return vector


def rotation_matrix(vector: Array) -> Array:
    """Rotation about a vector by its length. Shape (3, 3)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    quat = np.zeros(4)
    mujoco.mju_axisAngle2Quat(quat, vector / angle, angle)
    return rotation_from_quat(quat)

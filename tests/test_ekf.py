"""The filter against data made by its own model, and against readings gone wrong."""

import numpy as np
import pytest
from scipy.stats import chi2

from twin.geometry import rot2, wrap_angle
from twin.layout import load_layout
from twin.messages import ImuReading, WheelState
from twin.stack.config import Imu, StackConfig
from twin.stack.estimation.ekf import (
    ACCEL_BIAS,
    GYRO_BIAS,
    POSE,
    POSITION,
    RATE,
    SIZE,
    SLIP,
    VELOCITY,
    YAW,
    MotionEkf,
    Noise,
)
from twin.stack.estimation.fusion import FusedOdometry

DT = 0.01  # s
LAYOUT = load_layout()
CONFIG = StackConfig(site=LAYOUT.site, options=LAYOUT.options)
SIGMA = CONFIG.odometry_start_sigma


def profile(t: float) -> np.ndarray:
    """Drive used for the tests: acceleration along x and y (m/s^2) and rate of turn (rad/s)."""
    forward = 0.8 if t < 1 else (-0.8 if 3 < t < 4 else 0.0)
    strafe = 0.5 if 4 < t < 5 else (-0.5 if 6 < t < 7 else 0.0)
    return np.array([forward, strafe, 0.8 * np.sin(t) ** 2])


def simulate(rng: np.random.Generator, duration: float):
    """Truth and readings drawn from the filter's own model.

    Yields: true state (12,), mean specific force (2,), mean rate, wheel velocity (3,).
    """
    imu, noise = Imu(), Noise()
    ekf = MotionEkf(imu, np.zeros(3), SIGMA, noise)  # lends its covariance and its law of slip
    x = rng.multivariate_normal(np.zeros(SIZE), ekf.P)
    keep = np.exp(-DT / noise.slip_time)
    for k in range(round(duration / DT)):
        accel, rate = profile(k * DT)[:2], profile(k * DT)[2]
        spin = np.array([[0.0, rate], [-rate, 0.0]])
        change = accel + spin @ x[VELOCITY]
        step = x[VELOCITY] * DT + 0.5 * change * DT**2
        x[POSITION] += rot2(x[YAW] + 0.5 * rate * DT) @ step
        x[YAW] += rate * DT + rng.normal(0, imu.gyro_scale * np.sqrt(np.pi / 2 * abs(rate) * DT))
        x[VELOCITY] += change * DT
        x[RATE] = rate
        x[GYRO_BIAS] += rng.normal(0, imu.gyro_bias_stability * np.sqrt(2 * DT / imu.bias_time))
        x[ACCEL_BIAS] += rng.normal(
            0, imu.accel_bias_stability * np.sqrt(2 * DT / imu.bias_time), 2
        )
        x[SLIP] = keep * x[SLIP] + np.sqrt(1 - keep**2) * rng.normal(size=3)
        force = accel + x[ACCEL_BIAS]
        force = force + rng.normal(
            0, np.hypot(imu.accel_noise, noise.vibration) / np.sqrt(2 * DT), 2
        )
        gyro = rate + x[GYRO_BIAS] + rng.normal(0, imu.gyro_noise / np.sqrt(2 * DT))
        wheels = ekf.wheels_of(x) - 0.5 * DT * np.array([*change, 0.0])
        yield x.copy(), force, gyro, wheels + rng.normal(0, noise.wheel)


def test_error_lies_in_the_95_per_cent_band_of_the_covariance():
    """Mean normalised error squared over runs, all twelve states and the pose alone."""
    runs, nees, nees_pose = 40, [], []
    for seed in range(runs):
        ekf = MotionEkf(Imu(), np.zeros(3), SIGMA)
        for x, force, gyro, wheels in simulate(np.random.default_rng(seed), 8.0):  # noqa: B007
            ekf.advance(DT, force, gyro)
            ekf.update_wheels(wheels, DT)
        error = x - ekf.x
        error[YAW] = wrap_angle(error[YAW])
        nees.append(error @ np.linalg.solve(ekf.P, error))
        e, P = error[POSE], ekf.P[POSE, POSE]
        nees_pose.append(e @ np.linalg.solve(P, e))
    for values, dof in ((nees, SIZE), (nees_pose, 3)):
        low, high = chi2.ppf([0.025, 0.975], runs * dof) / runs
        assert low < np.mean(values) < high


@pytest.mark.parametrize("blind", [False, True])
def test_jacobian_is_the_derivative_of_the_prediction(blind):
    rng = np.random.default_rng(3)
    x0 = rng.normal(0, 0.5, SIZE)
    reading = (None, None) if blind else (np.array([0.7, -0.4]), 0.9)

    def predict(x):
        ekf = MotionEkf(Imu(), np.zeros(3), SIGMA)
        ekf.x = x.copy()
        ekf.advance(DT, *reading)
        return ekf

    numeric = np.empty((SIZE, SIZE))
    for j in range(SIZE):
        h = np.zeros(SIZE)
        h[j] = 1e-6
        numeric[:, j] = (predict(x0 + h).x - predict(x0 - h).x) / 2e-6
    np.testing.assert_allclose(predict(x0).F, numeric, atol=1e-7)


def test_wheel_jacobian_is_the_derivative_of_what_the_wheels_report():
    x0 = np.random.default_rng(4).normal(0, 0.5, SIZE)
    ekf = MotionEkf(Imu(), np.zeros(3), SIGMA)
    numeric = np.empty((3, SIZE))
    for j in range(SIZE):
        h = np.zeros(SIZE)
        h[j] = 1e-6
        numeric[:, j] = (ekf.wheels_of(x0 + h) - ekf.wheels_of(x0 - h)) / 2e-6
    np.testing.assert_allclose(ekf.wheel_jacobian(x0), numeric, atol=1e-7)


def test_gate_leaves_the_state_unchanged():
    ekf = MotionEkf(Imu(), np.zeros(3), SIGMA)
    ekf.advance(DT, np.zeros(2), 0.0)
    x, P = ekf.x.copy(), ekf.P.copy()
    assert not ekf.update_wheels(np.array([3.0, 0.0, 0.0]), DT)
    np.testing.assert_array_equal(ekf.x, x)
    np.testing.assert_array_equal(ekf.P, P)


def standstill(fused: FusedOdometry, seconds: float, bias: float, rng=None) -> None:
    start = 0.0 if fused.stamp is None else fused.stamp
    for k in range(1, round(seconds / DT) + 1):
        t = start + k * DT
        noise = 0.0 if rng is None else rng.normal(0, 1e-3)
        fused.step([WheelState(t, np.zeros(4, dtype=np.int64), np.zeros(4), np.zeros(3))])
        fused.step([ImuReading(t, np.array([0.02, -0.01, 9.81]), np.array([0, 0, bias + noise]))])


def test_standing_teaches_the_gyro_bias():
    """Expected: after 4 s of standing the bias is known to 0.1 mrad/s and `ready` says so."""
    fused = FusedOdometry(CONFIG, np.zeros(3))
    assert not fused.ready
    standstill(fused, 4.0, 4e-3, np.random.default_rng(0))
    assert fused.standing and fused.ready
    assert fused.ekf.x[GYRO_BIAS] == pytest.approx(4e-3, abs=3e-4)
    np.testing.assert_allclose(fused.ekf.x[ACCEL_BIAS], [0.02, -0.01], atol=5e-3)


def broken_readings(now: float):
    zeros, nan = np.zeros(4), np.full(3, np.nan)
    return [
        ImuReading(now, nan, np.zeros(3)),
        ImuReading(now, np.zeros(3), nan),
        ImuReading(np.nan, np.zeros(3), np.zeros(3)),
        ImuReading(now, np.array([80.0, 0, 9.81]), np.zeros(3)),
        ImuReading(now - 0.5, np.array([1.0, 0, 9.81]), np.ones(3)),  # late
        WheelState(now - 0.5, zeros.astype(np.int64) + 900, zeros, np.zeros(3)),  # late
        WheelState(np.nan, zeros.astype(np.int64), zeros, np.zeros(3)),
    ]


def test_broken_and_late_readings_leave_the_state_unchanged():
    """Expected: each is counted, none moves the state."""
    fused = FusedOdometry(CONFIG, np.zeros(3))
    standstill(fused, 1.0, 0.0)
    x, P, before = fused.ekf.x.copy(), fused.ekf.P.copy(), fused.ignored
    bad = broken_readings(fused.stamp + DT)
    for reading in bad:
        fused.step([reading])
    np.testing.assert_array_equal(fused.ekf.x, x)
    np.testing.assert_array_equal(fused.ekf.P, P)
    assert fused.ignored == before + len(bad)


def test_order_within_a_tick_does_not_matter():
    def run(flip: bool) -> np.ndarray:
        fused = FusedOdometry(CONFIG, np.zeros(3))
        for k in range(100):
            t = k * DT
            readings = [
                WheelState(t, np.full(4, 40 * k, dtype=np.int64), np.zeros(4), np.zeros(3)),
                ImuReading(t, np.array([0.1, 0.0, 9.81]), np.array([0, 0, 0.1])),
            ]
            fused.step(readings[::-1] if flip else readings)
        return fused.ekf.x

    np.testing.assert_array_equal(run(False), run(True))


def test_wheels_go_on_alone_when_the_inertial_unit_falls_silent():
    """Expected: the pose follows the counts, the uncertainty grows."""
    fused = FusedOdometry(CONFIG, np.zeros(3))
    standstill(fused, 1.0, 0.0)
    sigma, start = fused.covariance[0, 0], fused.stamp
    per_metre = 40000 / (2 * np.pi * CONFIG.wheels.radius)
    for k in range(1, 301):
        travelled = 0.5 * (k * DT) ** 2 * 0.3 if k < 100 else 0.15 + 0.3 * (k * DT - 1.0)
        ticks = np.full(4, round(travelled * per_metre), dtype=np.int64)
        fused.step([WheelState(start + k * DT, ticks, np.zeros(4), np.zeros(3))])
    np.testing.assert_allclose(fused.pose(start + 3.0), [0.75, 0, 0], atol=0.02)
    assert fused.covariance[0, 0] > sigma

"""Inertial unit: exact without noise, as the data sheet says with it."""

import mujoco
import numpy as np
import pytest

from twin.plant.sensors import imu
from twin.plant.sensors.imu import ImuSensor
from twin.stack.config import Imu

MJCF = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="agv/base" pos="0 0 1">
      <freejoint/>
      <geom size="0.1" mass="1"/>
      <site name="agv/imu" pos="0.3 0.1 0"/>
    </body>
  </worldbody>
</mujoco>
"""


def sampled(velocity, rate, seconds, noise_scale, gravity=True, seed=0):
    """Readings of a free body thrown with a velocity in world and a rate in its own axes."""
    model = mujoco.MjModel.from_xml_string(MJCF)
    if not gravity:
        model.opt.gravity[:] = 0
    data = mujoco.MjData(model)
    data.qvel[:3], data.qvel[3:] = velocity, rate
    sensor = ImuSensor(model, np.random.default_rng(seed), noise_scale)
    readings = [sensor.sample(0.0, model, data)]
    for k in range(1, round(seconds / 0.002) + 1):
        mujoco.mj_step(model, data)
        if k % 5 == 0:
            readings.append(sensor.sample(data.time, model, data))
    return readings


def test_free_fall_is_weightless():
    for reading in sampled((1, 2, 3), (0, 0, 0), 0.1, 0.0)[1:]:
        np.testing.assert_allclose(reading.accel, 0, atol=1e-9)
        np.testing.assert_allclose(reading.gyro, 0, atol=1e-9)


def test_first_reading_is_at_rest_under_gravity():
    np.testing.assert_allclose(sampled((0, 0, 0), (0, 0, 0), 0, 0.0)[0].accel, (0, 0, 9.81))


def test_spin_gives_rate_and_the_centripetal_force_of_the_lever():
    """Spinning at 2 rad/s, 0.3 and 0.1 m off the axis: -w^2 r in the body's own axes."""
    readings = sampled((0, 0, 0), (0, 0, 2.0), 0.2, 0.0, gravity=False)
    for reading in readings[2:]:
        np.testing.assert_allclose(reading.gyro[2], 2.0, rtol=2e-3)
        np.testing.assert_allclose(reading.accel, (-1.2, -0.4, 0), atol=0.01)


def test_mean_force_adds_up_to_the_change_of_velocity():
    """No vibration between samples is lost or folded down: the reading is the interval's mean."""
    model = mujoco.MjModel.from_xml_string(MJCF)
    data = mujoco.MjData(model)
    sensor = ImuSensor(model, np.random.default_rng(0), 0.0)
    rng, total = np.random.default_rng(1), np.zeros(3)
    sensor.sample(0.0, model, data)
    for k in range(1, 501):
        data.xfrc_applied[1, :3] = rng.normal(0, 30, 3)  # shakes at every step
        data.xfrc_applied[1, 2] += 9.81
        mujoco.mj_step(model, data)
        data.qvel[3:] = 0  # and does not turn
        if k % 5 == 0:
            total += 0.01 * (sensor.sample(data.time, model, data).accel + model.opt.gravity)
    np.testing.assert_allclose(total, data.qvel[:3], atol=1e-9)


def test_noise_at_rest_is_that_of_the_data_sheet():
    readings = sampled((0, 0, 0), (0, 0, 0), 20.0, 1.0)[1:]
    for values, density in (
        (np.array([r.gyro for r in readings]), imu.GYRO_NOISE),
        (np.array([r.accel for r in readings]), imu.ACCEL_NOISE),
    ):
        np.testing.assert_allclose(values.std(0), density / np.sqrt(0.02), rtol=0.08)
    starts = [sampled((0, 0, 0), (0, 0, 0), 0.0, 1.0, seed=s)[0].gyro for s in range(200)]
    assert np.std(starts) == pytest.approx(imu.GYRO_BIAS_START, rel=0.15)


def test_same_seed_same_bits_and_no_noise_at_scale_zero():
    a, b = (sampled((0, 0, 0), (0, 0, 0), 0.1, 1.0, seed=5) for _ in range(2))
    assert all(np.array_equal(x.gyro, y.gyro) for x, y in zip(a, b, strict=True))
    quiet = sampled((0, 0, 0), (0, 0, 0), 0.1, 0.0)
    assert all(np.array_equal(r.gyro, np.zeros(3)) for r in quiet)


def test_the_drawing_has_the_sheet_that_the_unit_was_built_by():
    drawn = Imu()
    for value, built in (
        (drawn.gyro_noise, imu.GYRO_NOISE),
        (drawn.gyro_bias_start, imu.GYRO_BIAS_START),
        (drawn.gyro_bias_stability, imu.GYRO_BIAS_STABILITY),
        (drawn.gyro_scale, imu.GYRO_SCALE),
        (drawn.accel_noise, imu.ACCEL_NOISE),
        (drawn.accel_bias_start, imu.ACCEL_BIAS_START),
        (drawn.accel_bias_stability, imu.ACCEL_BIAS_STABILITY),
    ):
        assert value == pytest.approx(built, rel=0.02)

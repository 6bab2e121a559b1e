"""Control unit: counters, wheel speed and the wheel-speed loop."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from twin.messages import BodyVelocity
from twin.stack.config import Wheels
from twin.stack.control_unit import PERIOD, ControlUnit
from twin.stack.control_unit.counts import CountDecoder
from twin.stack.control_unit.wheel_pid import MotorDrawing, WheelPid

WHEELS = Wheels()
COUNTS = WHEELS.counts_per_turn * WHEELS.gear_ratio


@given(
    st.integers(0, 65535),
    st.lists(st.integers(-32768, 32767), min_size=1, max_size=30),
)
def test_counters_are_unwrapped(start, increments):
    """Expected result: the sum of the increments, however often the 16 bits wrap."""
    decoder = CountDecoder(COUNTS, PERIOD)
    count = start
    decoder.update(np.full(4, count % 65536, dtype=np.uint16))
    for step in increments:
        count += step
        decoder.update(np.full(4, count % 65536, dtype=np.uint16))
    np.testing.assert_array_equal(decoder.total, sum(increments))


def test_speed_from_counts_is_exact_to_one_count_in_the_window():
    decoder = CountDecoder(COUNTS, PERIOD)
    wanted = np.array([0.3, -0.3, 12.5, -12.5])  # rad/s
    for k in range(50):
        ticks = np.floor(wanted * k * PERIOD * COUNTS / (2 * np.pi)).astype(np.int64)
        speed = decoder.update(ticks.astype(np.uint16))
    quantum = 2 * np.pi / COUNTS / (5 * PERIOD)
    np.testing.assert_allclose(speed, wanted, atol=quantum)


def motor_response(pid, reference, seconds, supply=24.0, inertia=0.09, stuck=False):
    """A wheel drive as a first-order plant: back EMF, resistance, inertia, dry friction."""
    motor = MotorDrawing()
    k = motor.torque_constant * WHEELS.gear_ratio
    speed, angle, speeds, duties = np.zeros(4), np.zeros(4), [], []
    for _ in range(round(seconds / PERIOD)):
        duty = pid.step(np.full(4, reference), speed, angle)
        torque = k * (supply * duty - k * speed) / motor.resistance
        torque -= motor.friction * np.tanh(speed / 0.05)
        speed = np.zeros(4) if stuck else speed + PERIOD * torque / inertia
        angle = angle + PERIOD * speed
        speeds.append(speed)
        duties.append(duty)
    return np.array(speeds), np.array(duties)


def test_wheel_reaches_its_speed():
    speeds, _ = motor_response(WheelPid(WHEELS.gear_ratio, PERIOD), 12.5, 3.0)
    np.testing.assert_allclose(speeds[-1], 12.5, rtol=0.002)
    assert speeds.max() < 12.5 * 1.05


def test_integral_does_not_wind_up():
    """A wheel is held fast for 3 s with the drive saturated, then let go.

    Expected result: the duty never leaves [-1, 1], the integrator stands still while saturated, and
    the freed wheel does not overshoot more than one that was never held.
    """
    pid = WheelPid(WHEELS.gear_ratio, PERIOD)
    _, duties = motor_response(pid, 12.5, 3.0, stuck=True)
    assert np.abs(duties).max() == 1.0
    assert np.abs(pid.integral).max() < 24.0
    freed, _ = motor_response(pid, 12.5, 3.0)
    fresh, _ = motor_response(WheelPid(WHEELS.gear_ratio, PERIOD), 12.5, 3.0)
    assert freed.max() < fresh.max() + 0.02 * 12.5
    np.testing.assert_allclose(freed[-1], 12.5, rtol=0.002)


def test_unit_reports_time_counts_and_body_velocity():
    unit = ControlUnit(WHEELS)
    per_step = 40  # counts forward on every wheel
    for k in range(20):
        ticks = np.full(4, (65500 + per_step * k) % 65536, dtype=np.uint16)
        pwm, state = unit.step(ticks, BodyVelocity())
    assert state.stamp == 19 * PERIOD
    np.testing.assert_array_equal(state.ticks, 19 * per_step)
    speed = per_step / PERIOD * 2 * np.pi / COUNTS
    np.testing.assert_allclose(state.body_velocity, [speed * WHEELS.radius, 0, 0], atol=1e-12)
    assert (pwm < 0).all()  # it brakes a vehicle that ought to stand


def test_a_parked_wheel_returns_to_where_it_was_taken_hold_of():
    """Expected result: pushed with 2 N m for half a second it yields some 6 mrad and comes back."""
    motor, pid = MotorDrawing(), WheelPid(WHEELS.gear_ratio, PERIOD)
    k = motor.torque_constant * WHEELS.gear_ratio
    angle, speed, angles = np.full(4, 0.3), np.zeros(4), []
    for step in range(1000):
        duty = pid.step(np.zeros(4), speed, angle)
        push = 2.0 if step < 250 else 0.0
        torque = k * (motor.supply * duty - k * speed) / motor.resistance + push
        speed = speed + PERIOD * torque / 0.09
        angle = angle + PERIOD * speed
        angles.append(angle)
    moved = np.abs(np.array(angles) - 0.3)
    assert 0.003 < moved.max() < 0.008
    assert moved[-1].max() < 1e-4

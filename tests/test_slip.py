"""Slip of the wheels: how it shows, and what the fused odometry makes of it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twin.layout import load_layout
from twin.messages import ImuReading, WheelState
from twin.stack.config import Imu, StackConfig, Wheels
from twin.stack.control import mecanum
from twin.stack.estimation.ekf import SLIP, TWIST, MotionEkf
from twin.stack.estimation.fusion import FusedOdometry
from twin.stack.estimation.rewind import Rewind
from twin.stack.estimation.slip import SlipLimits, SlipMonitor, closure

DT = 0.01  # s
WHEELS = Wheels()
LAYOUT = load_layout()
CONFIG = StackConfig(site=LAYOUT.site, options=LAYOUT.options)
GRAVITY = 9.81
small = st.floats(-1, 1)


@given(small, small, small)
def test_wheels_that_grip_close(vx, vy, omega):
    speeds = mecanum.wheel_speeds(WHEELS, np.array([vx, vy, omega]))
    assert closure(WHEELS, speeds) == pytest.approx(0.0, abs=1e-12)


def test_a_wheel_that_spins_does_not_close():
    """Hand-worked: one wheel 0.4 m/s too fast at the rim leaves a quarter of it over."""
    speeds = mecanum.wheel_speeds(WHEELS, np.array([0.5, 0.1, 0.2]))
    speeds[2] += 0.4 / WHEELS.radius
    residual = closure(WHEELS, speeds)
    assert residual == pytest.approx(-0.1)
    assert not SlipMonitor().closes(residual, np.array([0.5, 0.1, 0.2]))
    assert SlipMonitor().closes(0.02, np.array([0.0, 0.5, 0.0]))  # creep of a strafe
    assert not SlipMonitor().closes(0.02, np.array([0.9, 0.0, 0.0]))


def test_grip_is_believed_again_only_after_a_while_without_a_sign_of_slip():
    slip, zero = SlipMonitor(), np.zeros(3)
    assert slip.update(0.0, True, True, zero)
    assert not slip.update(0.01, False, True, zero) and slip.slipping
    assert not slip.update(0.08, True, True, zero)
    assert not slip.update(0.10, True, False, zero)  # and again
    assert not slip.update(0.19, True, True, zero)
    assert slip.update(0.21, True, True, zero) and not slip.slipping


@pytest.mark.parametrize(("wobble", "seconds"), [(0.0, 2.0), (0.05, 8.0)])
def test_a_contradiction_that_stays_the_same_is_the_estimates_mistake(wobble, seconds):
    """Expected: a constant one after 2 s, one that changes as slip does only after 8 s."""
    slip = SlipMonitor()
    for k in range(1000):
        offset = np.array([0.2 + wobble * np.sin(0.1 * k), 0.0, 0.0])
        if slip.update(k * DT, True, False, offset):
            break
    assert slip.mistaken and not slip.slipping
    assert k * DT == pytest.approx(seconds, abs=0.25)


def test_rewinding_leaves_what_inertia_alone_would_have_given():
    """Expected: to the bit the filter that never heard the wheels in that span."""
    heard, deaf = (MotionEkf(Imu(), np.zeros(3), (0.01, 0.01, 0.01)) for _ in range(2))
    rewind, rng = Rewind(heard, 0.2), np.random.default_rng(0)
    for k in range(100):
        accel, gyro = rng.normal(0, 0.5, 2), float(rng.normal(0, 0.3))
        rewind.advance(DT, accel, gyro)
        deaf.advance(DT, accel, gyro)
        speed = deaf.x[TWIST] + 0.01
        heard.update_wheels(speed, DT)
        if k < 80:
            deaf.update_wheels(speed, DT)
        rewind.mark(k * DT)
    assert not np.array_equal(heard.x, deaf.x)
    stamps = [stamp for stamp, _ in rewind.back()]
    np.testing.assert_array_equal(heard.x, deaf.x)
    np.testing.assert_array_equal(heard.P, deaf.P)
    assert len(stamps) == 20 and stamps[-1] == pytest.approx(0.99)
    assert not list(rewind.back())  # taken back once


def drive(fused: FusedOdometry, seconds: float, motion, wheels, rng=None):
    """Feed readings of a motion and of wheels: functions of time to vx, vy, omega."""
    start = fused.stamp or 0.0
    last = getattr(fused, "test_ticks", np.zeros(4))
    per_rad = WHEELS.gear_ratio * WHEELS.counts_per_turn / (2 * np.pi)
    for k in range(1, round(seconds / DT) + 1):
        t, mean = k * DT, (k - 0.5) * DT
        last = last + mecanum.wheel_speeds(WHEELS, np.array(wheels(mean))) * DT * per_rad
        change = (np.array(motion(t)) - motion(t - DT)) / DT
        vx, vy, omega = motion(mean)
        force = np.array([change[0] - omega * vy, change[1] + omega * vx, GRAVITY])
        noise = np.zeros(3) if rng is None else rng.normal(0, 1.0, 3) * (7e-3, 7e-3, 1e-3)
        fused.step(
            [
                WheelState(start + t, np.round(last).astype(np.int64), np.zeros(4), np.zeros(3)),
                ImuReading(
                    start + t,
                    force + np.array([*noise[:2], 0.0]),
                    np.array([0, 0, omega + noise[2]]),
                ),
            ]
        )
    fused.test_ticks = last


def still(t):
    return np.zeros(3)


def ramp(t):
    return np.array([min(0.8 * t, 0.9), 0.0, 0.0])


def slow_ramp(t):
    return np.array([min(0.3 * t, 0.9), 0.0, 0.0])


@pytest.mark.parametrize(
    ("motion", "wheels"),
    [
        (still, lambda t: ramp(t)),  # all four spin, the vehicle stays
        (slow_ramp, ramp),  # it follows slowly, as on a wet floor
        (still, lambda t: np.array([0.3 * np.sin(t), 0.0, 0.5 * np.sin(t)])),  # one side spins
        (ramp, lambda t: ramp(t) if t < 1.5 else np.array([0.9, 0.0, 0.4])),  # slides on ahead
    ],
)
def test_slipping_wheels_do_not_move_the_vehicle(motion, wheels):
    """Expected: after 3 s of slip within 3 cm and 3 mrad of the truth, within 3 sigma too."""
    fused = FusedOdometry(CONFIG, np.zeros(3))
    rng = np.random.default_rng(1)
    drive(fused, 3.0, still, still, rng)
    drive(fused, 3.0, motion, wheels, rng)
    truth = sum(np.array(motion((k + 0.5) * DT)) for k in range(300)) * DT
    error = fused.pose(fused.stamp) - truth
    assert fused.slip.slipping
    assert np.hypot(*error[:2]) < 0.03 and abs(error[2]) < 0.003
    assert np.all(np.abs(error) < 3 * np.sqrt(np.diag(fused.covariance)))


def test_after_slip_the_wheels_are_believed_again():
    """Expected: once they report the motion again, the slip is over within 0.2 s."""
    fused = FusedOdometry(CONFIG, np.zeros(3))
    drive(fused, 3.0, still, still, np.random.default_rng(2))
    drive(fused, 1.0, lambda t: slow_ramp(t), lambda t: ramp(t))
    assert fused.slip.slipping
    drive(fused, 0.2, lambda t: slow_ramp(1.0), lambda t: slow_ramp(1.0))
    assert not fused.slip.slipping
    assert np.all(np.abs(fused.ekf.x[SLIP]) < 2.0)


def test_locked_wheels_that_slide_are_not_taken_for_parking():
    """Expected: the vehicle slides on for 0.6 m after its wheels have stopped, and is seen to."""
    fused = FusedOdometry(CONFIG, np.zeros(3))
    drive(fused, 3.0, still, still, np.random.default_rng(3))
    drive(fused, 2.0, ramp, ramp)

    def slide(t):
        return np.array([max(0.9 - 0.6 * t, 0.0), 0.0, 0.0])

    before = fused.pose(fused.stamp)
    drive(fused, 1.5, slide, still)
    assert fused.pose(fused.stamp)[0] - before[0] == pytest.approx(0.675, abs=0.02)
    drive(fused, 1.0, still, still)
    assert fused.standing


def test_a_blow_that_the_unit_does_not_take_is_set_right_by_the_wheels():
    """Expected: 0.3 m/s that no reading tells are found after the 2 s for which slip is thought."""
    fused = FusedOdometry(CONFIG, np.zeros(3))
    drive(fused, 3.0, still, still, np.random.default_rng(4))

    def pushed(t):
        return np.array([0.3, 0.0, 0.0])

    drive(fused, 3.0, pushed, pushed)  # its acceleration was never measured
    assert not fused.slip.slipping
    assert fused.velocity[0] == pytest.approx(0.3, abs=0.02)


def test_a_blow_too_hard_to_measure_is_set_right_at_once():
    """Expected: stopped dead from 0.9 m/s, the reading of it dropped; known within 0.1 s."""
    fused = FusedOdometry(CONFIG, np.zeros(3))
    drive(fused, 3.0, still, still, np.random.default_rng(5))
    drive(fused, 2.0, ramp, ramp)
    blow = ImuReading(fused.stamp + 0.001, np.array([-90.0, 0.0, GRAVITY]), np.zeros(3))
    fused.step([blow])
    assert fused.ignored == 1
    before = fused.pose(fused.stamp)
    drive(fused, 0.1, still, still)
    assert np.hypot(*fused.velocity[:2]) < 0.05
    assert np.hypot(*(fused.pose(fused.stamp) - before)[:2]) < 0.02


def test_arms_at_work_shake_a_parked_vehicle_without_making_it_slip():
    """Expected: wheels that jerk by some counts, and a deck that tilts, leave it parked."""
    fused = FusedOdometry(CONFIG, np.zeros(3))
    drive(fused, 3.0, still, still, np.random.default_rng(6))
    rest = fused.pose(fused.stamp)
    for k in range(200):
        jerk = np.array([30, -20, 10, 40]) * (k // 20 % 2)  # counts, from one reading to the next
        stamp = fused.stamp + DT
        fused.step(
            [
                WheelState(stamp, jerk.astype(np.int64), np.zeros(4), np.zeros(3)),
                ImuReading(stamp, np.array([0.1, 0.0, GRAVITY]), np.zeros(3)),
            ]
        )
        assert fused.standing and not fused.slip.slipping
    assert np.hypot(*(fused.pose(fused.stamp) - rest)[:2]) < 0.001


def test_limits_can_be_chosen():
    patient = SlipMonitor(replace(SlipLimits(), grip_time=1.0))
    patient.update(0.0, False, True, np.zeros(3))
    assert not patient.update(0.9, True, True, np.zeros(3))

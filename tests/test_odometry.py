"""Dead reckoning and the pose buffer."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from twin.geometry import compose2
from twin.messages import WheelState
from twin.stack.config import Wheels
from twin.stack.control import mecanum
from twin.stack.estimation.odometry import WheelOdometry, displacement, exp2
from twin.stack.estimation.pose_history import PoseHistory

WHEELS = Wheels()
small = st.floats(-2, 2)


def counts(twist) -> np.ndarray:
    """Wheel counts for a displacement."""
    turns = mecanum.wheel_speeds(WHEELS, np.asarray(twist)) / (2 * np.pi)
    return turns * WHEELS.gear_ratio * WHEELS.counts_per_turn


def state(stamp, ticks) -> WheelState:
    return WheelState(stamp, np.round(ticks).astype(np.int64), np.zeros(4), np.zeros(3))


@given(small, small, small)
def test_displacement_inverts_the_wheel_equations(x, y, yaw):
    np.testing.assert_allclose(displacement(WHEELS, counts((x, y, yaw))), (x, y, yaw), atol=1e-9)


@given(small, small, small)
def test_two_halves_of_a_twist_make_the_whole(x, y, yaw):
    twist = np.array([x, y, yaw])
    np.testing.assert_allclose(
        compose2(exp2(twist / 2), exp2(twist / 2))[:2], exp2(twist)[:2], atol=1e-9
    )


def test_a_full_circle_returns_to_its_start():
    odometry = WheelOdometry(WHEELS, np.array([1.0, 2.0, 0.5]))
    circle = np.array([1.0, 0.3, 2 * np.pi])
    for k in range(101):
        odometry.update(state(0.1 * k, counts(circle * k / 100)))
    np.testing.assert_allclose(odometry.pose, [1.0, 2.0, 0.5], atol=1e-4)


def test_late_readings_are_ignored():
    odometry = WheelOdometry(WHEELS, np.zeros(3))
    odometry.update(state(0.0, np.zeros(4)))
    pose = odometry.update(state(0.1, counts((0.1, 0, 0)))).copy()
    for stamp in (0.1, 0.05, np.nan):
        np.testing.assert_array_equal(odometry.update(state(stamp, counts((9, 0, 0)))), pose)


def test_history_interpolates_across_the_turn_of_the_angle():
    history = PoseHistory(10)
    history.add(1.0, np.array([0.0, 0.0, 3.1]))
    history.add(1.1, np.array([1.0, 2.0, -3.1]))
    pose = history.at(1.05)
    np.testing.assert_allclose(pose[:2], [0.5, 1.0])
    assert abs(abs(pose[2]) - np.pi) < 1e-9


def test_history_answers_only_where_it_reaches():
    history = PoseHistory(10)
    assert history.at(0.0) is None
    for k in range(30):
        history.add(0.01 * k, np.array([0.01 * k, 0.0, 0.0]))
    assert history.at(0.1) is None  # dropped from the ring
    assert history.at(0.5) is None  # too far ahead
    np.testing.assert_allclose(history.at(0.30), [0.30, 0, 0], atol=1e-12)


def test_poses_found_wrong_are_forgotten():
    history = PoseHistory(10)
    for k in range(6):
        history.add(0.1 * k, np.array([float(k), 0.0, 0.0]))
    history.forget(0.3)
    assert history.at(0.39) is None
    history.add(0.3, np.array([9.0, 0.0, 0.0]))
    np.testing.assert_allclose(history.at(0.3), [9.0, 0, 0])
    np.testing.assert_allclose(history.at(0.2), [2.0, 0, 0])

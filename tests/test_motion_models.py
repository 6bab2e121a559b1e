"""Motion models: hand-worked steps, their noise, reversing and turning on the spot."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from twin.geometry import between2, compose2, wrap_angle
from twin.stack.estimation.motion_models import (
    MotionNoise,
    mismatch,
    omnidirectional,
    split,
    spread,
    turn_path_turn,
)

NONE = MotionNoise(0, 0, 0, 0, 0, 0)
MODELS = [omnidirectional, turn_path_turn]
angle = st.floats(-3.1, 3.1)
metres = st.floats(-2.0, 2.0)


def test_split_by_hand():
    # A 3-4-5 triangle forward and left, ending at 90 degrees (Eqs. 9-11).
    first, path, second = split(np.array([0.4, 0.3, np.pi / 2]))
    assert path == pytest.approx(0.5)
    assert first == pytest.approx(0.643501)
    assert second == pytest.approx(np.pi / 2 - 0.643501)


def test_reversing_is_a_negative_path_without_turns():
    assert split(np.array([-1.0, 0.0, 0.0])) == pytest.approx((0.0, -1.0, 0.0))


def test_a_turn_on_the_spot_is_one_turn():
    first, path, second = split(np.array([0.001, -0.002, 0.8]))
    assert first == 0.0 and second == pytest.approx(0.8) and abs(path) < 0.003


def test_spread_by_hand():
    # Eqs. 12-14: each sigma is the root of two squares.
    noise = MotionNoise(turn_by_turn=0.1, turn_by_path=0.2, along_by_path=0.3, along_by_turn=0.4)
    sigmas = spread((0.3, 2.0, -0.4), noise)
    np.testing.assert_allclose(
        sigmas, [np.hypot(0.03, 0.4), np.hypot(0.6, 0.4 * 0.5), np.hypot(0.04, 0.4)]
    )


def test_noise_is_subtracted_by_hand():
    # Eq. 15 with one sigma of each: half a metre ahead, no turn.
    noise = MotionNoise(turn_by_path=0.2, along_by_path=0.1, turn_by_turn=0, along_by_turn=0)
    moved = turn_path_turn(np.zeros((1, 3)), np.array([0.5, 0, 0]), noise, np.ones((1, 3)))[0]
    heading, length = -0.1, 0.45
    expected = [length * np.cos(heading), length * np.sin(heading), -0.2]
    np.testing.assert_allclose(moved, expected, atol=1e-9)


@settings(deadline=None)  # the first call compiles
@given(metres, metres, angle, metres, metres, angle)
def test_without_noise_a_step_is_composed(x, y, yaw, dx, dy, turn):
    pose, step = np.array([x, y, yaw]), np.array([dx, dy, turn])
    if np.hypot(dx, dy) < 0.01:
        step[:2] = 0.0
    for model in MODELS:
        moved = model(pose[None], step, NONE, np.ones((1, 3)))[0]
        off = between2(compose2(pose, step), moved)
        np.testing.assert_allclose(off, 0.0, atol=1e-6)


@pytest.mark.parametrize("model", MODELS)
def test_spread_of_the_cloud_is_the_noise(model):
    rng = np.random.default_rng(0)
    noise = MotionNoise(0.05, 0.02, 0.10, 0.0, 0.06, 0.0)
    cloud = model(
        np.zeros((20_000, 3)), np.array([1.0, 0, 0]), noise, rng.standard_normal((20_000, 3))
    )
    assert np.std(cloud[:, 0]) == pytest.approx(0.10, rel=0.03)
    across = 0.06 if model is omnidirectional else 0.02
    assert np.std(cloud[:, 1]) == pytest.approx(across, rel=0.03)
    turn = 0.02 if model is omnidirectional else 0.02 * np.sqrt(2)
    assert np.std(cloud[:, 2]) == pytest.approx(turn, rel=0.03)


def test_a_strafe_is_no_turn_for_the_omnidirectional_model():
    rng = np.random.default_rng(1)
    noise = MotionNoise(turn_by_turn=0.3, turn_by_path=0.0)
    step, z = np.array([0.0, 0.5, 0.0]), rng.standard_normal((2000, 3))
    assert np.std(omnidirectional(np.zeros((2000, 3)), step, noise, z)[:, 2]) < 1e-12
    assert np.std(turn_path_turn(np.zeros((2000, 3)), step, noise, z)[:, 2]) > 0.3


def test_mismatch_is_the_error_of_the_odometry():
    # Eqs. 16-18: true path 1.0 m after 0.1 rad, reported 1.1 m after 0.3 rad.
    def step(first, path, second):
        return np.array([path * np.cos(first), path * np.sin(first), first + second])

    np.testing.assert_allclose(
        mismatch(step(0.3, 1.1, -0.2), step(0.1, 1.0, 0.05)), [0.2, 0.1, -0.25]
    )


def test_strafes_on_both_sides_of_a_right_angle_are_split_alike():
    ahead, back = np.array([0.001, 0.5, 0.0]), np.array([-0.001, 0.5, 0.0])
    off = mismatch(ahead, back)
    np.testing.assert_allclose(off, [-0.004, 0.0, 0.004], atol=1e-5)


@settings(deadline=None)  # the first call compiles
@given(angle, angle)
def test_yaw_stays_within_a_turn(yaw, turn):
    for model in MODELS:
        moved = model(np.array([[0, 0, yaw]]), np.array([0, 0, turn]), NONE, np.zeros((1, 3)))
        assert -np.pi < moved[0, 2] <= np.pi + 1e-12
        assert wrap_angle(moved[0, 2] - yaw - turn) == pytest.approx(0.0, abs=1e-9)

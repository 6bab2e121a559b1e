"""Correction of dead reckoning: by hand, and against truth on random ways."""

import numpy as np
import pytest

from twin.geometry import between2, compose2, wrap_angle
from twin.stack.estimation.map_correction import PATH, MapCorrection, growth, transport

SMALL = np.diag([0.01, 0.02, 0.005]) ** 2


def test_it_carries_the_pose_and_swings_its_error():
    filter_ = MapCorrection(np.array([1.0, 2.0, np.pi / 2]), SMALL, np.zeros(3))
    filter_.carry(np.array([3.0, 0.0, 0.0]), np.zeros((3, 3)))
    np.testing.assert_allclose(filter_.pose, (1.0, 5.0, np.pi / 2), atol=1e-12)
    np.testing.assert_allclose(filter_.world_from_odom, (1.0, 2.0, np.pi / 2), atol=1e-12)
    # 3 m north: an error of yaw of 5 mrad moves it 15 mm to the west, beside the noise of the way.
    assert filter_.covariance[0, 0] == pytest.approx(0.01**2 + 0.015**2 + 3 * PATH[0] ** 2)
    assert filter_.covariance[1, 1] == pytest.approx(0.02**2 + 3 * PATH[1] ** 2)


def test_update_by_hand_and_gate():
    filter_ = MapCorrection(np.zeros(3), np.diag([4e-4, 1e-4, 1e-4]), np.zeros(3))
    assert filter_.update(np.array([0.02, 0.0, 0.01]), np.diag([4e-4, 1e-4, 1e-4]))
    np.testing.assert_allclose(filter_.pose, (0.01, 0.0, 0.005), atol=1e-12)
    np.testing.assert_allclose(np.diag(filter_.covariance), (2e-4, 5e-5, 5e-5), atol=1e-12)
    before = filter_.pose.copy()
    assert not filter_.update(np.array([0.5, 0.0, 0.0]), np.diag([4e-4, 1e-4, 1e-4]))
    np.testing.assert_array_equal(filter_.pose, before)


def test_yaw_goes_round():
    filter_ = MapCorrection(np.array([0.0, 0.0, np.pi - 0.01]), np.eye(3) * 1e-2, np.zeros(3))
    assert filter_.update(np.array([0.0, 0.0, -np.pi + 0.01]), np.eye(3) * 1e-2)
    assert abs(wrap_angle(filter_.pose[2] - np.pi)) < 1e-9


def test_growth_is_what_was_added_on_the_way():
    way, added = np.array([2.0, -1.0]), np.diag([1e-4, 2e-4, 1e-5])
    F = transport(way)
    np.testing.assert_allclose(growth(SMALL, F @ SMALL @ F.T + added, way), added, atol=1e-12)
    shrunk = growth(SMALL, 0.5 * SMALL, np.zeros(2))
    np.testing.assert_allclose(shrunk, 0.0, atol=1e-12)


def test_a_drifting_odometry_is_held_within_what_the_filter_says():
    rng = np.random.default_rng(0)
    nees = []
    for _ in range(20):
        truth, odometry = np.zeros(3), np.array([3.0, 1.0, 1.0])
        filter_ = MapCorrection(rng.normal(0, [0.01, 0.02, 0.005]), SMALL, odometry)
        sigma = np.array([0.02, 0.02, 0.01])
        for _ in range(60):
            step = np.array([0.1, 0.0, rng.uniform(-0.05, 0.05)])
            truth = compose2(truth, step)
            odometry = compose2(odometry, step + rng.normal(0, PATH * np.sqrt(0.1)))
            filter_.carry(odometry, np.zeros((3, 3)))
            filter_.update(truth + rng.normal(0, sigma), np.diag(sigma**2))  # one in 1000 is gated
        off = filter_.pose - truth
        nees.append(off @ np.linalg.solve(filter_.covariance, off) / 3)
        np.testing.assert_allclose(
            compose2(filter_.world_from_odom, odometry), filter_.pose, atol=1e-9
        )
        assert np.hypot(*between2(truth, filter_.pose)[:2]) < 0.03
    assert 0.4 < np.mean(nees) < 1.8

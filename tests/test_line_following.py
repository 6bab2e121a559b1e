"""Line following: fits by hand, steep lines, outliers, and a drive along a wall in closed loop."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from twin.geometry import compose2, rot2
from twin.stack.planning.line_following import (
    LineFollower,
    fit_line,
    least_squares,
    line_through,
    steering_angle,
    total_least_squares,
)

angle = st.floats(-1.5, 1.5)


def points_on(angle, distance, n=40, noise=0.0, rng=None):
    """Points of a line in base, by its direction and its distance to the left."""
    along = np.linspace(-0.8, 1.2, n)[:, None] * (np.cos(angle), np.sin(angle))
    p = along + distance * np.array([-np.sin(angle), np.cos(angle)])
    return p if rng is None else p + rng.normal(0, noise, p.shape)


def test_least_squares_by_hand():
    # Sums: n 4, x 6, y 10, xx 14, xy 19.5: a1 = (78 - 60) / 20, a0 = (140 - 117) / 20.
    a0, a1 = least_squares(np.array([(0, 1.0), (1, 2.5), (2, 2.5), (3, 4.0)])) or (0, 0)
    assert (a0, a1) == (pytest.approx(1.15), pytest.approx(0.9))


@given(st.integers(0, 2**32 - 1), st.integers(3, 50))
def test_least_squares_is_the_least(seed, n):
    rng = np.random.default_rng(seed)
    p = rng.normal(0, 1, (n, 2)) + rng.normal(0, 5, 2)
    a0, a1 = least_squares(p) or (0, 0)
    np.testing.assert_allclose([a1, a0], np.polyfit(p[:, 0], p[:, 1], 1), rtol=1e-6, atol=1e-6)


@given(angle, st.floats(-3, 3))
def test_both_find_an_exact_line(turn, distance):
    p = points_on(turn, distance)
    line = total_least_squares(p)
    a0, a1 = least_squares(p) or (np.nan, np.nan)
    assert line is not None and line.rms < 1e-9
    assert steering_angle(line) == pytest.approx(np.arctan(a1), abs=1e-7) == pytest.approx(turn)
    assert line.distance == pytest.approx(distance, abs=1e-9)
    assert line.offset == pytest.approx(a0, rel=1e-6, abs=1e-6)
    assert line.slope == pytest.approx(a1, rel=1e-6, abs=1e-6)


def test_steep_lines_need_total_least_squares():
    rng = np.random.default_rng(0)
    p = points_on(np.radians(89), 1.0, 200, 0.02, rng)
    line = total_least_squares(p)
    _, a1 = least_squares(p) or (0, 0)
    assert line is not None and abs(line.angle - np.radians(89)) < np.radians(0.5)
    assert abs(np.arctan(a1) - np.radians(89)) > np.radians(3)  # noise in x bends it down
    upright = np.array([(1.0, y) for y in np.linspace(0, 1, 9)])
    assert least_squares(upright) is None
    line = total_least_squares(upright)
    assert line is not None and line.angle == pytest.approx(np.pi / 2)
    assert line.distance == pytest.approx(-1.0)


def test_a_line_along_the_way_is_the_sources_and_a_steep_one_that_of_distances():
    rng = np.random.default_rng(2)
    p = points_on(0.3, 0.6, 50, 0.002, rng)
    a0, a1 = least_squares(p) or (np.nan, np.nan)
    line, trimmed = line_through(p), fit_line(p)
    assert line is not None and trimmed is not None
    assert line.slope == pytest.approx(a1) and line.offset == pytest.approx(a0)
    assert trimmed.points == 50 and trimmed.angle == pytest.approx(line.angle)
    p = points_on(1.4, 0.6, 50, 0.05, rng)
    assert line_through(p) == total_least_squares(p)


@given(angle, angle, st.floats(-2, 2), st.floats(-2, 2))
def test_total_least_squares_turns_with_the_points(turn, more, x, y):
    rng = np.random.default_rng(0)
    p = points_on(turn, 0.7, 30, 0.02, rng)
    a, b = total_least_squares(p), total_least_squares(p @ rot2(more).T + (x, y))
    assert a is not None and b is not None
    turned = (b.angle - a.angle - more + np.pi / 2) % np.pi - np.pi / 2
    assert turned == pytest.approx(0.0, abs=1e-9) and b.rms == pytest.approx(a.rms)


def test_what_lies_off_the_line_is_trimmed():
    rng = np.random.default_rng(1)
    p = points_on(0.1, 0.6, 100, 0.01, rng)
    p[70:] += (0.0, 0.35)  # a niche
    line = fit_line(p)
    assert line is not None and abs(line.angle - 0.1) < 0.02 and abs(line.distance - 0.6) < 0.01
    whole = total_least_squares(p)
    assert whole is not None and abs(whole.angle - 0.1) > 0.1


@pytest.mark.parametrize(
    "points", [np.zeros((0, 2)), np.full((30, 2), np.nan), np.ones((30, 2)), np.eye(2)]
)
def test_no_line(points):
    assert fit_line(points) is None
    assert LineFollower(0.5, 0.6).command(points) is None


def test_broken_points_are_left_out():
    p = points_on(0.2, 0.6)
    p[::7] = np.nan
    p[3] = np.inf
    line = fit_line(p)
    assert line is not None and line.angle == pytest.approx(0.2)


def test_source_rule_of_signs():
    follower = LineFollower(0.5, 0.6)
    left, right = (follower.command(points_on(a, 0.6)) for a in (0.2, -0.2))
    assert left is not None and right is not None
    assert left.omega > 0 > right.omega
    assert np.hypot(left.vx, left.vy) == pytest.approx(0.5)


@settings(max_examples=15, deadline=None)
@given(st.floats(0.45, 0.85), st.floats(-0.3, 0.3), st.sampled_from([1, -1]))
def test_comes_to_run_along_a_wall(distance, yaw, side):
    """Wall along x at y = 0: a vehicle that obeys at once ends parallel, at the distance."""
    follower = LineFollower(0.5, side * 0.6)
    pose = np.array([0.0, -side * distance, yaw])
    for _ in range(200):
        wall = np.column_stack([np.arange(pose[0] - 3, pose[0] + 3, 0.05), np.zeros(120)])
        command = follower.command((wall - pose[:2]) @ rot2(pose[2]))
        assert command is not None
        assert abs(command.omega) <= follower.turn_rate
        pose = compose2(pose, 0.04 * command.as_array())
    assert abs(pose[1] + side * 0.6) < 0.005 and abs(pose[2]) < 0.005
    assert pose[0] > 0.9 * 0.5 * 200 * 0.04

"""What stops a straight leg, and what does not."""

import numpy as np
import pytest

import scenarios.mapping as mapping
from evaluation.run import RunRequest
from twin.layout import load_layout
from twin.stack.config import DriveLimits
from twin.stack.planning.clearance import Footprint, no_obstacles, points
from twin.stack.planning.leg_watch import leg_blocked

BODY, LIMITS = Footprint(0.7, 0.5), DriveLimits()
REST = np.zeros(3)


def blocked(at, pose=(0, 0, 0), goal=(3, 0, 0), velocity=(0, 0, 0)) -> bool:
    rows = points([at], 0.025)
    return leg_blocked(np.array(pose, float), np.array(goal, float), np.array(velocity, float),
                       rows, BODY, LIMITS)  # fmt: skip


def test_at_rest_only_what_is_close_ahead_counts():
    assert blocked((0.45, 0.0))
    assert not blocked((1.2, 0.0))
    assert not blocked((-0.45, 0.0)) and not blocked((0.45, 0.4))


def test_at_speed_what_braking_takes_counts():
    """0.9 m/s at 1 m/s^2 and 0.3 s: some 0.4 m and more before the bumper."""
    braking = 0.9**2 / (2 * LIMITS.acceleration) + 0.3 * 0.9
    assert blocked((0.35 + braking, 0.0), velocity=(0.9, 0, 0))
    assert not blocked((0.35 + braking + 0.3, 0.0), velocity=(0.9, 0, 0))


def test_nothing_beyond_the_goal_counts():
    assert not blocked((1.2, 0.0), goal=(0.5, 0, 0), velocity=(0.9, 0, 0))


@pytest.mark.parametrize("turn, hit", [(1.0, True), (-1.0, False)])
def test_a_turn_sweeps_its_corners(turn, hit):
    """A point just outside of the front left corner's way to the left."""
    assert blocked((0.30, 0.29), goal=(0, 0, turn)) is hit


def test_no_strangers_no_stop():
    assert not leg_blocked(REST, np.array([1.0, 0, 0]), REST, no_obstacles(), BODY, LIMITS)


def test_the_vehicle_stops_before_what_stands_on_its_straight_leg(tmp_path):
    """`mapping` leaves its dock straight: a carton 1.5 m ahead of it, on no map."""
    layout = load_layout(None, ('world.faults.obstacles=[{kind="carton",pose=[1.5,0,0]}]',))
    result = mapping.run(RunRequest(0, tmp_path, duration=5.0), layout)
    _, poses = result.trajectories["truth"]
    assert result.metrics["collisions"] == 0
    assert 0.3 < poses[-1][0] - poses[0][0] < 0.8

"""Driving along way-points, against the wheel loops' drawn answer and on the plant."""

from itertools import pairwise

import numpy as np
import pytest
from drive_bench import DriveBench
from hypothesis import given, settings
from hypothesis import strategies as st

from twin.geometry import compose2, wrap_angle
from twin.layout import load_layout
from twin.stack.config import DriveLimits
from twin.stack.estimation.odometry import exp2
from twin.stack.planning.drive import Drive, Leg
from twin.stack.planning.tracking import MARGIN

DT = 0.01
LIMITS = DriveLimits()
SITE = load_layout().site
# Straight, strafe, turn on the spot; the last legs are along the belt and away from it.
TO_LINE = ([2.4, 0.0, 0.0], [2.4, 0.7, 0.0], [4.0, 0.7, 0.0], SITE.pick_approach)
AWAY = (SITE.pick_leave,)


class WheelLoops:
    """Velocity answer (T s + 1) / (L T s^2 + T s + 1) after a dead time, as the drawing has it."""

    def __init__(self):
        self.velocity, self._integral = np.zeros(3), np.zeros(3)
        self._delayed = [np.zeros(3)] * 2

    def step(self, command: np.ndarray) -> np.ndarray:
        lag, washout = np.array(LIMITS.velocity_lag), LIMITS.lag_washout
        self._delayed.append(command)
        wanted = self._delayed.pop(0)
        for _ in range(10):
            error = wanted - self.velocity
            self._integral += error / (lag * washout) * DT / 10
            self.velocity = self.velocity + (error / lag + self._integral) * DT / 10
        return self.velocity


def follow(route, start, limit=60.0):
    """Drive with ideal estimates; rows of time, pose and velocity."""
    drive, loops = Drive(LIMITS), WheelLoops()
    pose, now, rows = np.array(start, dtype=float), 0.0, []
    drive.start(now, pose, route)
    while not drive.done and now < limit:
        command = drive.step(now, pose, loops.velocity)
        pose = compose2(pose, exp2(loops.step(command.as_array()) * DT))
        now += DT
        rows.append([now, *pose, *loops.velocity])
    return drive, np.array(rows)


def test_route_to_the_line_is_driven_at_cruise_and_ends_in_place():
    route = [*TO_LINE, SITE.pick]
    drive, rows = follow(route, SITE.dock)
    assert drive.done
    np.testing.assert_allclose(rows[-1, 1:3], SITE.pick[:2], atol=0.005)
    assert abs(wrap_angle(rows[-1, 3] - SITE.pick[2])) < np.radians(0.3)
    assert rows[:, 4].max() == pytest.approx(0.95, abs=0.02)
    assert np.abs(rows[:, 5]).max() < LIMITS.strafe_speed * MARGIN
    poses, legs = [np.array(SITE.dock), *(np.array(p) for p in route)], []
    for a, b in pairwise(poses):
        legs.append(Leg(LIMITS, a, b, 0.0))
    assert rows[-1, 0] - sum(leg.duration for leg in legs) < 0.05 * len(route) + 0.3


def test_stop_time_predicts_the_arrival():
    predicted = Leg(LIMITS, np.zeros(3), np.array([2.0, 0.0, 0.0]), 0.0).ends
    _, rows = follow([[2.0, 0.0, 0.0]], np.zeros(3))
    stopped = rows[np.nonzero(np.abs(rows[:, 4]) > 0.02)[0][-1], 0]
    assert stopped == pytest.approx(predicted, abs=0.15)


poses = st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3.1, 3.1))


@settings(max_examples=60, deadline=None)
@given(poses, poses)
def test_leg_keeps_to_every_limit(start, goal):
    leg = Leg(LIMITS, np.array(start), np.array(goal), 0.0)
    for t in np.linspace(0, leg.duration, 40):
        _, velocity, acceleration = leg.at(t)
        assert np.hypot(*velocity[:2]) <= LIMITS.speed + 1e-6
        assert np.hypot(*acceleration[:2]) <= LIMITS.acceleration + 1e-6
        assert abs(velocity[2]) <= LIMITS.turn_rate + 1e-6
        assert abs(acceleration[2]) <= LIMITS.turn_acceleration + 1e-6
    reference, velocity, _ = leg.at(leg.ends)
    np.testing.assert_allclose(reference[:2], goal[:2], atol=1e-9)
    np.testing.assert_allclose(velocity, 0, atol=1e-9)


def test_a_leg_of_no_length_takes_no_time():
    assert Leg(LIMITS, np.ones(3), np.ones(3), 0.0).duration < 0.01


@pytest.fixture(scope="module")
def mission():
    """Two vehicles as built, from dock to line and on to the receiving point."""
    benches = []
    for seed in (0, 3):
        bench = DriveBench(seed)
        bench.stand_until_ready()
        bench.go([*TO_LINE, SITE.pick])
        bench.at_pick = bench.world.truth().pose
        bench.go([*AWAY, SITE.receiving])
        benches.append(bench)
    return benches


def test_plant_arrives_without_touching_anything(mission):
    """Expected: within 5 cm of the drawn poses, start error of the dock included."""
    for bench in mission:
        assert bench.drive.done and not bench.world.collisions
        for pose, goal in ((bench.at_pick, SITE.pick), (bench.track.truth[-1], SITE.receiving)):
            assert np.hypot(*(pose[:2] - goal[:2])) < 0.05
            assert abs(wrap_angle(pose[2] - goal[2])) < np.radians(1.0)


def test_fused_pose_stays_within_5_cm_and_beats_the_wheels(mission):
    fused = np.concatenate([b.track.ape(b.track.fused) for b in mission])
    wheels = np.concatenate([b.track.ape(b.track.wheels) for b in mission])
    assert fused.max() < 0.05
    assert np.sqrt(np.mean(fused**2)) < np.sqrt(np.mean(wheels**2))


def test_covariance_on_the_plant_is_honest(mission):
    nees = np.concatenate([b.track.nees() for b in mission])
    assert 0.3 < nees.mean() < 3.0


def hold(blocked_from, blocked_to, limit=60.0):
    """A leg of 2 m that is blocked for a while; rows of time, pose and velocity."""
    drive, loops = Drive(LIMITS), WheelLoops()
    pose, now, rows = np.zeros(3), 0.0, []
    drive.start(now, pose, [[2.0, 0.0, 0.0]])
    while not drive.done and now < limit:
        command = drive.step(now, pose, loops.velocity, blocked_from <= now < blocked_to)
        pose = compose2(pose, exp2(loops.step(command.as_array()) * DT))
        now += DT
        rows.append([now, *pose, *loops.velocity])
    return drive, np.array(rows)


def test_a_blocked_leg_is_held_and_driven_on_when_it_is_free():
    drive, rows = hold(1.5, 8.0)
    assert drive.done and not drive.failure
    held = rows[(rows[:, 0] > 3.5) & (rows[:, 0] < 8.4)]
    assert np.ptp(held[:, 1]) < 0.01 and held[0, 1] < 1.6
    assert rows[-1, 1] == pytest.approx(2.0, abs=0.006)
    braking = np.diff(rows[:, 4]) / DT
    assert braking.min() > -2.0 * LIMITS.acceleration
    assert drive.events == ["straight leg blocked: waiting"]


def test_a_leg_that_stays_blocked_is_given_up_with_a_reason():
    drive, rows = hold(1.5, np.inf)
    assert drive.done and "something stands on the way to (2.00, 0.00)" in drive.failure
    assert rows[-1, 0] < 30.0 and np.abs(rows[-1, 4:]).max() < 0.01
    drive.start(40.0, rows[-1, 1:4], [[0.0, 0.0, 0.0]])
    assert not drive.done and not drive.failure


def test_a_leg_that_never_comes_to_rest_is_given_up():
    drive = Drive(LIMITS)
    drive.start(0.0, np.zeros(3), [[0.5, 0.0, 0.0]])
    for k in range(4000):
        drive.step(k * DT, np.array([0.3, 0.0, 0.0]), np.zeros(3))
    assert drive.done and "200 mm off" in drive.failure

"""Paths, timing and plans of the arms."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from twin.geometry import apply, inverse
from twin.layout import load_layout
from twin.stack.config import StackConfig
from twin.stack.control.arm_kinematics import Unreachable
from twin.stack.control.arm_motion import ArmMotion, Grasp, TooLate
from twin.stack.control.arm_path import STEP, hand_path, taut_string

LAYOUT = load_layout()
CONFIG = StackConfig(site=LAYOUT.site, options=LAYOUT.options)
ARM = CONFIG.arm


def new_arm(index=0, ready=True):
    motion = ArmMotion(index, CONFIG)
    return motion, (motion.go_ready(0.0) if ready else 0.0)


def grasp(motion, x, y=0.45, z=0.710, yaw=0.3, speed=0.15, stamp=0.0):
    """A part on the belt in base coordinates, as the arm sees it; the belt runs along -x."""
    p = apply(motion.T_mount_base, np.array([x, y, z]))
    return Grasp(stamp, p, motion.T_mount_base[:3, :3] @ np.array([-speed, 0.0, 0.0]), yaw)


def sampled(motion, start, end, step=0.002):
    return [motion.state(t) for t in np.arange(start, end, step)]


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from([0, 1]),
    st.floats(0, 1),
    st.floats(0.40, 0.50),
    st.integers(0, 27),
    st.floats(-np.pi, np.pi),
    st.booleans(),
)
def test_transfer_is_within_limits_clear_and_on_its_own_side(index, u, y, slot, yaw, back):
    motion, now = new_arm(index)
    low, high = CONFIG.pick_windows[index]
    above = apply(motion.T_mount_base, np.array([low + u * (high - low), y, 0.775]))
    place = apply(motion.T_mount_base, CONFIG.tray.slots()[slot] + [0, 0, 0.010])
    now = motion.move_to(now, above, yaw)
    middle = motion.move_to(now, place)
    end = motion.move_to(middle, above, yaw + 0.4)
    start, stop = (middle, end) if back else (now, middle)
    states = sampled(motion, start, stop)
    qd, qdd = np.array([s.qd for s in states]), np.array([s.qdd for s in states])
    assert (np.abs(qd) <= np.array(ARM.max_speed) * 1.001).all()
    assert (np.abs(qdd) <= np.array(ARM.max_acceleration)).all()
    torque = np.array([motion.dynamics.torque(s.q, s.qd, s.qdd) for s in states[::10]])
    assert (np.abs(torque) <= 0.95 * np.array(ARM.max_torque)).all()

    tcp = np.array([motion.kinematics.forward(s.q)[:3, 3] for s in states[::5]])
    p = apply(CONFIG.T_base_arm[index], tcp)
    over_belt = p[:, 1] > CONFIG.T_base_arm[index][1, 3] + motion.travel.belt_edge + 0.05
    assert p[over_belt, 2].min() > LAYOUT.site.line.height + 0.06
    away = np.hypot(*(tcp - place)[:, :2].T) > 0.03
    assert p[away, 2].min() > CONFIG.tray.floor + CONFIG.tray.wall + 0.05
    assert np.hypot(tcp[:, 0], tcp[:, 1]).min() > 0.13  # hand 38 mm off its own column
    side = max(abs(above[1]), abs(place[1]), 0.15)
    assert np.abs(tcp[:, 1]).max() < side + 0.002  # no further out than its ends


@settings(max_examples=100, deadline=None)
@given(st.floats(0.15, 0.5), st.floats(-2.8, 2.8), st.floats(0.15, 0.5), st.floats(-2.8, 2.8))
def test_taut_string_keeps_clear_and_is_no_longer_than_an_arc(r0, a0, r1, a1):
    ends = [r * np.array([np.cos(a), np.sin(a)]) for r, a in ((r0, a0), (r1, a1))]
    route = taut_string(*ends, 0.15)
    np.testing.assert_allclose(route[[0, -1]], ends)
    length = np.linalg.norm(np.diff(route, axis=0), axis=1).sum()
    assert length <= abs(r0 - r1) + abs(a1 - a0) * min(r0, r1) + 1e-6
    if abs(a1 - a0) < np.pi - 0.01:
        dense = np.vstack([np.linspace(a, b, 20) for a, b in pairwise(route)])
        assert np.hypot(*dense.T).min() > 0.1495


def test_swing_of_a_quarter_turn_takes_about_0_8_s():
    motion, now = new_arm()
    motion.move_to(now, np.array([0.30, 0.0, 0.22]))
    assert motion.duration_to(now, np.array([0.0, 0.30, 0.22])) < 0.82


@pytest.mark.parametrize("index", [0, 1])
def test_stow_is_compact_and_clearly_away_from_ready(index):
    motion, _ = new_arm(index, ready=False)
    assert 1.0 < motion.duration_to(0.0, motion.ready_position) < 1.4
    _, origins = motion.kinematics.frames(motion.state(0.0).q)
    p = apply(CONFIG.T_base_arm[index], origins)
    assert (np.abs(p[:, 0]) < 0.35 - 0.046).all() and (np.abs(p[:, 1]) < 0.25 - 0.046).all()
    assert motion.tcp(0.0)[2] > 0.12


@settings(max_examples=40, deadline=None)
@given(st.sampled_from([0, 1]), st.floats(0.0, 0.5), st.floats(0.405, 0.495), st.floats(-1.6, 1.6))
def test_pick_meets_the_part_with_its_velocity(index, speed, y, yaw):
    motion, now = new_arm(index)
    high = CONFIG.pick_windows[index][1]
    x = high - 0.05 + speed * 0.9
    part = grasp(motion, x, y, yaw=yaw, speed=speed, stamp=now)
    meet = motion.earliest_meeting(now, part)
    if speed > 0.0:
        meet = max(meet, now + (x - high) / speed)
    times = motion.pick(now, part, meet)
    for t in np.arange(times.close, times.lift, 0.010):
        s = motion.state(t)
        np.testing.assert_allclose(motion.tcp(t), part.at(t), atol=1e-5)
        twist = motion.kinematics.jacobian(s.q) @ s.qd
        np.testing.assert_allclose(twist[:3], part.velocity, atol=2e-3)
        np.testing.assert_allclose(twist[3:], 0.0, atol=1e-2)
    closing = motion.kinematics.forward(motion.state(meet).q)[:3, 1]
    assert abs(closing @ [np.cos(part.yaw), np.sin(part.yaw), 0]) == pytest.approx(1, abs=1e-6)
    assert np.abs(motion.state(times.done).qd).max() < 1e-3
    smooth(motion, now, times.done)


def smooth(motion, start, end):
    """No jump of position or velocity between samples."""
    states = sampled(motion, start, end)
    dq = np.diff([s.q for s in states], axis=0)
    dqd = np.diff([s.qd for s in states], axis=0)
    assert np.abs(dq).max() <= 3.15 * STEP
    assert np.abs(dqd).max() <= 26.0 * STEP


def test_earliest_meeting_is_the_earliest():
    motion, now = new_arm()
    part = grasp(motion, 0.25, stamp=now)
    meet = motion.earliest_meeting(now, part)
    motion.pick(now, part, meet + 0.001)
    motion, now = new_arm()
    with pytest.raises(TooLate):
        motion.pick(now, part, meet - 0.02)
    assert motion.idle(now)  # nothing was changed


def test_plan_can_be_corrected_under_way():
    motion, now = new_arm()
    part = grasp(motion, 0.30, stamp=now)
    first = motion.pick(now, part, now + 1.2)
    before = motion.state(now + 0.5)
    moved = Grasp(part.stamp, np.add(part.position, [0.004, -0.003, 0]), part.velocity * 1.02, 0.25)
    second = motion.pick(now + 0.5, moved, first.close)
    after = motion.state(now + 0.5)
    for a, b in zip(before, after, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)
    np.testing.assert_allclose(motion.tcp(second.close), moved.at(second.close), atol=1e-5)
    smooth(motion, now + 0.5, second.done)


def test_pick_from_over_the_tray_goes_out_by_a_safe_path_first():
    motion, now = new_arm(ready=False)
    part = grasp(motion, 0.5, stamp=now)
    meet = motion.earliest_meeting(now, part)
    assert meet > motion.duration_to(now, motion.ready_position)
    times = motion.pick(now, part, meet + 0.1)
    tcp = np.array([motion.tcp(t) for t in np.arange(0.0, times.descend, 0.01)])
    assert tcp[tcp[:, 0] > motion.travel.belt_edge + 0.05, 2].min() > 0.20


def test_part_that_runs_away_is_too_late():
    motion, now = new_arm()
    with pytest.raises(Unreachable):
        motion.earliest_meeting(now, grasp(motion, -0.35, speed=0.3, stamp=now))


def test_joint_six_does_not_wind_up():
    motion, now = new_arm()
    rng = np.random.default_rng(3)
    slots = CONFIG.tray.slots()
    for _ in range(40):
        part = grasp(motion, 0.15, yaw=rng.uniform(-np.pi, np.pi), speed=0.0, stamp=now)
        motion.pick(now, part, motion.earliest_meeting(now, part) + 0.01)
        slot = apply(motion.T_mount_base, slots[rng.integers(14)] + [0, 0, 0.01])
        now = motion.place(now, slot, rng.uniform(-np.pi, np.pi)).done
        now = motion.go_ready(now)
        assert abs(motion.state(now).q[5]) < np.pi + 1e-6


def test_path_rises_before_it_travels():
    motion, _ = new_arm()
    place = apply(inverse(CONFIG.T_base_arm[0]), np.array([0.06, 0.0, 0.566]))
    path = hand_path(place, motion.ready_position, motion.travel)
    np.testing.assert_allclose(path[[0, -1]], [place, motion.ready_position], atol=1e-9)
    low = path[:, 2] < motion.travel.tray_height - 0.02
    assert np.hypot(*(path[low] - place)[:, :2].T).max() < 0.02

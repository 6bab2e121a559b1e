"""Recovery: ends with a plan, or standing still and saying why."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from twin.geometry import compose2
from twin.stack.estimation.odometry import exp2
from twin.stack.planning.recovery import Recovery, RecoveryOptions, Stage

DT = 0.05


def run(plan_in, room_to_turn=True, room_back=2.0, moves=True, limit=120.0):
    """Steps until the end; `plan_in(stage, count)` says whether a plan is found when asked."""
    recovery, pose, now, planned, steps = Recovery(), np.zeros(3), 0.0, False, []
    recovery.start(now, pose, "no free way to (1.00, 2.00)")
    while recovery.active and now < limit:
        step = recovery.step(now, pose, planned, room_to_turn, room_back)
        steps.append((step, pose))
        if step.replan:
            planned = plan_in(step.stage, sum(s.replan for s, _ in steps))
        if moves:
            pose = compose2(pose, exp2(step.velocity.as_array() * DT))
        now += DT
    return recovery, steps, now


def test_a_cleared_map_may_be_enough_and_nothing_moves():
    recovery, steps, now = run(lambda stage, _: stage is Stage.CLEAR_MAP)
    assert recovery.stage is Stage.RECOVERED and now < 2.0
    assert sum(s.clear_map for s, _ in steps) == 1
    assert all(not s.velocity.as_array().any() for s, _ in steps)


def test_backs_out_of_a_dead_end_that_is_too_narrow_to_turn():
    recovery, steps, _ = run(lambda stage, _: stage is Stage.BACK_OUT, room_to_turn=False)
    assert recovery.stage is Stage.RECOVERED
    assert all(s.velocity.omega == 0 for s, _ in steps)
    np.testing.assert_allclose(steps[-1][1], [-RecoveryOptions().back, 0, 0], atol=0.02)


def test_turns_by_a_quarter_and_backs_out_then_gives_up_with_the_reason():
    recovery, steps, now = run(lambda *_: False)
    assert recovery.stage is Stage.GIVEN_UP and now < 60
    assert "no free way to (1.00, 2.00)" in recovery.reason and "back out" in recovery.reason
    assert "\n" not in recovery.reason and steps[-1][0].event == recovery.reason
    assert not steps[-1][0].velocity.as_array().any()
    turned = [p[2] for s, p in steps if s.stage is Stage.BACK_OUT]
    assert abs(turned[0] - np.pi / 2) < 0.05


def test_stages_come_in_order_and_each_asks_for_a_plan_once():
    _, steps, _ = run(lambda *_: False)
    asked = [s.stage for s, _ in steps if s.replan]
    assert asked == [Stage.CLEAR_MAP, Stage.TURN, Stage.BACK_OUT] * RecoveryOptions().rounds


def test_wheels_that_do_not_move_it_end_in_giving_up():
    recovery, _, now = run(lambda *_: False, moves=False)
    assert recovery.stage is Stage.GIVEN_UP and now < 120


def test_a_pose_that_is_not_finite_stops_it_and_changes_nothing():
    recovery = Recovery()
    recovery.start(0.0, np.zeros(3), "blocked")
    step = recovery.step(0.1, np.array([0.0, np.nan, 0.0]), True, True, 1.0)
    assert recovery.stage is Stage.CLEAR_MAP and not step.velocity.as_array().any()
    assert recovery.step(0.2, np.zeros(3), False, True, np.nan).clear_map


@settings(max_examples=60, deadline=None)
@given(
    st.integers(1, 8),
    st.booleans(),
    st.floats(0, 1),
    st.lists(st.booleans(), min_size=8, max_size=8),
)
def test_always_ends(found, room_to_turn, room_back, moves):
    recovery, steps, now = run(
        lambda _, count: count >= found, room_to_turn, room_back, moves=moves[0]
    )
    assert not recovery.active and now < 120
    assert (recovery.stage is Stage.RECOVERED) == (found <= 6)
    backing = [s for s, _ in steps if s.velocity.vx]
    assert room_back > RecoveryOptions().room or not backing
    assert recovery.step(now, np.zeros(3), True, True, 1.0).velocity.vx == 0

"""One arm at work, told what its gripper and joints feel: grips kept, lost, and a blocked arm."""

import numpy as np
import pytest

from twin.geometry import inverse, pose2_to_transform
from twin.layout import load_layout
from twin.messages import ArmReading, GripperReading, TrackedPart
from twin.stack.config import nominal_config
from twin.stack.tasks.arm_worker import ArmWorker, Job, Phase, grasp_of

LAYOUT = load_layout()
CONFIG = nominal_config(LAYOUT.site, LAYOUT.options)
PART = "sma_f_n_m"
GOOD = (CONFIG.parts[PART].grip_width, CONFIG.gripper.force)  # width, force of a sound grip
EMPTY = (0.0, 0.0)
TICK = 0.01


def at_work(arm: int = 0) -> ArmWorker:
    """A worker that has just set out for a part in the middle of its window."""
    worker = ArmWorker(arm, CONFIG)
    T_base_odom = inverse(pose2_to_transform(LAYOUT.site.pick))
    x = sum(CONFIG.pick_windows[arm]) / 2 + 0.4
    p_odom = (inverse(T_base_odom) @ (x, 0.45, LAYOUT.site.line.height, 1.0))[:3]
    velocity = inverse(T_base_odom)[:3, :3] @ np.array([-0.15, 0.0, 0.0])
    part = TrackedPart(7, PART, 1.0, p_odom, velocity, yaw=0.3, hits=20)
    grasp = grasp_of(part, 0.0, CONFIG, worker.motion.T_mount_base @ T_base_odom)
    meet = worker.earliest(0.0, grasp)
    assert meet is not None
    slot = CONFIG.tray.slots()[0 if arm == 0 else -1]
    assert worker.take(0.0, Job(7, PART, slot, meet), grasp)
    return worker


def run(worker: ArmWorker, feels, seconds: float = 8.0) -> list[float]:
    """Step the worker; `feels(phase)` is what its gripper reads. Commanded widths, in order."""
    now, widths = 0.0, []
    while now < seconds and worker.phase is not Phase.IDLE:
        worker.hear(GripperReading(now, worker.index, *feels(worker.phase)))
        worker.hear(ArmReading(now, worker.index, worker.motion.state(now).q, np.zeros(6)))
        _, gripper = worker.step(now)
        if not widths or widths[-1] != gripper.width:
            widths.append(gripper.width)
        now += TICK
    return widths


@pytest.mark.parametrize("arm", [0, 1])
def test_a_sound_grip_ends_in_the_slot(arm):
    worker = at_work(arm)
    widths = run(worker, lambda phase: GOOD)
    assert worker.phase is Phase.IDLE and not worker.lost
    assert [job.track_id for job in worker.placed] == [7]
    wide, closed, released = widths
    assert wide > GOOD[0] + 0.01 and closed == 0.0 and GOOD[0] < released < wide


def test_fingers_that_close_on_nothing_give_up():
    worker = at_work()
    run(worker, lambda phase: EMPTY)
    assert worker.phase is Phase.IDLE and not worker.placed
    assert [job.track_id for job in worker.lost] == [7]
    assert any("closed on nothing" in e for e in worker.events)


def test_a_part_lost_on_the_way_is_noticed():
    worker = at_work()
    run(worker, lambda phase: EMPTY if phase is Phase.CARRYING else GOOD)
    assert not worker.placed and len(worker.lost) == 1
    assert any("lost the part on the way" in e for e in worker.events)


def test_a_part_of_another_width_is_not_carried_off():
    worker = at_work()
    run(worker, lambda phase: (GOOD[0] + 0.012, GOOD[1]))
    assert not worker.placed and len(worker.lost) == 1


def test_an_arm_whose_joints_do_not_follow_stops_where_it_is():
    """Expected result: told off once, it holds the angles that its encoders read."""
    worker = at_work()
    stuck = worker.motion.state(0.0).q
    for k in range(150):
        worker.hear(ArmReading(k * TICK, 0, stuck, np.zeros(6)))
        command, _ = worker.step(k * TICK)
    assert worker.phase is Phase.BLOCKED and not worker.free
    np.testing.assert_array_equal(command.position, stuck)
    assert not command.velocity.any()
    assert sum("is blocked" in e for e in worker.events) == 1


def test_a_short_lag_does_not_stop_an_arm():
    worker = at_work()
    for k in range(100):
        reference = worker.motion.state(k * TICK).q
        lag = 0.2 if k % 20 == 0 else 0.0
        worker.hear(ArmReading(k * TICK, 0, reference + lag, np.zeros(6)))
        worker.step(k * TICK)
    assert worker.phase is not Phase.BLOCKED

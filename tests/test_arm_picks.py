"""One arm picks a part off a belt by friction and places it in a slot: the whole mechanism.

The bench knows the part's true pose and velocity; only perception is left out.
"""

import numpy as np
import pytest
from arm_bench import PART_RADIUS, ArmBench

from twin.geometry import inverse, transform
from twin.plant.as_built import ARM_JOINT_ZERO
from twin.stack.control.arm_motion import Grasp

SLOTS = {0: (0.075, 0.12, 0.556), 1: (-0.135, -0.06, 0.556)}
PART_YAW = 0.4


def tcp_pose(bench):
    site = bench.data.site("arm/tcp")
    return transform(site.xmat.reshape(3, 3).copy(), site.xpos.copy())


def touching(bench):
    """Pairs of bodies in contact of which one is the arm's."""
    pairs = set()
    for c in bench.data.contact:
        names = sorted(bench.model.body(bench.model.geom_bodyid[g]).name for g in c.geom)
        if any(n.startswith("arm/") for n in names):
            pairs.add(tuple(names))
    return pairs


@pytest.mark.parametrize(("arm", "speed"), [(0, 0.0), (0, 0.15), (1, 0.05), (1, 0.5)])
def test_pick_and_place(arm, speed, record_property):
    high = (0.22, -0.10)[arm]
    x = (0.15, -0.30)[arm] if speed == 0.0 else high + 0.12 + speed * 2.0
    zero = np.random.default_rng(7).normal(0, ARM_JOINT_ZERO, 6)
    bench = ArmBench(arm, speed, (x, 0.46, PART_YAW), SLOTS[arm], zero)
    motion = bench.motion
    bench.grip(0.034)
    assert bench.run_until(motion.go_ready(0.0)) < 0.002

    T_base_part, velocity = bench.part_pose()
    rotation = inverse(bench.T_base_mount)[:3, :3]
    grasp = Grasp(
        bench.now,
        bench.to_mount(T_base_part[:3, 3]),
        rotation @ velocity,
        bench.mount_yaw(PART_YAW + np.pi / 2),
    )
    start, meet = bench.now, motion.earliest_meeting(bench.now, grasp)
    if speed > 0.0:
        meet = max(meet, bench.now + (x - speed * bench.now - high) / speed)
    waited = meet - motion.earliest_meeting(bench.now, grasp)
    times = motion.pick(bench.now, grasp, meet)
    bench.run_until(times.descend)
    descending = bench.run_until(times.close)
    intercept = np.linalg.norm((tcp_pose(bench)[:3, 3] - bench.part_pose()[0][:3, 3])[:2])
    assert not touching(bench)
    bench.grip(0.0)
    bench.run_until(times.lift)
    held = inverse(tcp_pose(bench)) @ bench.part_pose()[0]
    # 23.1 mm across the corners, less what the pads give.
    assert bench.gripper.width(bench.data) == pytest.approx(2.31 * PART_RADIUS, abs=0.0006)
    assert bench.gripper.force == pytest.approx(20.0, abs=1.0)

    motion.dynamics.set_payload(0.040)
    slot = np.array(SLOTS[arm])
    place = motion.place(bench.now, bench.to_mount(np.add(slot, [0, 0, PART_RADIUS + 0.0015])))
    allowed = {("arm/finger_left", "part"), ("arm/finger_right", "part")}
    carrying = 0.0
    while bench.now < place.open - 1e-6:
        carrying = max(carrying, bench.step())
        assert touching(bench) <= allowed
    slip = np.linalg.norm((inverse(tcp_pose(bench)) @ bench.part_pose()[0] - held)[:3, 3])
    bench.grip(0.036)
    motion.dynamics.set_payload(0.0)
    bench.run_until(place.done)
    bench.run_until(motion.go_ready(bench.now))
    cycle = bench.now - start - waited
    placed = bench.part_pose()[0][:3, 3] - slot

    for name, value in {
        "tracking_mm": 1e3 * max(descending, carrying),
        "intercept_mm": 1e3 * intercept,
        "slip_mm": 1e3 * slip,
        "cycle_s": cycle,
        "placed_mm": 1e3 * float(np.hypot(*placed[:2])),
    }.items():
        record_property(name, round(float(value), 3))
    assert descending < 0.0015 and carrying < 0.0015  # of which joint zeros about 0.5 mm
    assert intercept < 0.001
    assert slip < 0.0025  # see models/arm/README.md, "Held parts"
    assert cycle < 4.2
    assert np.hypot(*placed[:2]) < 0.003 and abs(placed[2] - PART_RADIUS) < 0.0005
    assert not bench.data.warning.number.any()

"""Drives of arm and gripper, and what their sensors report."""

import mujoco
import numpy as np
import pytest
from arm_bench import ArmBench

from twin.layout import models_dir
from twin.messages import ArmCommand
from twin.plant.actuators.arm_drive import MAX_TORQUE, RESOLUTION
from twin.plant.sensors.joints import ArmSensor, GripperSensor

AWAY = (0.9, 0.45, 0.0)  # the part, out of the way
SLOT = (0.06, 0.0, 0.556)


def test_model_steps_without_a_warning():
    model = mujoco.MjModel.from_xml_path(str(models_dir() / "arm" / "arm.xml"))
    data = mujoco.MjData(model)
    for _ in range(1000):
        mujoco.mj_step(model, data)
    assert not data.warning.number.any()
    assert 9.0 < model.body_mass.sum() < 12.0


def test_drive_closes_on_the_encoder_not_on_the_angle():
    zero = np.array([2e-3, -1e-3, 1.5e-3, 1e-3, -2e-3, 1e-3])
    bench = ArmBench(0, 0.0, AWAY, SLOT, zero)
    bench.run_until(0.5)
    reference = bench.motion.state(bench.now).q
    reading = ArmSensor(0, bench.drive).sample(bench.now, bench.model, bench.data)
    np.testing.assert_allclose(reading.position, reference, atol=3e-4)
    true = bench.data.qpos[bench.drive._qpos]
    np.testing.assert_allclose(reading.position - true, zero, atol=RESOLUTION)


def test_torque_is_limited_and_a_silent_stack_stops_the_arm():
    bench = ArmBench(0, 0.0, AWAY, SLOT)
    q = bench.motion.state(0.0).q
    bench.drive.command(ArmCommand(0, q - 0.4, np.full(6, 9.0), np.zeros(6)))
    for _ in range(200):
        bench.drive.apply(bench.data)
        assert (np.abs(bench.data.ctrl[:6]) <= MAX_TORQUE).all()
        mujoco.mj_step(bench.model, bench.data)
    for _ in range(500):
        bench.drive.apply(bench.data)
        mujoco.mj_step(bench.model, bench.data)
    assert np.abs(bench.data.qvel[bench.drive._dof]).max() < 0.05


def test_gripper_keeps_its_speed_and_its_force():
    bench = ArmBench(0, 0.0, AWAY, SLOT)
    bench.run_until(0.1)
    bench.grip(0.0, force=30.0)
    widths = []
    for _ in range(60):
        bench.step()
        widths.append(bench.gripper.width(bench.data))
    speed = -np.diff(widths) / 0.010
    assert speed.max() == pytest.approx(0.150, rel=0.1)
    assert abs(widths[-1]) < 1e-3  # pad on pad, or on the end stop
    bench.grip(0.040)
    bench.run_until(bench.now + 0.5)
    assert bench.gripper.width(bench.data) == pytest.approx(0.040, abs=5e-4)
    fingers = bench.data.qpos[bench.gripper._qpos]
    assert fingers[0] == pytest.approx(fingers[1], abs=5e-4)  # coupled


def test_gripper_sensor_counts_steps_and_is_seeded():
    bench = ArmBench(0, 0.0, AWAY, SLOT)
    one, two = (GripperSensor(0, bench.gripper, np.random.default_rng(5)) for _ in range(2))
    a = [one.sample(0.0, bench.model, bench.data) for _ in range(50)]
    b = [two.sample(0.0, bench.model, bench.data) for _ in range(50)]
    assert a == b
    assert np.std([r.force for r in a]) == pytest.approx(1.0, abs=0.4)
    assert np.mean([r.width for r in a]) == pytest.approx(0.050, abs=2e-4)

"""Mecanum kinematics: its algebra, and against the plant's rolling contact."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twin.geometry import between2, wrap_angle
from twin.layout import load_layout
from twin.messages import BodyVelocity
from twin.plant.actuators.wheel_drive import WheelDrive
from twin.plant.as_built import AsBuilt
from twin.plant.sensors.encoders import WheelEncoders
from twin.plant.world import World
from twin.stack.config import DriveLimits, Wheels
from twin.stack.control import mecanum
from twin.stack.control_unit import PERIOD, ControlUnit

WHEELS, LIMITS = Wheels(), DriveLimits()
EXACT = (
    "world.tolerances.scale=0",
    "world.tolerances.dock_xy=0",
    "world.tolerances.dock_yaw_deg=0",
)
speed = st.floats(-2, 2)


@given(speed, speed, speed)
def test_forward_inverts_inverse(vx, vy, omega):
    velocity = np.array([vx, vy, omega])
    speeds = mecanum.wheel_speeds(WHEELS, velocity)
    np.testing.assert_allclose(mecanum.body_velocity(WHEELS, speeds), velocity, atol=1e-12)


@given(st.lists(st.floats(-20, 20), min_size=4, max_size=4))
def test_forward_is_the_least_squares_solution(speeds):
    """Four wheels that disagree: the answer is the nearest motion."""
    matrix = mecanum.wheel_speeds(WHEELS, np.eye(3)).T
    best = np.linalg.lstsq(matrix, np.array(speeds), rcond=None)[0]
    np.testing.assert_allclose(mecanum.body_velocity(WHEELS, speeds), best, atol=1e-9)


@pytest.mark.parametrize(
    ("velocity", "signs"),
    [((1, 0, 0), "++++"), ((0, 1, 0), "-++-"), ((0, 0, 1), "-+-+")],
)
def test_wheels_turn_as_in_the_source(velocity, signs):
    """Li & An 2025, Fig. 7: forward, sideways (there to the right), turning."""
    speeds = mecanum.wheel_speeds(WHEELS, np.array(velocity, float))
    assert "".join("+" if s > 0 else "-" for s in speeds) == signs


@given(speed, speed, st.floats(-6, 6))
def test_limits_keep_the_direction(vx, vy, omega):
    wanted = np.array([vx, vy, omega])
    allowed = mecanum.within_limits(WHEELS, wanted)
    assert np.abs(mecanum.wheel_speeds(WHEELS, allowed)).max() <= WHEELS.max_wheel_speed + 1e-9
    np.testing.assert_allclose(np.cross(wanted, allowed), 0, atol=1e-9)


def drive(velocity, duration):
    """Ramp up, hold, ramp down in the free part of a wide hall.

    Returns:
        True velocities (n, 3) at the times (n,), and the pose reached, seen from the start.
    """
    wide = (
        "site.hall.x=[-6, 16]",
        "site.hall.y=[-6, 10]",
        "site.hall.partitions=[]",
        "site.racks=[]",
    )
    layout = load_layout(None, EXACT + wide)
    world = World(layout, AsBuilt.draw(np.random.default_rng(0), layout.world.tolerances), pool=1)
    encoders = WheelEncoders(world.model, np.random.default_rng(1))
    wheels, unit = WheelDrive(world.model), ControlUnit(WHEELS)
    world.data.qpos[:2] -= 2.5  # away from the dock's post
    # The arms' drives are not the subject: stiff joints hold them upright.
    held = [f"arm{a}/joint{j}" for a in range(2) for j in range(1, 7)]
    dofs = np.array([world.model.joint(name).dofadr[0] for name in held])
    world.model.dof_damping[dofs] = 1e4
    ramp = max(np.abs(velocity) / (LIMITS.acceleration, LIMITS.acceleration, 2.0))
    start, times, velocities = world.truth().pose, [], []
    for _ in range(round((duration + 0.5) / PERIOD)):
        share = np.clip(min(world.time, duration - world.time) / ramp, 0, 1)
        pwm, _ = unit.step(encoders.counts(world.data), BodyVelocity(*(share * velocity)))
        wheels.apply(world.data, pwm)
        world.step()
        times.append(world.time)
        velocities.append(world.truth().velocity)
    assert not world.collisions
    return np.array(times), np.array(velocities), between2(start, world.truth().pose)


@pytest.mark.parametrize(
    "velocity",
    [
        (LIMITS.speed, 0, 0),
        (-LIMITS.speed, 0, 0),
        (0, LIMITS.strafe_speed, 0),
        (0, -LIMITS.strafe_speed, 0),
        (0, 0, LIMITS.turn_rate),
        (0.4, 0.3, 0.0),
    ],
    ids=["forward", "backward", "left", "right", "turn", "diagonal"],
)
def test_plant_moves_as_commanded(velocity):
    """Expected result: within 2 % of the command by truth, and nothing across it."""
    velocity = np.array(velocity, float)
    times, truth, _ = drive(velocity, 3.2)
    steady = truth[(times > 1.5) & (times < 1.9)].mean(axis=0)
    np.testing.assert_allclose(steady, velocity, atol=0.02 * np.linalg.norm(velocity))


def test_full_turn_in_place():
    """Expected result: 360 degrees within 1 %, the centre within 5 mm of where it was."""
    rate = LIMITS.turn_rate
    _, _, reached = drive(np.array([0, 0, rate]), 2 * np.pi / rate + rate / 2.0)
    assert abs(wrap_angle(reached[2])) < 0.01 * 2 * np.pi
    assert np.hypot(*reached[:2]) < 0.005

"""The world: belt, collisions, truth, and failing loudly."""

import mujoco
import numpy as np
import pytest

from twin.geometry import between2
from twin.layout import load_layout
from twin.plant.actuators.wheel_drive import WheelDrive
from twin.plant.as_built import AsBuilt
from twin.plant.contacts import collision_kind
from twin.plant.world import PlantError, World


def cell(*overrides: str, pool: int = 1, seed: int = 0) -> World:
    layout = load_layout(None, overrides)
    return World(layout, AsBuilt.draw(np.random.default_rng(seed), layout.world.tolerances), pool)


def run(world: World, seconds: float) -> None:
    for _ in range(round(seconds / 0.002)):
        world.step()


@pytest.mark.parametrize("speed", [0.05, 0.15, 0.5])
def test_belt_carries_a_part_at_its_speed(speed):
    """Expected result: at rest on the belt within half a second, then no slip."""
    world = cell(f"belt_speed={speed}")
    world.place_part("part_sma_f_n_m_0", (3.55, 4.0, 0.7005), (1, 0, 0, 0))
    run(world, 0.5)
    start = world.truth()
    run(world, 1.0)
    i = start.part_names.index("part_sma_f_n_m_0")
    moved = world.truth().part_position[i] - start.part_position[i]
    np.testing.assert_allclose(moved, (0, -speed, 0), atol=0.002 * speed + 2e-5)


def test_part_that_passes_the_end_stays_in_the_bin():
    world = cell("belt_speed=0.5")
    for k, name in enumerate(world.part_names):
        x, y = 3.51 + 0.02 * k, 2.2 + 0.06 * k
        world.place_part(name, (x, y, 0.7005), (1, 0, 0, 0), (0, -0.5, 0))
    run(world, 3.0)
    truth = world.truth()
    assert (truth.part_position[:, 2] < 0.45).all()
    assert (np.abs(truth.part_position[:, 0] - 3.55) < 0.16).all()
    assert (np.linalg.norm(truth.part_velocity, axis=1) < 0.01).all()
    assert not world.collisions


def test_parts_in_the_store_sleep():
    world = cell(pool=9)
    run(world, 0.2)
    assert (world.truth().part_position[:, 2] < -0.9).all()
    assert world.data.ntree_awake == 1  # the vehicle with its arms


def test_vehicle_at_the_dock_touches_nothing():
    world = cell()
    run(world, 1.0)
    assert world.collisions == []
    assert np.hypot(*between2((0, 0, 0), world.truth().pose)[:2]) < 0.016


def test_vehicle_pushed_against_the_dock_is_one_collision():
    """Expected result: a touch counts once however long it lasts, and again after a gap."""
    world = cell()
    drive = WheelDrive(world.model)
    drive.apply(world.data, np.full(4, -0.15))
    run(world, 3.0)  # it may bounce before it settles
    first = len(world.collisions)
    assert first >= 1
    assert {c.kind for c in world.collisions} == {"agv-station"}
    run(world, 1.0)
    assert len(world.collisions) == first
    drive.apply(world.data, np.full(4, 0.15))
    run(world, 0.5)
    drive.apply(world.data, np.full(4, -0.15))
    run(world, 2.0)
    assert len(world.collisions) > first


def test_arm_forced_into_the_tray_is_a_collision():
    world = cell()
    model, data = world.model, world.data
    data.ctrl[model.actuator("arm0/motor1").id] = 20.0  # the arm's front turns to the rear
    data.ctrl[model.actuator("arm0/motor2").id] = 50.0
    for _ in range(1000):
        world.step()
        if world.collisions:
            break
    assert world.collisions
    assert world.collisions[0].kind in ("arm-agv", "arm-arm")
    assert "arm0/" in world.collisions[0].first + world.collisions[0].second


@pytest.mark.parametrize(
    ("first", "second", "kind"),
    [
        ("arm0", "arm1", "arm-arm"),
        ("arm1", "arm1", "arm-self"),
        ("tray", "arm0", "arm-agv"),
        ("agv", "arm1", "arm-agv"),
        ("line", "arm0", "arm-line"),
        ("floor", "arm0", "arm-hall"),
        ("part", "arm0", None),
        ("part", "line", None),
        ("part", "part", None),
        ("part", "tray", None),
        ("agv", "part", "agv-part"),
        ("floor", "roller", None),
        ("floor", "agv", "agv-hall"),
        ("line", "agv", "agv-line"),
        ("obstacle", "agv", "agv-obstacle"),
        ("obstacle", "arm1", "arm-obstacle"),
        ("obstacle", "station", None),
    ],
)
def test_what_counts_as_a_collision(first, second, kind):
    assert collision_kind(first, second) == kind
    assert collision_kind(second, first) == kind


def test_not_a_number_fails_the_run():
    world = cell()
    run(world, 0.01)
    world.data.qvel[0] = np.nan
    with pytest.raises(PlantError) as error:
        run(world, 0.01)
    assert "QPOS" in str(error.value)
    assert "\n" not in str(error.value)


def test_unknown_part_is_named():
    with pytest.raises(PlantError, match="part_nut_0"):
        cell().place_part("part_nut_0", (0, 0, 0), (1, 0, 0, 0))


def test_truth_belongs_to_its_time():
    """Positions that MuJoCo derives must not be a step older than the coordinates."""
    world = cell()
    WheelDrive(world.model).apply(world.data, np.full(4, 0.5))
    run(world, 0.5)
    truth, bodies = world.truth(), world.body_poses()[0]
    mujoco.mj_forward(world.model, world.data)
    np.testing.assert_allclose(truth.T_world_tcp, world.truth().T_world_tcp, atol=1e-12)
    np.testing.assert_allclose(bodies, world.body_poses()[0], atol=1e-12)
    assert truth.velocity[0] > 0.1


def test_same_seed_same_bits():
    states = []
    for _ in range(2):
        world = cell(seed=5)
        world.place_part("part_n_tee_fff_0", (3.55, 4.0, 0.705), (1, 0, 0, 0))
        WheelDrive(world.model).apply(world.data, np.array([0.3, 0.2, 0.1, 0.2]))
        run(world, 0.5)
        states.append((world.data.qpos.copy(), world.data.qvel.copy()))
    np.testing.assert_array_equal(states[0][0], states[1][0])
    np.testing.assert_array_equal(states[0][1], states[1][1])


def test_shapes_are_plain_and_complete():
    world = cell()
    shapes = world.shapes
    assert {s.group for s in shapes} == {0, 1, 2, 4}
    assert all(s.size.shape == (3,) and s.rgba.shape == (4,) for s in shapes)
    assert all(s.vertices is not None and s.faces is not None for s in shapes if s.kind == "mesh")
    positions, quats = world.body_poses()
    assert positions.shape == (world.model.nbody, 3)
    np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1)

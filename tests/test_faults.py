"""Faults: each does to the plant what it says, honestly, when it says, and is logged."""

import numpy as np
import pytest
from faults_rig import Rig

from twin.layout import LayoutError
from twin.plant.faults import CLEAR
from twin.plant.mover import GAP
from twin.plant.obstacles import MOVER_OUTLINE, OUTLINE
from twin.plant.sensors.rendering import RenderWorker
from twin.plant.sensors.rgbd import HEIGHT, WIDTH, RgbdCamera

FLOOR_CLEAR = 'obstacles=[{{kind = "{}", pose = [{}, {}, {}], appears = {}, near = {}}}]'


def obstacle(kind="carton", x=2.0, y=0.0, yaw=0.0, appears=0.0, near=0.0) -> str:
    return "world.faults." + FLOOR_CLEAR.format(kind, x, y, yaw, appears, near)


def kidnap(at: float, x: float, y: float, yaw: float) -> str:
    return f"world.faults.kidnaps=[{{at = {at}, pose = [{x}, {y}, {yaw}]}}]"


def mover(path: str, speed: float = 0.5, starts: float = 0.0) -> str:
    return f"world.faults.movers=[{{path = {path}, speed = {speed}, starts = {starts}}}]"


def kinds(rig: Rig) -> list[str]:
    return [event.kind for event in rig.faults.log]


# --- wet floor ------------------------------------------------------------------------------------


def braked(*overrides: str) -> Rig:
    rig = Rig(*overrides)
    rig.drive(2.9, vx=0.9)
    rig.drive(1.6)
    return rig


def test_wheels_slip_where_the_floor_is_wet():
    """Expected result: brakes lock the wheels on the patch; odometry is right on a dry floor."""
    dry = braked()
    wet = braked("world.faults.wet=[{x = [1.6, 4.0], y = [-1.0, 1.0], friction = 0.04}]")
    beside = braked("world.faults.wet=[{x = [1.6, 4.0], y = [1.0, 2.0], friction = 0.04}]")
    assert np.abs((dry.odometry.pose - dry.pose)[:2]).max() < 0.01
    assert wet.pose[0] - wet.odometry.pose[0] > 0.2  # it slid on
    np.testing.assert_array_equal(beside.pose, dry.pose)
    assert wet.world.collisions == []


def test_each_wheel_has_the_friction_of_the_floor_under_it():
    """Expected result: the left wheels wet, the right ones dry; the wettest patch counts."""
    patch = "{x = [-1.0, 1.0], y = [0.0, 1.0], friction = 0.05}"
    puddle = "{x = [0.0, 1.0], y = [0.0, 1.0], friction = 0.02}"
    rig = Rig(f"world.faults.wet=[{patch}, {puddle}]")
    model = rig.world.model
    rig.tick()

    def friction(wheel: str) -> set[float]:
        names = [model.geom(g).name for g in range(model.ngeom)]
        mine = [g for g, name in enumerate(names) if name.startswith(f"agv/roller_{wheel}_")]
        assert len(mine) == 12
        return set(model.geom_friction[mine, 0])

    assert [friction(w) for w in ("fl", "fr", "rl", "rr")] == [{0.02}, {0.7}, {0.05}, {0.7}]
    rig.drive(3.0, vy=-0.4)
    assert all(friction(w) == {0.7} for w in ("fl", "fr", "rl", "rr"))


# --- obstacles ------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", OUTLINE)
@pytest.mark.parametrize("appears", [0.0, 0.1])
def test_running_into_an_obstacle_counts_once(kind, appears):
    """Expected result: contact is felt, and counted under the name of what was hit."""
    rig = Rig(obstacle(kind, x=1.1, y=0.05, yaw=1.5707963, appears=appears))
    rig.drive(0.2)
    rig.drive(2.0, vx=0.5)
    assert rig.world.collisions, "nothing was felt"
    first = rig.world.collisions[0]
    assert first.kind == "agv-obstacle"
    assert "obstacle_0/" in first.first + first.second


@pytest.mark.parametrize("kind", OUTLINE)
def test_outlines_are_those_of_the_models(kind):
    rig = Rig(obstacle(kind))
    model, data = rig.world.model, rig.world.data
    solid = [g for g in range(model.ngeom)
             if model.geom(g).name.startswith("obstacle_0/") and model.geom_contype[g]]  # fmt: skip
    half = model.geom_size[solid].copy()
    if kind == "pillar":
        half[:] = half[:, [0, 0, 1]]  # radius and half length
    half = np.einsum("gij,gj->gi", np.abs(data.geom_xmat[solid].reshape(-1, 3, 3)), half)
    middle = data.geom_xpos[solid]
    size = (middle + half).max(axis=0) - (middle - half).min(axis=0)
    assert np.all(size[:2] < np.add(OUTLINE[kind], 1e-9))
    np.testing.assert_allclose(size[:2], OUTLINE[kind], atol=0.002)
    assert (middle - half)[:, 2].min() == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("kind", OUTLINE)
def test_late_obstacle_stands_where_it_is_put(kind):
    """Expected result: out of sight and asleep, then on the floor, at rest, and asleep again."""
    rig = Rig(obstacle(kind, x=2.0, y=0.3, yaw=0.4, appears=0.5))
    body = rig.world.model.body("obstacle_0/" + kind).id
    rig.drive(0.4)
    assert rig.world.data.xpos[body, 2] < -2.0
    assert rig.world.data.ntree_awake == 1  # the vehicle
    rig.drive(1.6)
    np.testing.assert_allclose(rig.world.data.xpos[body], (2.0, 0.3, 0.0), atol=0.002)
    x, y = rig.world.data.xmat[body].reshape(3, 3)[:2, 0]
    assert np.arctan2(y, x) == pytest.approx(0.4, abs=0.005)
    assert rig.world.data.ntree_awake == 1
    (event,) = rig.faults.log
    assert (event.kind, event.name) == ("placed", "obstacle_0")
    assert event.stamp == pytest.approx(0.5, abs=0.011)
    assert event.pose == (2.0, 0.3, 0.4)
    assert rig.world.collisions == []


def test_obstacle_appears_when_the_vehicle_is_near():
    rig = Rig(obstacle(x=3.0, near=1.5))
    while not rig.faults.log and rig.world.time < 5.0:
        rig.drive(0.01, vx=0.5)
    assert kinds(rig) == ["placed"]
    assert 3.0 - rig.pose[0] == pytest.approx(1.5, abs=0.02)


def test_nobody_puts_an_obstacle_into_the_vehicle_nor_right_before_it():
    """Expected result: it waits, says so once, and comes when the vehicle has gone by."""
    rig = Rig(obstacle(x=1.5, appears=2.2))
    rig.drive(2.1, vx=0.7)
    for _ in range(300):
        rig.drive(0.01, vx=0.7)
        if "placed" in kinds(rig):
            break
    assert kinds(rig) == ["waits", "placed"]
    assert "vehicle" in rig.faults.log[0].because
    assert rig.pose[0] - 0.35 - CLEAR > 1.5 + 0.2  # well past it
    rig.drive(0.5)
    assert rig.world.collisions == []


def test_obstacle_waits_until_another_has_left_its_place():
    first = '{kind = "carton", pose = [2.0, 0.0, 0.0]}'
    second = '{kind = "pillar", pose = [2.1, 0.0, 0.0], appears = 0.1}'
    rig = Rig(f"world.faults.obstacles=[{first}, {second}]")
    rig.drive(0.5)
    assert kinds(rig) == ["waits"]
    assert rig.faults.log[0].because.startswith("obstacle_0/")


def test_late_obstacle_can_be_pushed():
    rig = Rig(obstacle("carton", x=1.1, appears=0.05))
    rig.drive(3.0, vx=0.5)
    body = rig.world.model.body("obstacle_0/carton").id
    assert rig.world.data.xpos[body, 0] > 1.3


# --- mover ----------------------------------------------------------------------------------------


def cart(rig: Rig) -> np.ndarray:
    return rig.world.data.xpos[rig.world.model.body("mover_0/cart").id, :2].copy()


def test_mover_goes_to_and_fro_along_its_path():
    rig = Rig(mover("[[2.0, -1.0], [2.0, 0.5], [3.0, 0.5]]", speed=0.8, starts=0.3))
    rig.drive(0.3)
    np.testing.assert_allclose(cart(rig), (2.0, -1.0), atol=1e-6)
    track = []
    for _ in range(850):
        rig.tick()
        track.append(cart(rig))
    track = np.array(track)
    for end in ((2.0, 0.5), (3.0, 0.5), (2.0, -1.0)):
        assert np.linalg.norm(track - end, axis=1).min() < 0.1
    off = np.minimum(np.abs(track[:, 0] - 2.0), np.abs(track[:, 1] - 0.5))
    assert off.max() < 0.08  # corners are cut by this much
    pace = np.linalg.norm(np.diff(track, axis=0), axis=1)
    assert np.median(pace) == pytest.approx(0.008, rel=0.1)
    assert rig.world.collisions == []


def test_mover_stops_before_a_vehicle_that_stands():
    """Expected result: it stands at its gap, and goes on when the vehicle has left."""
    rig = Rig(mover("[[2.0, 0.1], [-0.1, 0.1]]", speed=1.0))
    rig.drive(3.0)
    gap = cart(rig)[0] - MOVER_OUTLINE[0] / 2 - (rig.pose[0] + 0.35)
    assert GAP - 0.03 < gap < GAP + 0.10
    stood = cart(rig)[0]
    rig.drive(0.5, vy=0.5)
    assert cart(rig)[0] == pytest.approx(stood, abs=0.01)
    rig.drive(1.8, vy=0.5)
    assert cart(rig)[0] < stood - 0.2
    assert rig.world.collisions == []


def test_mover_does_not_run_into_a_vehicle_that_moves():
    """Expected result: coming faster from behind it brakes, and falls in behind the vehicle."""
    rig = Rig(mover("[[0.0, -1.2], [0.0, 3.0]]", speed=1.0))
    rig.drive(5.0, vy=0.3)
    assert rig.world.collisions == []
    assert cart(rig)[1] > 0.3


def test_mover_does_not_make_room():
    """Expected result: a vehicle that drives on towards it, or into its side, hits it."""
    for path in ("[[3.0, 0.0], [1.0, 0.0]]", "[[1.2, -1.2], [1.2, 0.5]]"):
        rig = Rig(mover(path))
        rig.drive(4.0, vx=0.4)
        assert {c.kind for c in rig.world.collisions} == {"agv-obstacle"}


# --- kidnapping -----------------------------------------------------------------------------------


def test_vehicle_is_carried_away():
    """Expected result: elsewhere at once, at rest, wheels not turned by it, and it can go on."""
    rig = Rig(kidnap(1.5, 7.35, 3.65, 1.2))
    rig.drive(1.5, vx=0.5)
    ticks = rig.wheel_state.ticks.copy()
    before = rig.world.base_height()
    rig.faults.step()
    pose, velocity = rig.world.base_motion()
    np.testing.assert_allclose(pose, (7.35, 3.65, 1.2), atol=1e-9)
    np.testing.assert_array_equal(velocity, 0.0)
    assert rig.world.base_height() == before
    rig.tick()
    assert np.abs(rig.wheel_state.ticks - ticks).max() < 100
    assert kinds(rig) == ["kidnapped"] and rig.faults.log[0].stamp == pytest.approx(1.5, abs=0.011)
    rig.drive(2.0, vx=0.5)
    assert rig.pose[1] > 3.65 + 0.5
    assert rig.world.collisions == []


def test_nobody_carries_the_vehicle_into_something():
    """Expected result: it waits while an obstacle stands there."""
    rig = Rig(obstacle(x=7.35, y=3.65), kidnap(0.1, 7.6, 3.65, 0.0))
    rig.drive(0.5)
    assert kinds(rig) == ["waits"]
    assert rig.faults.log[0].because.startswith("obstacle_0/")
    assert abs(rig.pose[0]) < 0.01


def test_a_run_may_decide_to_carry_the_vehicle():
    rig = Rig()
    rig.drive(0.1)
    rig.faults.carry_off((11.0, 3.65, 0.5))
    rig.drive(0.1)
    np.testing.assert_allclose(rig.pose, (11.0, 3.65, 0.5), atol=0.001)
    assert kinds(rig) == ["kidnapped"]


# --- what the depth camera sees of it -------------------------------------------------------------


@pytest.mark.parametrize(("kind", "height"), [("black_panel", 0.6), ("glass_panel", 0.6),
                                              ("low_box", 0.10), ("table", 0.69)])  # fmt: skip
def test_depth_camera_sees_what_the_lidar_misses(kind, height):
    """Expected result: depth of the near face, 1.5 m ahead of the camera, at that height."""
    rig = Rig(obstacle(kind, x=1.835 + OUTLINE[kind][1] / 2, yaw=1.5707963))
    worker = RenderWorker(rig.world.model)
    try:
        camera = RgbdCamera(worker, np.random.default_rng(0), 0.0)
        frame = camera.sample(0.0, rig.world.model, rig.world.data).result()
    finally:
        worker.close()
    focal = 0.5 * HEIGHT / np.tan(np.radians(58) / 2)
    row = round(HEIGHT / 2 + focal * (0.62 - height) / 1.5)
    seen = frame.depth_mm[row - 2 : row + 3, WIDTH // 2 - 20 : WIDTH // 2 + 20]
    assert np.median(seen[seen > 0]) == pytest.approx(1500, abs=70)


# --- all together ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("override", "said"),
    [
        (obstacle(x=0.2), "obstacles.0: overlaps the vehicle at its dock"),
        (obstacle(x=15.1), "obstacles.0: reaches outside the hall"),
        (obstacle(x=9.3, y=0.5, appears=1.0), "obstacles.0: overlaps the rack 1"),
        (mover("[[7.35, 0.5], [10.0, 0.5]]"), "movers.0: overlaps the rack 1"),
        (mover("[[7.35, 0.5], [7.35, 0.5]]"), "a point stands there twice"),
        (kidnap(1.0, 6.5, 3.0, 0.0), "kidnaps.0: overlaps the partition 0"),
    ],
)
def test_faults_that_cannot_come_about_are_refused(override, said):
    with pytest.raises(LayoutError, match=said) as error:
        Rig(override)
    assert "\n" not in str(error.value)


def test_same_faults_same_bits():
    faults = (
        obstacle("table", x=2.5, near=2.0),
        mover("[[1.5, 0.8], [3.0, 0.8]]"),
        "world.faults.wet=[{x = [0.3, 2.0], y = [-1.0, 0.0]}]",
        kidnap(1.5, 11.0, 3.65, -1.0),
    )
    states = []
    for _ in range(2):
        rig = Rig(*faults)
        rig.drive(2.5, vx=0.6)
        states.append(rig.world.data.qpos.copy())
        assert kinds(rig) == ["placed", "kidnapped"]
    np.testing.assert_array_equal(*states)

"""Warehouse: what a cut at the lidar's height finds is what is drawn; racks, orders, collisions."""

from itertools import combinations

import mujoco
import numpy as np
import pytest
from flat_world import box, cast

from twin.floor_plan import RACK, STAND, rack_stop
from twin.floor_sections import sections
from twin.geometry import compose2, pose2_to_transform, quat_wxyz
from twin.layout import load_layout
from twin.messages import DriveOrder, Goal, MapOrder, Order, TransportOrder
from twin.plant.as_built import AsBuilt
from twin.plant.hall import WALL_HEIGHT
from twin.plant.plant import Plant
from twin.plant.sensors.lidar import LidarSensor
from twin.plant.warehouse import RACK_YAW
from twin.plant.world import World

EXACT = (
    "world.tolerances.scale=0",
    "world.tolerances.dock_xy=0",
    "world.tolerances.dock_yaw_deg=0",
)
LAYOUT = load_layout(None, EXACT)
SITE = LAYOUT.site
LIDAR_HEIGHT = 0.18
FACE = 0.70  # m, on which goods are set down


@pytest.fixture(scope="module")
def world() -> World:
    built = AsBuilt.draw(np.random.default_rng(0), LAYOUT.world.tolerances)
    return World(LAYOUT, built, pool=1)


def put(world: World, pose) -> None:
    quat = quat_wxyz(pose2_to_transform(pose)[:3, :3])
    world.place("agv/base", (*pose[:2], world.base_height()), quat)
    world.refresh()


def drawn_segments():
    """Edges of all that the drawing has at the lidar's height. Shape (n, 2, 2)."""
    (x0, x1), (y0, y1) = SITE.hall.x, SITE.hall.y
    corners = [np.array(b) for boxes in sections(SITE, LIDAR_HEIGHT).values() for b in boxes]
    edges = [np.stack([c, np.roll(c, -1, axis=0)], axis=1) for c in corners]
    return np.concatenate([box(x0, y0, x1, y1), *edges])


@pytest.mark.parametrize(
    "pose",
    [(2.0, 0.0, 0.0), (5.2, 7.05, 0.0), (7.35, 3.65, 0.3), (11.0, 1.55, 1.2), (14.55, 3.65, 3.0)],
)
def test_lidar_meets_what_is_drawn(world, pose):
    """Expected result: every beam to a millimetre, but for those that graze an edge."""
    put(world, pose)
    scan = LidarSensor(world.model, np.random.default_rng(0), None, 0.0).sample(
        0.0, world.model, world.data
    )
    eye = compose2(pose, (0.3, 0.0, 0.0))
    angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    error = np.abs(scan.ranges - cast(drawn_segments(), eye, angles))
    assert np.isfinite(scan.ranges).all()
    assert (error < 0.002).mean() > 0.99


def test_where_goods_are_set_down_is_level_and_free(world):
    """Expected result: the face at 0.70 m along the front of each rack, and on the whole stand."""
    spots = [compose2(r.pose, (x, y - RACK[1] / 2, 0)) for r in SITE.racks
             for x in np.linspace(-1.15, 1.15, 12) for y in (0.07, 0.19)]  # fmt: skip
    x, y, length, width = STAND
    spots += [compose2(SITE.goods_in, (x + k * length, y + j * width, 0))
              for k in (-0.45, 0.0, 0.45) for j in (-0.45, 0.45)]  # fmt: skip
    hit = np.zeros(1, np.int32)
    for spot in spots:
        above = np.array([*spot[:2], 2.0])
        depth = mujoco.mj_ray(
            world.model, world.data, above, np.array([0, 0, -1.0]), None, True, -1, hit
        )
        assert 2.0 - depth == pytest.approx(FACE, abs=1e-6), world.model.geom(hit[0]).name


def geoms_of(world: World, prefix: str) -> list[int]:
    m = world.model
    return [g for g in range(m.ngeom) if m.geom(g).name.startswith(prefix)]


def test_racks_are_alike_but_for_their_number(world):
    m = world.model
    first, *others = [geoms_of(world, f"rack{r.number}/") for r in SITE.racks]
    plates = set()
    for rack in (first, *others):
        assert len(rack) == len(first) <= 16  # software rendering pays for each
        np.testing.assert_array_equal(m.geom_pos[rack], m.geom_pos[first])
        np.testing.assert_array_equal(m.geom_size[rack], m.geom_size[first])
        plate = next(g for g in rack if m.geom(g).name.endswith("/plate"))
        texture = m.mat_texid[m.geom_matid[plate], mujoco.mjtTextureRole.mjTEXROLE_RGB]
        begin = m.tex_adr[texture]
        end = begin + m.tex_width[texture] * m.tex_height[texture] * m.tex_nchannel[texture]
        plates.add(m.tex_data[begin:end].tobytes())
    assert len(plates) == len(SITE.racks)


def test_racks_stand_apart_and_inside_the_hall(world):
    boxes = []
    for rack in SITE.racks:
        ids = geoms_of(world, f"rack{rack.number}/")
        solid = [g for g in ids if world.model.geom_contype[g]]
        half, middle = world.model.geom_size[solid], world.data.geom_xpos[solid]
        boxes.append(((middle - half).min(axis=0), (middle + half).max(axis=0)))
        assert boxes[-1][1][2] < 1.05
        np.testing.assert_allclose(boxes[-1][1][:2] - boxes[-1][0][:2], RACK, atol=1e-6)
    for (low, high), (low2, high2) in combinations(boxes, 2):
        gap = np.maximum(low2 - high, low - high2)[:2].max()
        assert gap > 0.7  # a vehicle wide at least: 0.5 m


def test_partitions_are_as_high_as_the_walls(world):
    walls = geoms_of(world, "wall_")
    assert len(walls) == 4 + len(SITE.hall.partitions)
    top = world.data.geom_xpos[walls, 2] + world.model.geom_size[walls, 2]
    np.testing.assert_allclose(top, WALL_HEIGHT)


def test_racks_stand_off_the_drawing_by_their_tolerance():
    layout = load_layout()
    off = []
    for seed in range(6):
        built = AsBuilt.draw(np.random.default_rng(seed), layout.world.tolerances)
        world = World(layout, built, pool=1)
        for rack in layout.site.racks:
            frame = world.data.xpos[world.model.body(f"rack{rack.number}/rack").id]
            R = world.data.xmat[world.model.body(f"rack{rack.number}/rack").id]
            yaw = np.arctan2(R[3], R[0])
            off.append((*(frame[:2] - rack.pose[:2]), yaw - rack.pose[2]))
    sigma = np.std(off, axis=0)
    np.testing.assert_allclose(sigma[:2], layout.world.tolerances.rack_xy, rtol=0.35)
    assert sigma[2] == pytest.approx(RACK_YAW, rel=0.35)


@pytest.mark.parametrize("rack", SITE.racks, ids=lambda r: f"rack{r.number}")
def test_vehicle_stands_free_before_each_rack(world, rack):
    pose = rack_stop(rack.pose)
    quat = quat_wxyz(pose2_to_transform(pose)[:3, :3])
    assert world.would_touch("agv/base", (*pose[:2], 0.0), quat) == ()
    closer = compose2(pose, (0.0, 0.13, 0.0))
    touched = world.would_touch("agv/base", (*closer[:2], 0.0), quat)
    assert touched and all(name.startswith(f"rack{rack.number}/") for name in touched)


@pytest.mark.parametrize(
    ("pose", "kind", "name"),
    [
        ((9.3, 1.92, 1.5707963), "agv-station", "rack2/"),
        ((6.05, 3.0, 0.0), "agv-hall", "wall_partition_0"),
        ((5.2, 6.95, 1.5707963), "agv-station", "goods_in/"),
    ],
)
def test_running_into_the_warehouse_counts(pose, kind, name):
    """Expected result: one collision a touch, named after what was hit."""
    built = AsBuilt.draw(np.random.default_rng(0), LAYOUT.world.tolerances)
    world = World(LAYOUT, built, pool=1)
    put(world, pose)
    world.data.qvel[:2] = 0.4 * np.array([np.cos(pose[2]), np.sin(pose[2])])
    wheels = [world.model.actuator(f"agv/wheel_{w}").id for w in ("fl", "fr", "rl", "rr")]
    world.data.ctrl[wheels] = 10.0
    for _ in range(500):
        world.step()
        if world.collisions:
            break
    assert [c.kind for c in world.collisions] == [kind]
    assert any(n.startswith(name) for n in (world.collisions[0].first, world.collisions[0].second))


@pytest.mark.parametrize(
    "order",
    [
        DriveOrder(-1.0, (Goal("W1", (7.35, 1.55, 0.0)),)),
        MapOrder(-1.0, (Goal("W1", (7.35, 1.55, 0.0)),)),
        TransportOrder(-1.0),
        Order(-1.0, (("sma_f_n_m", 2),)),
    ],
    ids=lambda order: type(order).__name__,
)
def test_the_desk_sends_the_order_that_it_is_given(order):
    """Expected result: it comes once, stamped by the desk; parts come with an order for parts."""
    plant = Plant(load_layout(None, ("world.feeder.rate=3.0",)), 0, order)
    try:
        got = []
        for _ in range(1000):
            plant.step(np.zeros(4))
            got += [r for r in plant.readings() if isinstance(r, type(order))]
        assert len(got) == 1 and got[0].stamp >= 0.0
        if isinstance(order, DriveOrder | MapOrder):
            assert got[0].goals == order.goals
        fed = [event for event in plant.feeder.log if event.kind == "fed"]
        assert bool(fed) == isinstance(order, Order)
        assert plant.world.collisions == []
    finally:
        plant.close()

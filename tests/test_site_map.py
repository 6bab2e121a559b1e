"""Maps of the drawing against rays cast in the compiled model, and map files that are broken."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

from twin.floor_plan import machines
from twin.geometry import transform
from twin.layout import load_layout
from twin.plant.as_built import AsBuilt
from twin.plant.sensors.lidar import LidarSensor
from twin.plant.world import World
from twin.stack.config import StackConfig
from twin.stack.estimation.map_file import save_map
from twin.stack.estimation.occupancy_grid import OccupancyGrid
from twin.stack.estimation.site_map import floor_map, lidar_map, load_site_map

EXACT = tuple(
    f"world.tolerances.{name}=0"
    for name in ("scale", "dock_xy", "dock_yaw_deg", "rack_xy", "tag_xy", "tag_yaw_deg")
)
LAYOUT = load_layout(None, EXACT)
CONFIG = StackConfig(site=LAYOUT.site, options=LAYOUT.options)
# In the open, beside the line, in the aisles, at goods-in.
PLACES = [(2.0, 1.5, 0.3), (4.8, 2.0, 2.0), (3.0, -0.6, -1.0), (9.3, 1.55, 0.0),
          (12.7, 3.65, 3.1), (14.55, 5.0, -1.6), (7.35, 7.3, 1.0), (5.6, 6.3, 2.5)]  # fmt: skip


@pytest.fixture(scope="module")
def world() -> World:
    return World(LAYOUT, AsBuilt.draw(np.random.default_rng(0), LAYOUT.world.tolerances), pool=1)


def ends(world, place):
    """End points in world of an exact scan from a place, without the vehicle going there."""
    data = world.data
    start = data.qpos[:7].copy()
    base = world.model.joint("agv/base").qposadr[0]
    start = data.qpos[base : base + 7].copy()
    data.qpos[base : base + 7] = (*place[:2], start[2], *_quat(place[2]))
    world.refresh()
    sensor = LidarSensor(world.model, np.random.default_rng(0), None, 0.0)
    scan = sensor.sample(0.0, world.model, data)
    site = data.site("agv/lidar")
    T = transform(site.xmat.reshape(3, 3).copy(), site.xpos.copy())
    data.qpos[base : base + 7] = start
    world.refresh()
    angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    seen = np.isfinite(scan.ranges)
    r, a = scan.ranges[seen], angles[seen]
    return (np.stack([r * np.cos(a), r * np.sin(a), 0 * r], 1) @ T[:3, :3].T + T[:3, 3])[:, :2]


def _quat(yaw):
    return np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)


@pytest.mark.parametrize("place", PLACES)
def test_every_beam_of_an_exact_lidar_ends_on_the_map(world, place):
    drawn = lidar_map(LAYOUT.site, CONFIG.T_base_lidar)
    points = ends(world, place)
    assert len(points) > 900
    off = distances(points, drawn.surfaces)
    # The vehicle stands as its wheels settle, a fraction of a millimetre low; ranges are rounded.
    worst = points[np.argmax(off)]
    assert off.max() < 0.004, f"{np.mean(off > 0.004):.3f} of the beams, such as at {worst}"


def test_every_machine_is_seen_by_some_beam(world):
    """No surface of the map stands where nothing is."""
    drawn = lidar_map(LAYOUT.site, CONFIG.T_base_lidar)
    points = np.concatenate([ends(world, place) for place in PLACES])
    ways = drawn.surfaces.reshape(-1, 4, 4)  # four sides of a box
    nearest = np.array([distances(points, box).min() for box in ways])
    assert np.mean(nearest < 0.003) > 0.9


def distances(points, segments):
    a, d = segments[:, :2], segments[:, 2:] - segments[:, :2]
    rest = points[:, None] - a
    share = np.clip(np.sum(rest * d, -1) / np.sum(d * d, -1), 0, 1)
    return np.linalg.norm(rest - share[..., None] * d, axis=-1).min(axis=1)


def test_field_of_the_drawing_is_exact():
    drawn = lidar_map(LAYOUT.site, CONFIG.T_base_lidar)
    field = drawn.likelihood_field(1.0)
    rng = np.random.default_rng(0)
    cells = np.argwhere(drawn.free)[rng.integers(0, drawn.free.sum(), 300)]
    centres = drawn.origin + (cells[:, ::-1] + 0.5) * drawn.resolution
    exact = np.minimum(distances(centres, drawn.surfaces), 1.0)
    np.testing.assert_allclose(field.lookup(centres), exact, atol=1e-6)


def test_floor_map_holds_whole_outlines_and_nothing_else():
    drawn = floor_map(LAYOUT.site)
    assert drawn.states.dtype == np.int8 and set(np.unique(drawn.states)) == {-1, 0, 100}
    inside = 0
    for boxes in machines(LAYOUT.site).values():
        for box in boxes:
            row, column = drawn.cells(np.mean(box, axis=0))
            assert drawn.states[row, column] == 100
            size = np.ptp(np.array(box), axis=0)
            inside += np.prod(np.ceil(size / drawn.resolution) + 1)
    assert np.sum(drawn.occupied) < inside + 2 * sum(drawn.states.shape)
    for tag in LAYOUT.site.tags:
        row, column = drawn.cells(tag.pose[:2])
        assert drawn.free[row, column]
    for x, y in ((-1.03, 0.0), (15.22, 3.0), (3.0, 8.03)):  # in the walls
        assert drawn.occupied[tuple(drawn.cells((x, y)))]
    assert drawn.states[0, 0] == drawn.states[-1, -1] == -1


def test_the_lidar_sees_through_racks_where_the_vehicle_cannot_pass():
    rack = LAYOUT.site.racks[0].pose
    seen, floor = lidar_map(LAYOUT.site, CONFIG.T_base_lidar), floor_map(LAYOUT.site)
    middle = (rack[0] + 0.6, rack[1])
    assert seen.free[tuple(seen.cells(middle))] and floor.occupied[tuple(floor.cells(middle))]


def test_room_keeps_off_by_the_radius():
    drawn = floor_map(LAYOUT.site)
    room = drawn.room(0.25)
    assert room[tuple(drawn.cells((9.3, 1.55)))]
    assert not room[tuple(drawn.cells((9.3, 0.95)))]  # 0.15 m off the rack
    assert 0.3 * drawn.free.sum() < room.sum() < 0.9 * drawn.free.sum()


def test_turned_boxes_fill_the_cells_they_reach():
    turned = LAYOUT.site.model_copy(update={"hall": LAYOUT.site.hall.model_copy(
        update={"partitions": ((1.0, 2.0, 2.0, 3.0),)})})  # fmt: skip
    drawn = floor_map(turned)
    for s in np.linspace(0.03, 0.97, 21):
        assert drawn.occupied[tuple(drawn.cells((1.0 + s, 2.0 + s)))]
    assert (
        drawn.free[tuple(drawn.cells((1.5, 2.35)))] and drawn.free[tuple(drawn.cells((1.1, 2.9)))]
    )


HALL = SimpleNamespace(hall=SimpleNamespace(x=(-1.0, 1.0), y=(2.0, 3.5)))  # 40 x 30 cells


def test_map_file_there_and_back(tmp_path):
    log_odds = np.zeros((30, 40), dtype=np.float32)
    log_odds[5:20, 5:30], log_odds[5, 5:30] = -3.0, 3.0
    save_map(OccupancyGrid(np.array([-1.0, 2.0]), 0.05, log_odds), tmp_path / "m.yaml")
    read = load_site_map(tmp_path / "m.yaml", HALL)
    assert read.occupied.sum() == 25 and read.free.sum() == 14 * 25
    np.testing.assert_allclose(read.origin, (-1.0, 2.0))
    assert read.likelihood_field(1.0).distances.shape == (30, 40)


@pytest.mark.parametrize(
    "broken", ["truncated", "larger", "missing", "nothing free", "no room", "nothing there"]
)
def test_a_broken_map_file_is_refused_in_one_line(tmp_path, broken):
    log_odds = np.full((30, 40), 3.0 if broken == "nothing free" else -3.0, dtype=np.float32)
    if broken == "no room":
        log_odds[::8] = log_odds[:, ::8] = 3.0
    save_map(OccupancyGrid(np.array([-1.0, 2.0]), 0.05, log_odds), tmp_path / "m.yaml")
    pgm = tmp_path / "m.pgm"
    if broken == "truncated":
        pgm.write_bytes(pgm.read_bytes()[:-7])
    elif broken == "larger":
        pgm.write_bytes(pgm.read_bytes().replace(b"40 30", b"41 30"))
    elif broken == "missing":
        pgm.unlink()
    with pytest.raises(ValueError, match=r"m\.(pgm|yaml)") as error:
        load_site_map(tmp_path / "m.yaml", HALL)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "origin, resolution, said",
    [
        ((-1.0, 2.0), 1e-4, "resolution 0.0001 m, wanted 0.01 to 0.2"),
        ((-1.0, 2.0), 5.0, "resolution 5.0 m"),
        ((-1.0, 2.0), 0.02, "of another hall: x from -1.00 to -0.20 m, drawn is -1.00 to 1.00 m"),
        ((-1.0, 2.0), 0.19, "of another hall: x from -1.00 to 6.60"),
        ((-1.0, -9.0), 0.05, "of another hall: y from -9.00"),
    ],
)
def test_a_map_of_another_hall_is_refused_in_one_line(tmp_path, origin, resolution, said):
    log_odds = np.full((30, 40), -3.0, dtype=np.float32)
    save_map(OccupancyGrid(np.array(origin), resolution, log_odds), tmp_path / "m.yaml")
    with pytest.raises(ValueError, match=re.escape(said)) as error:
        load_site_map(tmp_path / "m.yaml", HALL)
    assert "\n" not in str(error.value)

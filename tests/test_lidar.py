"""Lidar in the default plant: it sees what is drawn, never the vehicle, and misreads some."""

import numpy as np
import pytest

from twin.geometry import rot_z, transform
from twin.layout import load_layout
from twin.plant.as_built import AsBuilt
from twin.plant.sensors.lidar import BLACK_RANGE, NOISE, OFFSET, RANGE_FAR, LidarSensor
from twin.plant.world import World
from twin.stack.config import StackConfig

EXACT = (
    "world.tolerances.scale=0",
    "world.tolerances.dock_xy=0",
    "world.tolerances.dock_yaw_deg=0",
)
LAYOUT = load_layout(None, EXACT)
CONFIG = StackConfig(site=LAYOUT.site, options=LAYOUT.options)


@pytest.fixture(scope="module")
def world() -> World:
    built = AsBuilt.draw(np.random.default_rng(0), LAYOUT.world.tolerances)
    return World(LAYOUT, built, pool=1)


def scan(world, noise_scale=0.0, deviation=None, seed=0):
    sensor = LidarSensor(world.model, np.random.default_rng(seed), deviation, noise_scale)
    return sensor.sample(world.time, world.model, world.data)


def wall_ranges(scan, yaw=0.0):
    """Ranges to the bare hall from the lidar at the dock, by hand."""
    x, y = CONFIG.T_base_lidar[:2, 3]
    angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges)) + yaw
    with np.errstate(divide="ignore"):
        to_x = np.where(np.cos(angles) > 0, LAYOUT.site.hall.x[1] - x, LAYOUT.site.hall.x[0] - x)
        to_y = np.where(np.sin(angles) > 0, LAYOUT.site.hall.y[1] - y, LAYOUT.site.hall.y[0] - y)
        return np.minimum(to_x / np.cos(angles), to_y / np.sin(angles))


def on_bare_wall(scan, expected):
    return np.isfinite(scan.ranges) & (np.abs(scan.ranges - expected) < 0.02)


def test_most_beams_meet_the_drawn_walls(world):
    seen = scan(world)
    assert len(seen.ranges) == 1081 >= 720
    wall = on_bare_wall(seen, wall_ranges(seen))
    assert wall.mean() > 0.5
    np.testing.assert_allclose(seen.ranges[wall], wall_ranges(seen)[wall], atol=0.001)


def test_the_vehicle_is_not_in_its_own_scan(world):
    assert scan(world).ranges.min() > 0.5


def test_a_turned_mount_turns_the_scan(world):
    tilt = transform(rot_z(0.05), (0, 0, 0))
    seen = scan(world, deviation=tilt)
    turned, straight = (on_bare_wall(seen, wall_ranges(seen, yaw)).sum() for yaw in (0.05, 0.0))
    assert turned > straight


def test_noise_is_that_of_the_specification(world):
    quiet = scan(world)
    wall = on_bare_wall(quiet, wall_ranges(quiet)) & (quiet.ranges < RANGE_FAR)
    error = np.array([(scan(world, 1.0, seed=s).ranges - quiet.ranges)[wall] for s in range(40)])
    assert error.std(axis=1).mean() == pytest.approx(NOISE, rel=0.1)
    assert error.mean(axis=1).std() == pytest.approx(OFFSET, rel=0.4)


def test_same_seed_same_bits(world):
    np.testing.assert_array_equal(scan(world, 1.0, seed=3).ranges, scan(world, 1.0, seed=3).ranges)


def test_drawing_and_model_agree_on_the_mount(world):
    site = world.model.site("agv/lidar")
    np.testing.assert_allclose(site.pos, CONFIG.T_base_lidar[:3, 3])


AHEAD = 540  # beam straight ahead
ACROSS = 1.5707963  # yaw of a thing that stands across the way


def before(kind: str, distance: float, yaw: float = ACROSS):
    """Scan without noise of a thing whose middle lies `distance` ahead of the lidar at the dock."""
    x = distance + CONFIG.T_base_lidar[0, 3]
    obstacle = f'{{kind = "{kind}", pose = [{x}, 0.0, {yaw}]}}'
    layout = load_layout(None, (*EXACT, f"world.faults.obstacles=[{obstacle}]"))
    built = AsBuilt.draw(np.random.default_rng(0), layout.world.tolerances)
    return scan(World(layout, built, pool=1)).ranges


@pytest.mark.parametrize(("kind", "face"), [("carton", 0.15), ("pillar", 0.12)])
def test_plain_obstacles_are_seen(kind, face):
    assert before(kind, 2.0)[AHEAD] == pytest.approx(2.0 - face, abs=0.001)


@pytest.mark.parametrize("kind", ["low_box", "table"])
def test_what_is_under_or_above_the_plane_is_missed(world, kind):
    """Expected result: nothing of a low box, and of a table its legs alone."""
    ranges, empty = before(kind, 2.0), scan(world).ranges
    changed = np.flatnonzero(np.abs(ranges - empty) > 0.01)
    assert AHEAD not in changed
    if kind == "low_box":
        assert not len(changed)
    else:  # 0.03 m wide, 0.75 m apart
        assert 4 <= len(changed) < 30
        angles = np.radians(0.25) * (changed - AHEAD)
        y = ranges[changed] * np.sin(angles)
        assert (np.abs(np.abs(y) - 0.375) < 0.017).all()


def test_black_is_heard_from_close_by_only(world):
    hidden = before("black_panel", 2.0)
    wide = np.abs(np.arange(1081) - AHEAD) * np.radians(0.25) < np.arctan2(0.39, 2.0)
    assert np.isinf(hidden[wide]).all()
    outside = np.abs(np.arange(1081) - AHEAD) * np.radians(0.25) > np.arctan2(0.41, 1.97)
    np.testing.assert_array_equal(hidden[outside], scan(world).ranges[outside])
    near = BLACK_RANGE - 0.05
    assert before("black_panel", near)[AHEAD] == pytest.approx(near - 0.02, abs=0.001)


def test_glass_is_looked_through_except_along_its_normal(world):
    """Expected result: within 3 degrees of the normal the glass, else what is behind it."""
    through, empty = before("glass_panel", 2.0), scan(world).ranges
    angle = np.abs(np.arange(1081) - AHEAD) * 0.25
    assert (np.abs(through[angle < 2.9] - 1.99) < 0.01).all()
    np.testing.assert_allclose(through[angle > 3.1], empty[angle > 3.1], atol=0.001)
    turned = before("glass_panel", 2.0, ACROSS - np.radians(20))
    np.testing.assert_allclose(turned, empty, atol=0.001)  # its normal does not meet the lidar

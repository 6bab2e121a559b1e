"""Lidar in the default cell: it sees the drawn walls, and never the vehicle itself."""

import numpy as np
import pytest

from twin.geometry import rot_z, transform
from twin.layout import load_layout
from twin.plant.as_built import AsBuilt
from twin.plant.sensors.lidar import NOISE, OFFSET, LidarSensor
from twin.plant.world import World
from twin.stack.config import StackConfig

LAYOUT = load_layout(None, ("world.tolerances.scale=0", "world.tolerances.dock_xy=0",
                            "world.tolerances.dock_yaw_deg=0"))  # fmt: skip
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
    return np.isfinite(scan.ranges) & (np.abs(scan.ranges - expected) < 0.05)


def test_most_beams_meet_the_drawn_walls(world):
    seen = scan(world)
    assert len(seen.ranges) == 1081 >= 720
    wall = on_bare_wall(seen, wall_ranges(seen))
    assert wall.mean() > 0.6
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
    wall = on_bare_wall(quiet, wall_ranges(quiet))
    error = np.array([(scan(world, 1.0, seed=s).ranges - quiet.ranges)[wall] for s in range(40)])
    assert error.std(axis=1).mean() == pytest.approx(NOISE, rel=0.1)
    assert error.mean(axis=1).std() == pytest.approx(OFFSET, rel=0.4)


def test_same_seed_same_bits(world):
    np.testing.assert_array_equal(scan(world, 1.0, seed=3).ranges, scan(world, 1.0, seed=3).ranges)


def test_drawing_and_model_agree_on_the_mount(world):
    site = world.model.site("agv/lidar")
    np.testing.assert_allclose(site.pos, CONFIG.T_base_lidar[:3, 3])

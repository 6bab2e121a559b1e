"""Long straights by the seen wall: true to it though the pose is wrong, and only where one is."""

from dataclasses import replace

import numpy as np
import pytest
from flat_world import scan

from scenarios.odometry import drawn_course
from twin.geometry import compose2
from twin.layout import load_layout
from twin.messages import BodyVelocity
from twin.stack.config import nominal_config
from twin.stack.estimation.site_map import lidar_map
from twin.stack.planning.drive import Drive, Leg
from twin.stack.tasks.aisle import AisleKeeper, wall_beside

LAYOUT = load_layout(None, ("options.aisle=line",))
CONFIG = nominal_config(LAYOUT.site, LAYOUT.options)
SURFACES = lidar_map(LAYOUT.site, CONFIG.T_base_lidar).surfaces.reshape(-1, 2, 2)
COURSE = drawn_course(LAYOUT.site)
EAST, WEST = COURSE.east, COURSE.west
LIDAR = (CONFIG.T_base_lidar[0, 3], 0.0, 0.0)
DT = 0.01


def leg(start, goal) -> Leg:
    return Leg(CONFIG.drive, np.array(start, dtype=float), np.array(goal, dtype=float), 0.0)


def drive(start, goal, keeper: AisleKeeper | None):
    """True poses (n, 3) of a vehicle that obeys at once and believes to be 5 cm to its left."""
    rng, pose = np.random.default_rng(0), np.array(start, dtype=float)
    way, track = Drive(CONFIG.drive), []
    way.start(0.0, pose, [goal])
    for k in range(800):
        now = DT * k
        if keeper is not None and k % 10 == 3:
            keeper.hear(scan(SURFACES, compose2(pose, LIDAR), rng, now - 0.03))
        command = way.step(now, compose2(pose, (0.0, 0.05, 0.0)), np.zeros(3))
        if keeper is not None:
            command = keeper.steered(now, way.leg, command)
        pose = compose2(pose, DT * command.as_array())
        track.append(pose)
    return np.array(track)


@pytest.mark.parametrize(
    "start, goal", [((*WEST, 0.0), (*EAST, 0.0)), ((*EAST, np.pi), (*WEST, np.pi))]
)
def test_the_wall_keeps_it_straight_though_the_pose_is_off(start, goal):
    """Expected: by the pose it is 5 cm off the line; by the wall it is on it at cruise."""
    middle = slice(500, 800)
    assert np.abs(drive(start, goal, None)[middle, 1] - WEST[1]).min() > 0.04
    by_wall = drive(start, goal, AisleKeeper(CONFIG))[middle]
    assert np.abs(by_wall[:, 1] - WEST[1]).max() < 0.01
    assert np.abs(np.sin(by_wall[:, 2] - start[2])).max() < 0.01


def test_which_legs_have_a_wall_beside():
    hall, y = LAYOUT.site.hall, WEST[1]
    assert wall_beside(hall, leg((*WEST, 0.0), (*EAST, 0.0))) == pytest.approx(hall.y[0] - y)
    assert wall_beside(hall, leg((*EAST, np.pi), (*WEST, np.pi))) == pytest.approx(y - hall.y[0])
    north = leg((14.55, 0.0, np.pi / 2), (14.55, 5.6, np.pi / 2))
    assert wall_beside(hall, north) == pytest.approx(14.55 - hall.x[1])
    for start, goal in (
        ((*WEST, 0.0), (8.0, y, 0.0)),  # short
        ((*WEST, np.pi), (*EAST, np.pi)),  # backwards
        ((*WEST, 0.0), (*EAST, 0.5)),  # turning
        ((7.0, 1.55, 0.0), (14.0, 1.55, 0.0)),  # between racks
    ):
        assert wall_beside(hall, leg(start, goal)) is None


def test_without_a_fresh_scan_the_pose_steers():
    keeper, way, command = AisleKeeper(CONFIG), leg((*WEST, 0.0), (*EAST, 0.0)), BodyVelocity(0.9)
    now = 0.5 * way.duration
    assert keeper.steered(now, way, command) is command
    pose = compose2((10.0, WEST[1] + 0.1, 0.0), LIDAR)
    keeper.hear(scan(SURFACES, pose, None, now - 0.1))
    turned = keeper.steered(now, way, command)
    assert turned.vx == 0.9 and turned.vy < -0.05  # back towards the wall
    keeper.hear(replace(scan(SURFACES, pose, None, now), ranges=np.full(1081, np.inf)))
    assert keeper.steered(now, way, command) == turned  # a broken scan changes nothing
    assert keeper.steered(now + 0.3, way, command) is command
    assert keeper.steered(0.01, way, command) is command  # not at speed yet

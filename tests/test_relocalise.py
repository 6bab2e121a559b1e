"""Driving without a map pose: racks told by their posts, the free way, and when it ends."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from flat_world import cast

from twin.geometry import between2, compose2, rot2
from twin.layout import load_layout
from twin.stack.config import StackConfig
from twin.stack.estimation.site_map import floor_map, lidar_map
from twin.stack.tasks.careful_drive import (
    CarefulLimits,
    DepthMemory,
    best_arc,
    closed_fronts,
    free_length,
    middle,
)
from twin.stack.tasks.relocalise import LOOK, Relocaliser

LAYOUT = load_layout()
CONFIG = StackConfig(site=LAYOUT.site, options=LAYOUT.options)
SURFACES = lidar_map(LAYOUT.site, CONFIG.T_base_lidar).surfaces.reshape(-1, 2, 2)
ANGLES = np.radians(np.arange(-135.0, 135.1, 0.5))
LIMITS = CarefulLimits()


def scan_points(pose):
    """End points in base, in the order of the beams. Shape (n, 2)."""
    x, y, yaw = compose2(pose, (0.3, 0.0, 0.0))
    r = cast(SURFACES, (x, y, yaw), ANGLES)
    return np.stack([0.3 + r * np.cos(ANGLES), r * np.sin(ANGLES)], axis=1)


@dataclass
class FakeFused:
    reckoned: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def pose(self, now):
        return self.reckoned


@dataclass
class FakeLocaliser:
    """Only what a lost vehicle knows."""

    fused: FakeFused = field(default_factory=FakeFused)
    lost: bool = True
    ready: bool = True
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))


def drive(pose, seconds, localiser=None):
    """Poses of a vehicle that does what it is told, from a place of the site. Shape (n, 3)."""
    relocaliser, localiser = Relocaliser(), localiser or FakeLocaliser()
    relocaliser.start(0.0)
    start, pose, path = np.array(pose, dtype=float), np.array(pose, dtype=float), []
    points = scan_points(pose)
    for k in range(round(seconds / 0.02)):
        if k % 5 == 0:
            points = scan_points(pose)
        command = relocaliser.step(0.02 * k, points, None, localiser)
        pose = compose2(pose, command.as_array() * 0.02)
        localiser.velocity = command.as_array()
        localiser.fused.reckoned = between2(start, pose)
        path.append(pose)
    return np.array(path), relocaliser


def test_posts_of_a_rack_close_its_front():
    pose = np.array([9.3, 1.55, 0.0])  # before rack 2, which begins 0.75 m to the left
    points = scan_points(pose)
    fronts = closed_fronts(points[np.hypot(*points.T) < 3.0])
    inside = (np.abs(fronts[:, 0]) < 1.2) & (np.abs(fronts[:, 1] - 0.75) < 0.1)
    assert inside.sum() >= 12
    # The way ahead stays open: nothing is drawn across the aisle.
    assert not np.any((np.abs(fronts[:, 1]) < 0.6) & (np.abs(fronts[:, 0]) < 1.5))


def test_bare_walls_have_no_fronts():
    y = np.linspace(-3, 3, 400)
    assert len(closed_fronts(np.stack([np.full(400, 2.0), y], axis=1))) == 0
    assert closed_fronts(np.zeros((0, 2))).shape == (0, 2)


@pytest.mark.parametrize("distance", [0.5, 0.8, 1.1])
def test_free_length_ends_before_a_wall(distance):
    wall = np.stack([np.full(50, 0.35 + distance), np.linspace(-1, 1, 50)], axis=1)
    length, room = free_length(wall, (0.4, 0.0, 0.0), LIMITS)
    assert distance - LIMITS.margin - 0.06 <= length <= distance - LIMITS.margin + 1e-9
    assert room >= LIMITS.margin


def test_free_length_counts_the_corners_of_a_turn():
    beside = np.array([[0.0, 0.36]])  # 0.11 m beside the flank: the corners reach 0.43 m
    assert free_length(beside, (0.4, 0.0, 0.0), LIMITS)[0] == LIMITS.ahead
    assert free_length(beside, (0.0, 0.0, 0.4), LIMITS)[0] < 0.5


def test_something_within_the_margin_may_be_left():
    close = np.array([[0.0, 0.28]])  # 0.03 m beside it
    assert free_length(close, (0.0, -0.1, 0.0), LIMITS)[0] == LIMITS.ahead
    assert free_length(close, (0.0, 0.1, 0.0), LIMITS)[0] == 0.0


def test_middle_of_an_aisle():
    sides = np.array([[0.0, 0.6], [0.1, -0.9], [3.0, 0.1]])
    assert middle(sides) == pytest.approx(-0.15)
    assert middle(sides[:1]) == 0.0


def test_the_arc_goes_where_there_is_room():
    x = np.linspace(-0.5, 2, 60)
    wall = np.concatenate([np.stack([x, 0.2 + 0.0 * x + 0.3 - 0.25 * (x - 0.0)], axis=1)])
    arc, _ = best_arc(wall, LIMITS, 0.0)
    assert arc[0] > 0 and arc[2] < -0.1  # away from a wall that comes in from the left


def test_what_was_seen_is_remembered_for_a_while_as_the_vehicle_moves():
    memory = DepthMemory(LIMITS)
    memory.add(0.0, np.array([[1.0, 0.5]]), np.zeros(3))
    moved = np.array([0.5, 0.0, np.pi / 2])
    expected = rot2(np.pi / 2).T @ (0.5, 0.5)
    np.testing.assert_allclose(memory.points(1.0, moved)[0], expected, atol=0.05)
    assert len(memory.points(LIMITS.remember + 1.0, moved)) == 0


def test_it_stands_before_it_drives_and_when_it_is_done():
    path, relocaliser = drive((9.3, 3.65, 0.0), LOOK)
    np.testing.assert_array_equal(path[-1], path[0])
    found = FakeLocaliser(lost=False)
    path, relocaliser = drive((9.3, 3.65, 0.0), 1.0, found)
    assert relocaliser.done and np.allclose(path[-1], path[0])


def test_it_waits_for_odometry_that_does_not_stand():
    relocaliser, localiser = Relocaliser(), FakeLocaliser(velocity=np.array([0.8, 0.0, 0.0]))
    relocaliser.start(0.0)
    points = scan_points((9.3, 3.65, 0.0))
    commands = [relocaliser.step(0.02 * k, points, None, localiser).vx for k in range(150)]
    assert not np.any(commands)


@pytest.mark.parametrize(
    "start",
    [(8.3, 3.80, 0.2), (9.0, 1.45, -0.2), (12.0, 5.6, 3.0), (14.5, 2.0, 1.4), (9.3, -0.6, 0.1),
     (7.2, 0.3, -2.0)],
)  # fmt: skip
def test_it_drives_some_way_and_touches_nothing(start):
    """Against whole racks, of which it sees the posts; what only depth shows is left out here."""
    path, _ = drive(start, 9.0)
    way = np.sum(np.hypot(*np.diff(path[:, :2], axis=0).T))
    assert way > 1.5
    floor = floor_map(LAYOUT.site)
    x, y = np.meshgrid(np.linspace(-0.35, 0.35, 15), np.linspace(-0.25, 0.25, 11))
    body = np.stack([x.ravel(), y.ravel()], axis=1)
    for pose in path[::10]:
        cells = floor.cells(pose[:2] + body @ rot2(pose[2]).T)
        assert np.all(floor.free[tuple(cells.T)]), f"touches at {pose}"


def test_in_an_aisle_it_comes_to_the_middle_where_the_tags_lie():
    path, _ = drive((8.3, 3.85, 0.0), 8.0)
    beyond = path[path[:, 0] > 9.2]
    assert len(beyond) and np.max(np.abs(beyond[:, 1] - 3.65)) < 0.12


def test_boxed_in_it_stands_and_says_so():
    relocaliser, localiser = Relocaliser(), FakeLocaliser()
    relocaliser.start(0.0)
    t = np.linspace(-1, 1, 80)
    box = np.concatenate(
        [np.stack([s * 0.39 + 0 * t, 0.29 * t], 1) for s in (-1, 1)]
        + [np.stack([0.39 * t, s * 0.29 + 0 * t], 1) for s in (-1, 1)]
    )
    for k in range(150):
        command = relocaliser.step(0.02 * k, box, None, localiser)
    assert not np.any(command.as_array()) and "boxed in" in relocaliser.reason

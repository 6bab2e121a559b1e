"""Surfaces finer than cells, by hand; what the camera sees behind the first surface."""

import numpy as np
import pytest
from flat_world import floor, picture

from twin.geometry import look_at
from twin.stack.config import Camera
from twin.stack.estimation.depth_to_scan import DepthToScan
from twin.stack.estimation.occupancy_grid import OccupancyGrid, SensorModel
from twin.stack.estimation.scan_matching import match_scan
from twin.stack.estimation.scans import beam_angles
from twin.stack.estimation.surfaces import SurfaceMap

ORIGIN, CELL, SHAPE = np.zeros(2), 0.05, (40, 60)  # 3 x 2 m


def wall(x, y0=0.3, y1=1.7, n=300):
    return np.column_stack([np.full(n, x), np.linspace(y0, y1, n)])


def test_wall_stands_where_its_points_are_and_not_in_the_middle_of_a_cell():
    surfaces = SurfaceMap(ORIGIN, CELL, SHAPE)
    surfaces.add(wall(1.013))
    field = surfaces.field(0.5)
    row, column = 20, 24  # centre at x = 1.225
    x, _, nx, ny = field.surfaces[field.nearest[row, column]]
    assert x == pytest.approx(1.013, abs=1e-9)
    assert abs(nx) == pytest.approx(1.0) and ny == pytest.approx(0.0, abs=1e-9)
    assert field.distances[row, column] == pytest.approx(1.225 - 1.013, abs=1e-3)
    assert field.distances[0, 59] == 0.5 and field.nearest[0, 59] == -1


def test_wall_on_the_border_of_two_cells_is_one_surface():
    """Noise throws its points into either; the line through both means lies between."""
    rng = np.random.default_rng(0)
    surfaces = SurfaceMap(ORIGIN, CELL, SHAPE)
    surfaces.add(wall(1.0, n=4000) + rng.normal(0, (0.01, 0.0), (4000, 2)))
    field = surfaces.field(0.5)
    found = field.surfaces[np.unique(field.nearest[8:30, 19:21])]
    np.testing.assert_allclose(found[:, 0], 1.0, atol=0.002)


def test_surveyed_wall_counts_before_what_was_measured_beside_it():
    surfaces = SurfaceMap(ORIGIN, CELL, SHAPE, np.array([[1.0, 0.0, 1.0, 2.0]]))
    surfaces.add(wall(1.04))  # the same wall, measured badly
    surfaces.add(wall(2.0))  # another
    field = surfaces.field(0.5)
    assert field.surfaces[field.nearest[20, 20], 0] == 1.0
    assert field.surfaces[field.nearest[20, 39], 0] == pytest.approx(2.0)
    assert not np.any(np.isclose(field.surfaces[:, 0], 1.04))


def test_what_no_longer_stands_draws_no_scan():
    surfaces = SurfaceMap(ORIGIN, CELL, SHAPE)
    surfaces.add(wall(1.0))
    field = surfaces.field(0.5, np.zeros(SHAPE, dtype=bool))
    assert len(field.surfaces) == 0 and np.all(field.distances == 0.5)
    surfaces.add(np.array([[np.nan, 1.0], [99.0, 1.0], [-0.01, 1.0]]))  # off the map
    surfaces.clear()
    assert len(surfaces.field(0.5).surfaces) == 0


def test_scan_is_matched_within_millimetres_on_cells_of_centimetres():
    """Expected result: 2 mm and 1 mrad off a corner; cells' centres alone are 12 mm off."""
    corner = np.concatenate([wall(1.013), wall(1.013)[:, ::-1] * (1, 1)])
    surfaces = SurfaceMap(ORIGIN, CELL, SHAPE)
    surfaces.add(corner)
    guess = np.array([0.03, -0.02, 0.01])
    match = match_scan(surfaces.field(0.5), corner, guess)
    assert match is not None
    assert np.hypot(*match.pose[:2]) < 0.002 and abs(match.pose[2]) < 0.001


def test_hits_raise_their_cells_once():
    grid = OccupancyGrid.covering((0, 0), (1, 1), 0.1)
    points = np.array([(0.55, 0.35), (0.56, 0.36), (np.nan, 0.1), (5.0, 5.0), (-0.01, 0.5)])
    grid.insert_hits(points, SensorModel(hit=0.8))
    assert grid.log_odds[3, 5] == pytest.approx(0.8) and np.count_nonzero(grid.log_odds) == 1
    for _ in range(9):
        grid.insert_hits(points, SensorModel(hit=0.8, limit=4.0))
    assert grid.log_odds[3, 5] == pytest.approx(4.0)


def test_goods_behind_the_edge_of_a_shelf_are_seen_too():
    """A board 1.0 m ahead, a carton on it 0.25 m behind: a beam returns from one, shows both."""
    eye = look_at((0.335, 0.0, 0.62), (1.335, 0.0, 0.62))
    camera = Camera(424, 240, 58.0, eye)
    edge = (np.array([1.335, -0.6, 0.66]), np.array([0, 1.2, 0.0]), np.array([0, 0, 0.04]))
    carton = (np.array([1.585, -0.3, 0.70]), np.array([0, 0.6, 0.0]), np.array([0, 0, 0.25]))
    frame = picture(
        [edge, carton, floor(-1, -3, 9, 3)], camera, eye, np.zeros(3), np.random.default_rng(0)
    )
    found = DepthToScan(camera).convert(frame)
    assert found is not None
    ahead = np.abs(beam_angles(found.scan)) < 0.2
    assert np.median(found.scan.ranges[ahead]) == pytest.approx(1.0, abs=0.02)
    behind = found.behind
    assert len(behind) > 50
    np.testing.assert_allclose(behind[:, 0], 1.25, atol=0.03)
    assert np.all(np.abs(behind[:, 1]) < 0.33)

"""The grid of one sensor, its distance field, its file, and the fusion of two."""

import numpy as np
import pytest
from flat_world import BEAMS, FIRST, STEP, box, scan
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from twin.messages import LidarScan
from twin.stack.estimation.grid_fusion import fuse, fuse_probability, fuse_states
from twin.stack.estimation.likelihood_field import LikelihoodField
from twin.stack.estimation.map_file import load_map, save_map
from twin.stack.estimation.occupancy_grid import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    SensorModel,
)

MODEL = SensorModel()
ROOM = box(-3.01, -2.02, 2.97, 1.98)  # no wall on the border of cells
STATES = st.sampled_from([FREE, UNKNOWN, OCCUPIED])


def empty(resolution=0.05):
    return OccupancyGrid.covering((-4.0, -3.0), (4.0, 3.0), resolution)


def one_beam(angle, length, stamp=0.0):
    return LidarScan(stamp, angle, STEP, np.array([length]), 30.0)


def test_covering_places_cells():
    grid = empty()
    assert grid.shape == (120, 160)
    np.testing.assert_array_equal(grid.cells(np.array([-3.99, -2.99])), (0, 0))
    np.testing.assert_allclose(grid.centres(np.array([0, 1])), (-3.925, -2.975))
    np.testing.assert_array_equal(grid.cells(grid.centres(np.array([7, 9]))), (7, 9))


def test_one_beam_by_hand():
    """Along x from (0, 0): its cells are freed, its last is raised, nothing else changes."""
    grid = empty(0.1)
    fan = LidarScan(0.0, -0.02, 0.01, np.array([np.inf, 1.02, 1.02, 1.02, np.inf]), 30.0)
    assert grid.insert_scan(fan, np.array([0.05, 0.05, 0.0]), MODEL) is None
    row = grid.log_odds[30]
    assert row[50] == pytest.approx(MODEL.hit)
    np.testing.assert_allclose(row[41:50], MODEL.miss)
    assert np.all(row[51:] == 0) and np.all(row[:40] == 0)
    assert np.count_nonzero(np.delete(grid.log_odds, 30, axis=0)) == 0


@given(st.floats(-2.5, 2.5), st.floats(-1.5, 1.5), st.floats(-7, 7))
@settings(max_examples=40, deadline=None)
def test_room_is_drawn_where_it_stands(x, y, yaw):
    """From any place: cells with an end point are occupied, free cells lie inside, in view."""
    grid, pose = empty(), np.array([x, y, yaw])
    reading = scan(ROOM, pose)
    for _ in range(3):
        assert grid.insert_scan(reading, pose, MODEL) is None
    angles = FIRST + STEP * np.arange(BEAMS) + yaw
    unit = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    ends = grid.cells(pose[:2] + reading.ranges[:, None] * unit)
    assert np.all(grid.occupied[ends[:, 0], ends[:, 1]])
    centres = grid.centres(np.argwhere(grid.occupied))
    off_x = np.minimum(np.abs(centres[:, 0] + 3.01), np.abs(centres[:, 0] - 2.97))
    off_y = np.minimum(np.abs(centres[:, 1] + 2.02), np.abs(centres[:, 1] - 1.98))
    assert np.all(np.minimum(off_x, off_y) <= 0.05)
    free = grid.centres(np.argwhere(grid.free))
    half = 0.5 * grid.resolution  # a wall runs through cells whose centre may lie behind it
    assert np.all((free > np.array([-3.01, -2.02]) - half) & (free < np.array([2.97, 1.98]) + half))
    # Plain rays, half a cell short of their ends, run through free cells only, but for the last.
    share = np.linspace(0.05, 1, 60)[None, :, None]
    short = np.maximum(reading.ranges - 0.15, 0)[:, None, None]
    rays = grid.cells(pose[:2] + share * short * unit[:, None])
    clear = grid.log_odds[rays[..., 0], rays[..., 1]] < 0
    assert np.mean(clear) > 0.97


def test_repeats_are_bounded_and_unlearnt():
    grid, pose = empty(), np.array([0.0, 0.0, 0.0])
    for _ in range(50):
        grid.insert_scan(scan(ROOM, pose), pose, MODEL)
    assert np.abs(grid.log_odds).max() <= MODEL.limit + 1e-6
    box_in_the_way = np.concatenate([ROOM, box(1.0, -0.3, 1.5, 0.3)])
    cell = tuple(grid.cells(np.array([1.001, 0.0])))
    for _ in range(10):
        grid.insert_scan(scan(box_in_the_way, pose), pose, MODEL)
    assert grid.states()[cell] == OCCUPIED
    for _ in range(20):
        grid.insert_scan(scan(ROOM, pose), pose, MODEL)
    assert grid.states()[cell] == FREE


def test_no_return_says_nothing_but_what_was_seen_free():
    pose, silent = np.zeros(3), LidarScan(0.0, -0.1, 0.01, np.full(21, np.inf), 30.0)
    grid = empty()
    assert "none of its 21 beams" in (grid.insert_scan(silent, pose, MODEL) or "")
    assert not grid.log_odds.any()
    blind = SensorModel(blind=0.5)
    assert grid.insert_scan(silent, pose, blind, np.full(21, 2.0)) is None
    x = grid.centres(np.argwhere(grid.log_odds < 0))[:, 0]
    assert x.min() >= 0.45 and 1.85 < x.max() < 2.0 and not np.any(grid.log_odds > 0)


@pytest.mark.parametrize(
    "bad",
    [
        LidarScan(0.0, FIRST, STEP, np.array([]), 30.0),
        LidarScan(np.nan, FIRST, STEP, np.ones(5), 30.0),
        LidarScan(0.0, FIRST, 0.0, np.ones(5), 30.0),
        LidarScan(0.0, FIRST, STEP, np.full(9, np.nan), 30.0),
        LidarScan(0.0, FIRST, STEP, np.full(9, -1.0), 30.0),
        LidarScan(0.0, FIRST, STEP, np.ones((3, 3)), 30.0),
        LidarScan(0.0, np.inf, STEP, np.ones(5), 30.0),
    ],
)
def test_broken_scans_change_nothing(bad):
    grid = empty()
    fault = grid.insert_scan(bad, np.zeros(3), MODEL)
    assert fault is not None and "\n" not in fault and not grid.log_odds.any()


def test_single_broken_beams_are_left_out():
    ranges = scan(ROOM, np.zeros(3)).ranges.copy()
    ranges[::2] = np.nan
    grid = empty()
    assert grid.insert_scan(LidarScan(0.0, FIRST, STEP, ranges, 30.0), np.zeros(3), MODEL) is None
    assert np.all(np.isfinite(grid.log_odds)) and grid.occupied.sum() > 100
    assert "not finite" in (grid.insert_scan(scan(ROOM, np.zeros(3)), np.full(3, np.nan), MODEL)
                            or "")  # fmt: skip


@given(st.floats(-20, 20), st.floats(-20, 20), st.floats(-3, 3))
@settings(max_examples=60, deadline=None)
def test_a_sensor_anywhere_is_safe(x, y, yaw):
    """Off the grid, on its border, looking in or away: no crash, nothing out of bounds."""
    grid = empty(0.2)
    far = LidarScan(0.0, FIRST, STEP, np.full(BEAMS, 12.0), 30.0)
    grid.insert_scan(far, np.array([x, y, yaw]), MODEL)
    assert np.all(np.isfinite(grid.log_odds))


# --- distance field ---------------------------------------------------------------------------


@given(arrays.arrays(np.bool_, (7, 9)), st.floats(-3, 3), st.floats(-3, 3))
@settings(max_examples=60, deadline=None)
def test_distance_is_that_to_the_nearest_cell(occupied, x, y):
    field = LikelihoodField(occupied, (-1.0, -0.8), 0.25, 1.1)
    j, i = int(np.floor((x + 1.0) / 0.25)), int(np.floor((y + 0.8) / 0.25))
    expected = 1.1
    if 0 <= i < 7 and 0 <= j < 9 and occupied.any():
        cells = np.argwhere(occupied)
        expected = min(1.1, 0.25 * np.min(np.hypot(*(cells - (i, j)).T)))
    assert field.lookup(np.array([[x, y]]))[0] == pytest.approx(expected, abs=1e-5)


def test_distance_off_the_map_and_of_nothing():
    field = LikelihoodField(np.zeros((4, 4), bool), (0, 0), 0.1, 2.0)
    points = np.array([[0.2, 0.2], [-5, 0], [np.nan, 0], [np.inf, 0]])
    np.testing.assert_allclose(field.lookup(points), 2.0)
    with pytest.raises(ValueError, match="wanted"):
        LikelihoodField(np.zeros((0, 4), bool), (0, 0), 0.1, 2.0)


# --- file -------------------------------------------------------------------------------------


@given(arrays.arrays(np.int8, (5, 7), elements=STATES))
@settings(max_examples=30, deadline=None)
def test_a_saved_map_comes_back(tmp_path_factory, states):
    path = tmp_path_factory.mktemp("map") / "hall.yaml"
    values = {FREE: -3.0, UNKNOWN: 0.0, OCCUPIED: 3.0}
    cells = np.vectorize(values.get)(states).astype(np.float32)
    save_map(OccupancyGrid(np.array([-1.5, 2.25]), 0.05, cells), path)
    back = load_map(path)
    np.testing.assert_array_equal(back.states(), states)
    np.testing.assert_allclose(back.origin, (-1.5, 2.25))
    assert back.resolution == 0.05


def test_file_is_what_map_server_writes(tmp_path):
    """The picture's first row is north; 0, 205, 254 are occupied, unknown, free."""
    cells = np.array([[3.0, 0.0], [-3.0, 0.0]], dtype=np.float32)  # row 0 is south
    save_map(OccupancyGrid(np.zeros(2), 0.1, cells), tmp_path / "m.yaml")
    assert (tmp_path / "m.pgm").read_bytes() == b"P5\n2 2\n255\n" + bytes([254, 205, 0, 205])
    text = (tmp_path / "m.yaml").read_text()
    assert "image: m.pgm" in text and "origin: [0.0, 0.0, 0.0]" in text


def saved(tmp_path):
    grid = empty()
    grid.insert_scan(scan(ROOM, np.zeros(3)), np.zeros(3), MODEL)
    save_map(grid, tmp_path / "m.yaml")
    return tmp_path / "m.yaml", tmp_path / "m.pgm"


@pytest.mark.parametrize("change", [-1, -1000, 7])
def test_truncated_or_longer_picture_is_refused(tmp_path, change):
    yaml, pgm = saved(tmp_path)
    data = pgm.read_bytes()
    pgm.write_bytes(data[:change] if change < 0 else data + b"x" * change)
    with pytest.raises(ValueError, match=r"bytes of cells, wanted 160 x 120") as caught:
        load_map(yaml)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ("resolution: 0.05", "resolution: -1", "wanted resolution"),
        ("resolution: 0.05", "resolution: much", "much"),
        ("resolution: 0.05\n", "", "lacks resolution"),
        ("0.0]", "0.5]", "origin"),
        ("trinary", "raw", "known is trinary"),
        ("m.pgm", "other.pgm", "cannot be read"),
        ("free_thresh: 0.196", "free_thresh: 0.9", "free_thresh"),
    ],
)
def test_bad_header_is_refused(tmp_path, old, new, why):
    yaml, _ = saved(tmp_path)
    assert old in yaml.read_text()
    yaml.write_text(yaml.read_text().replace(old, new))
    with pytest.raises(ValueError, match=why):
        load_map(yaml)


def test_map_of_another_size_is_refused(tmp_path):
    yaml, pgm = saved(tmp_path)
    assert load_map(yaml, (120, 160)).shape == (120, 160)
    with pytest.raises(ValueError, match="wanted \\(10, 10\\)"):
        load_map(yaml, (10, 10))
    pgm.write_bytes(b"P2\n1 1\n255\n0")
    with pytest.raises(ValueError, match="not a binary PGM"):
        load_map(yaml)
    with pytest.raises(ValueError, match="cannot be read"):
        load_map(tmp_path / "none.yaml")


# --- fusion -----------------------------------------------------------------------------------


def test_table_1():
    """Rows: camera occupied, free, unknown; columns: lidar likewise."""
    o, f, u = OCCUPIED, FREE, UNKNOWN
    rgbd, lidar = np.meshgrid([o, f, u], [o, f, u], indexing="ij")
    np.testing.assert_array_equal(fuse_states(rgbd, lidar), [[o, o, o], [o, f, f], [o, f, u]])


@given(st.floats(0.01, 0.99), st.floats(0.01, 0.99))
def test_equation_5_is_a_sum_of_log_odds(p, q):
    fused = fuse_probability(np.array([p]), np.array([q]))[0]
    total = np.log(p / (1 - p)) + np.log(q / (1 - q))
    assert fused == pytest.approx(1 / (1 + np.exp(-total)), abs=1e-9)


def test_equation_5_by_hand():
    pairs = np.array([(0.7, 0.8), (0.5, 0.3), (1.0, 0.0)])
    np.testing.assert_allclose(fuse_probability(pairs[:, 0], pairs[:, 1]), [0.56 / 0.62, 0.3, 0.5])


@given(arrays.arrays(np.float32, (2, 6, 6), elements=st.floats(-4, 4, width=32)))
@settings(max_examples=60, deadline=None)
def test_fused_grid_has_the_states_of_the_table(cells):
    rgbd, lidar = (OccupancyGrid(np.zeros(2), 0.1, c) for c in cells)
    expected = fuse_states(rgbd.states(), lidar.states())
    np.testing.assert_array_equal(fuse(rgbd, lidar).states(), expected)


def test_grids_that_differ_are_not_fused():
    with pytest.raises(ValueError, match="differ"):
        fuse(empty(0.05), empty(0.1))

"""Scores of maps on tiny grids worked by hand, and what rays see of a plain world."""

import numpy as np
import pytest

from evaluation.map_truth import AHEAD, MapTruth, eyes
from evaluation.maps import (
    FOUND,
    MISSED,
    WRONG,
    detection,
    error_picture,
    map_metrics,
    missed_by_one,
    score,
    widened,
    write_pictures,
)
from twin.stack.estimation.occupancy_grid import FREE, OCCUPIED, UNKNOWN


def mask(*rows):
    """Cells from pictures in letters, the first row the northernmost."""
    return np.array([[c == "#" for c in row] for row in rows[::-1]])


def test_score_by_hand():
    """A wall of four true cells; the map finds two, is one cell beside a third, and adds one."""
    truth = mask(
        "......",
        "####..",
        "......",
        "......",
        "......",
    )
    occupied = mask(
        "......",
        "##....",
        "...#..",  # within a cell of the third and the fourth
        "......",
        ".....#",  # nothing near
    )
    found = score(occupied, truth)
    assert found.precision == pytest.approx(3 / 4)
    assert found.recall == pytest.approx(4 / 4)
    assert found.iou == pytest.approx(4 / 5)
    strict = score(occupied, truth, tolerance=0)
    assert (strict.precision, strict.recall) == (pytest.approx(2 / 4), pytest.approx(2 / 4))
    assert strict.iou == pytest.approx(2 / 6)


def test_missed_cells_cost_recall_alone():
    truth = mask("#.....", "......", "#.....", "......", "#....#")
    found = score(mask("......", "......", "......", "......", "#....."), truth)
    assert found.precision == 1.0 and found.recall == pytest.approx(1 / 4)
    assert found.iou == pytest.approx(1 / 4)


def test_nothing_claimed_is_not_a_score():
    found = score(mask("...", "..."), mask("#..", "..."))
    assert np.isnan(found.precision) and found.recall == 0.0 and found.iou == 0.0
    assert np.isnan(score(mask("..."), mask("...")).recall)
    with pytest.raises(ValueError, match="against a truth"):
        score(mask("..."), mask("...."))


def test_widened_by_hand():
    grown = widened(mask(".....", ".....", "..#..", ".....", "....."))
    np.testing.assert_array_equal(grown, mask(".....", ".###.", ".###.", ".###.", "....."))


def two_obstacles():
    """A wall above, a table of ten cells at the left and a box of two at the right."""
    wall = mask("############", "............", "............", "............", "............")
    table = mask("............", "............", "#####.......", "............", "#####.......")
    box = mask("............", "............", "............", "............", "..........##")
    hidden = np.zeros_like(wall)
    return MapTruth(
        wall | table | box, np.stack([table, box, hidden]), ("table", "low_box", "pillar")
    )


def test_an_obstacle_counts_when_half_of_it_was_found():
    truth = two_obstacles()
    legs = mask("............", "............", "#...........", "............", "............")
    assert detection(legs, truth) == {"table": [False], "low_box": [False]}
    edge = mask("............", "............", "#####.......", "............", "...........#")
    assert detection(edge, truth) == {"table": [True], "low_box": [True]}


def test_metrics_of_the_three_maps():
    truth = two_obstacles()
    states = {}
    states["lidar"] = np.where(truth.surface & ~truth.obstacles.any(axis=0), OCCUPIED, FREE)
    states["rgbd"] = np.where(truth.obstacles.any(axis=0), OCCUPIED, UNKNOWN)
    states["fused"] = np.where(truth.surface, OCCUPIED, FREE)
    figures = map_metrics(states, truth)
    assert figures["occupied_recall_lidar"] == pytest.approx(12 / 24)
    assert figures["occupied_recall_rgbd"] == pytest.approx(12 / 24)
    assert figures["occupied_recall_fused"] == figures["occupied_precision_fused"] == 1.0
    assert figures["occupied_recall_gain"] == pytest.approx(12 / 24)
    assert figures["obstacles_detected_lidar"] == 0.0
    assert figures["obstacles_detected_fused"] == figures["detected_low_box_rgbd"] == 1.0
    assert figures["obstacles_missed_by_one"] == 1.0
    assert missed_by_one(truth.obstacles[0], truth.surface, truth) == 0.5


def test_pictures_show_what_was_missed_and_what_is_wrong(tmp_path):
    truth = two_obstacles()
    states = np.where(truth.obstacles[0], OCCUPIED, FREE).astype(np.int8)
    states[2, 11] = OCCUPIED  # two cells from the wall
    picture = error_picture(states, truth)[::4, ::4][::-1]  # back to the map's rows
    assert tuple(picture[4, 0]) == MISSED and tuple(picture[0, 0]) == FOUND
    assert tuple(picture[2, 11]) == WRONG and tuple(picture[3, 6]) == (255, 255, 255)
    names = write_pictures(tmp_path, {"fused": states}, truth)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(names)


def test_eyes_look_from_ahead_of_the_base():
    path = [(0.1 * k, 0.0, 0.0) for k in range(11)] + [(1.0, 0.0, np.pi / 2)]
    found = eyes(np.array(path))
    np.testing.assert_allclose(found[0], (AHEAD, 0.0))
    np.testing.assert_allclose(found[1], (AHEAD + 0.5, 0.0))
    np.testing.assert_allclose(found[-1], (1.0, AHEAD), atol=1e-12)

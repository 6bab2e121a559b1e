"""Decoding, suppression, regions and counting, on cases worked by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.detection import Judged, average_precision, count
from twin.stack.detection.boxes import iou, read_maps, suppress
from twin.stack.detection.roi import HEIGHT, WIDTH, Region


def empty_maps():
    """Maps of 416 x 320 in which no cell sees anything."""
    maps = [np.zeros((HEIGHT // s, WIDTH // s, 10)) for s in (4, 16, 32)]
    for m in maps:
        m[:, :, 4] = -20.0
    return maps


def put(maps, level, stride, box, part_class, logit=6.0):
    """Let the cell under a box's centre say it: the inverse of the decoding."""
    cx, cy = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
    u, v = int(cx // stride), int(cy // stride)
    cell = maps[level][v, u]
    cell[:4] = cx / stride - u - 0.5, cy / stride - v - 0.5, 0, 0
    cell[2:4] = np.log((box[2] - box[0]) / stride), np.log((box[3] - box[1]) / stride)
    cell[4] = logit
    cell[5 + part_class] = 8.0


@given(
    st.floats(30, 380),
    st.floats(30, 290),
    st.floats(8, 60),
    st.floats(8, 60),
    st.integers(0, 4),
    st.sampled_from([(0, 4), (1, 16), (2, 32)]),
)
def test_what_a_cell_says_is_read_back(cx, cy, w, h, part_class, at):
    maps = empty_maps()
    box = (cx - w / 2, cy - h / 2, cx + w / 2, cy + h / 2)
    put(maps, *at, box, part_class)
    boxes = read_maps(maps, WIDTH, 0.5)
    np.testing.assert_allclose(boxes.box, [box], atol=1e-9)
    assert boxes.part_class.tolist() == [part_class]
    assert 0.98 < boxes.score[0] < 1.0


def test_nothing_in_empty_maps():
    boxes = read_maps(empty_maps(), WIDTH, 0.3)
    assert boxes.box.shape == (0, 4) and boxes.part_class.shape == (0,)


def test_the_same_part_seen_by_two_maps_counts_once():
    maps = empty_maps()
    put(maps, 0, 4, (100, 100, 140, 130), 1, logit=4.0)
    put(maps, 1, 16, (101, 101, 141, 131), 2, logit=2.0)
    boxes = read_maps(maps, WIDTH, 0.3)
    assert boxes.part_class.tolist() == [1]


def test_a_class_in_doubt_lowers_the_score():
    maps = empty_maps()
    put(maps, 0, 4, (100, 100, 140, 130), 1)
    maps[0][28, 30, 5:7] = 8.0  # two classes alike
    assert len(read_maps(maps, WIDTH, 0.6).box) == 0
    assert read_maps(maps, WIDTH, 0.4).score[0] == pytest.approx(0.5, abs=0.01)


def test_overlap_by_hand():
    box = np.array([0.0, 0, 10, 10])
    others = np.array([[0.0, 0, 10, 10], [5, 0, 15, 10], [20, 20, 30, 30], [2, 2, 4, 4]])
    np.testing.assert_allclose(iou(box, others), [1, 50 / 150, 0, 4 / 100])


def test_suppression_keeps_the_best_of_each():
    boxes = np.array([[0.0, 0, 10, 10], [1, 0, 11, 10], [8, 0, 18, 10], [0, 0, 10, 9]])
    assert suppress(boxes, 0.45).tolist() == [0, 2]
    assert suppress(np.empty((0, 4)), 0.45).tolist() == []


def test_region_there_and_back():
    polygon = np.array([(72.3, 107.0), (559.0, 167.0), (188.0, 475.6)])
    region = Region.around(polygon, (480, 640))
    assert (region.left, region.top) == (72, 107)
    boxes = np.array([[100.0, 120, 140, 150]])
    np.testing.assert_allclose(region.to_image(region.to_input(boxes)), boxes)
    image = np.zeros((480, 640, 3), np.uint8)
    image[120:150, 100:140] = 255
    seen = np.argwhere(region.input(image)[0, :, :, 0] == 255)
    low, high = seen.min(axis=0)[::-1], seen.max(axis=0)[::-1] + 1
    np.testing.assert_allclose([*low, *high], region.to_input(boxes)[0], atol=1.5)


def judged(truth, reported) -> Judged:
    truth_class, truth_box = [c for c, _ in truth], [b for _, b in truth]
    return Judged(
        truth=np.array(truth_box, float).reshape(-1, 4),
        truth_class=np.array(truth_class, int),
        ignored=np.array([[200.0, 200, 240, 240]]),
        box=np.array([b for _, _, b in reported], float).reshape(-1, 4),
        score=np.array([s for _, s, _ in reported], float),
        box_class=np.array([c for c, _, _ in reported], int),
    )


A, B, C = (0, 0, 20, 20), (50, 0, 70, 20), (100, 0, 120, 20)


def test_counts_by_hand():
    """One right, one confused, one missed, one false, one excused, one below the threshold."""
    picture = judged(
        [(0, A), (1, B), (2, C)],
        [
            (0, 0.9, (1, 1, 21, 21)),
            (2, 0.8, B),
            (3, 0.7, (150, 0, 170, 20)),
            (3, 0.7, (205, 205, 235, 235)),
            (2, 0.3, C),
        ],
    )
    counts = count([picture], 0.5)
    assert [(c.total, c.right, c.confused, c.missed) for c in counts.classes[:3]] == [
        (1, 1, 0, 0),
        (1, 0, 1, 0),
        (1, 0, 0, 1),
    ]
    assert counts.false == 1
    assert counts.classes[2].reported == 1 and counts.classes[2].precision == 0.0
    assert counts.classes[0].accuracy == counts.classes[0].recall == 1.0


def test_a_part_is_found_once():
    counts = count([judged([(0, A)], [(0, 0.9, A), (0, 0.8, A)])], 0.5)
    assert counts.classes[0].right == 1 and counts.false == 1


def test_average_precision_by_hand():
    """Hits at ranks 1 and 3 of three labels: (1 + 2/3) / 3."""
    pictures = [
        judged([(0, A), (0, B), (0, C)], [(0, 0.9, A), (0, 0.8, (0, 50, 20, 70)), (0, 0.7, B)])
    ]
    assert average_precision(pictures) == pytest.approx((1 + 2 / 3) / 3)


def test_small_parts_alone():
    large = (100, 100, 180, 180)
    pictures = [judged([(0, A), (0, large)], [(0, 0.9, large), (0, 0.8, A)])]
    assert average_precision(pictures, small=True) == 1.0
    assert average_precision([judged([(0, A)], [])], small=True) == 0.0

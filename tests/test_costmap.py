"""Inflated grid and clearance of the rectangle, against plain geometry."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from twin.floor_plan import FOOTPRINT
from twin.geometry import rectangle
from twin.stack.planning.clearance import (
    Footprint,
    clearance,
    points,
    room,
    room_back,
    room_to_turn,
    segments,
)
from twin.stack.planning.costmap import INSCRIBED, LETHAL, UNKNOWN, inflate

BODY = Footprint()


def test_footprint_is_the_drawings():
    assert (BODY.length, BODY.width) == FOOTPRINT


def test_costs_follow_the_fields_conventions():
    states = np.zeros((81, 81), dtype=np.int8)
    states[40, 40] = 100
    states[0, :] = -1
    costmap = inflate(states, 0.05, (-1.0, 2.0), BODY, decay=5.0, reach=1.0)
    assert costmap.cells[40, 40] == LETHAL and costmap.cells[0, 5] == UNKNOWN
    assert costmap.cells[40, 45] == INSCRIBED  # 0.25 m: the inscribed radius itself
    for k in (6, 10, 15, 20):  # hand-worked: 252 exp(-5 (0.05 k - 0.25))
        assert costmap.cells[40, 40 + k] == int(252 * np.exp(-5 * (0.05 * k - 0.25)) + 1e-4)
    assert costmap.cells[40, 61] == 0
    assert costmap.cell((1.025, 4.025)) == (40, 40) and costmap.cost((1.025, 4.025)) == LETHAL
    assert costmap.cell((-1.01, 3.0)) is None and costmap.cost((99, 0)) == UNKNOWN
    np.testing.assert_allclose(costmap.centres((40, 40)), (1.025, 4.025))


def test_unknown_ground_where_the_vehicle_would_collide_is_no_longer_unknown():
    states = np.full((40, 40), -1, dtype=np.int8)
    states[20, 20] = 100
    cells = inflate(states, 0.05, (0, 0), BODY).cells
    assert cells[20, 22] == INSCRIBED and cells[20, 39] == UNKNOWN


@pytest.mark.parametrize(
    ("states", "resolution"),
    [
        (np.zeros((0, 5), dtype=np.int8), 0.05),
        (np.zeros(5, dtype=np.int8), 0.05),
        (np.zeros((5, 5)), 0.05),
        (np.full((5, 5), 7, dtype=np.int8), 0.05),
        (np.zeros((5, 5), dtype=np.int8), np.nan),
        (np.zeros((5, 5), dtype=np.int8), 0.0),
    ],
)
def test_what_is_no_map_is_refused_in_one_line(states, resolution):
    with pytest.raises(ValueError, match="costmap") as error:
        inflate(states, resolution, (0, 0), BODY)
    assert "\n" not in str(error.value)


def dense(x, y, yaw, a, b):
    """Distance of a rectangle's outline and inside from a segment, by many points."""
    corners = np.array(rectangle(x, y, yaw, *FOOTPRINT))
    k = np.linspace(0, 1, 150)[:, None]
    outline = np.concatenate(
        [c + k * (d - c) for c, d in zip(corners, np.roll(corners, -1, 0), strict=True)]
    )
    line = np.array(a) + k * (np.array(b) - np.array(a))
    return np.hypot(*(outline[:, None] - line[None]).transpose(2, 0, 1)).min()


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 10**6))
def test_clearance_is_the_distance_and_its_derivative(seed):
    rng = np.random.default_rng(seed)  # drawn evenly: exact ties between two sides have none
    ends, (x, y), yaw = rng.uniform(-1.2, 1.2, 4), rng.uniform(-1.2, 1.2, 2), rng.uniform(-4, 4)
    value, *slope = clearance(x, y, yaw, BODY.half, *ends)
    if value > 0:
        assert value == pytest.approx(dense(x, y, yaw, ends[:2], ends[2:]), abs=0.01)
    else:  # shifting it out along the derivative just parts them
        n = np.array(slope[:2])
        moved = clearance(x - value * n[0], y - value * n[1], yaw, BODY.half, *ends)[0]
        assert abs(moved) < 1e-6
    e = 1e-6
    for k in range(3):
        sides = []
        for sign in (1, -1):
            pose = [x, y, yaw]
            pose[k] += sign * e
            sides.append(clearance(*pose, BODY.half, *ends)[0])
        ahead, behind = (sides[0] - value) / e, (value - sides[1]) / e
        # Where the nearest point changes, the derivative is one of the two sides'.
        assert min(abs(ahead - slope[k]), abs(behind - slope[k])) < 1e-3


def test_lethal_cells_become_few_capsules_that_cover_them():
    states = np.zeros((80, 80), dtype=np.int8)
    states[10, 5:60] = 100
    states[20:70, 50] = 100
    states[40, 10] = 100
    costmap = inflate(states, 0.05, (0.0, 0.0), BODY)
    found = costmap.obstacles((2.0, 2.0), 3.0)
    assert len(found) == 3
    for cell in np.argwhere(states == 100):
        x, y = costmap.centres(cell)
        assert room([x, y, 0.0], BODY, found) < 0
    assert len(costmap.obstacles((9.0, 9.0), 1.0)) == 0
    assert not costmap.fits(np.array([0.52, 2.2, 0.0]), BODY)
    assert costmap.fits(np.array([1.3, 1.5, 0.0]), BODY, margin=0.05)


def test_room_to_turn_and_to_back_out_of_a_dead_end():
    aisle = segments([[-2, 0.35, 0.6, 0.35], [-2, -0.35, 0.6, -0.35], [0.6, -0.35, 0.6, 0.35]])
    pose = np.array([0.2, 0.0, 0.0])
    assert not room_to_turn(pose, BODY, aisle) and room_back(pose, BODY, aisle, 1.0) == 1.0
    assert room_to_turn(pose, BODY, points([[1.0, 0.0]]))
    assert room_back(pose, BODY, points([[-0.45, 0.0]])) == pytest.approx(0.27, abs=0.03)

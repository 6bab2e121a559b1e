"""Ground that was never looked at is looked at first, from where the camera sees it."""

import numpy as np
import pytest
from nav_bench import NavBench

from twin.geometry import wrap_angle
from twin.layout import Faults, Obstacle
from twin.messages import Goal
from twin.stack.planning.clearance import Footprint
from twin.stack.planning.costmap import inflate
from twin.stack.planning.viewpoint import ViewOptions, over_known, viewpoint

R = 0.05
OPTIONS = ViewOptions()


def hall(wall_at: float | None = None):
    """6 x 4 m, known from x = 2.5 m on; a wall across it on demand."""
    states = np.zeros((80, 120), np.int8)
    states[0] = states[-1] = states[:, 0] = states[:, -1] = 100
    if wall_at is not None:
        states[:, round(wall_at / R)] = 100
    known = np.broadcast_to(np.arange(120) * R >= 2.5, (80, 120)) | (states == 100)
    return inflate(states, R, np.zeros(2), Footprint()), known


def test_it_is_looked_at_from_known_ground_with_room_to_turn():
    costs, known = hall()
    start, point = np.array([3.0, 2.0, 0.0]), np.array([2.7, 2.0])
    x, y, yaw = viewpoint(costs, known, start, point, Footprint(), OPTIONS)
    away = point - (x, y)
    assert 1.6 <= np.hypot(*away) <= 2.2
    assert abs(wrap_angle(np.arctan2(away[1], away[0]) - yaw)) < 1e-9
    assert x - 0.43 > 2.5
    assert costs.fits(np.array([x, y, yaw]), Footprint(0.86, 0.86))


def test_there_may_be_no_such_place():
    costs, known = hall()
    start, point = np.array([3.0, 2.0, 0.0]), np.array([2.7, 2.0])
    nothing = np.zeros_like(known)
    assert viewpoint(costs, nothing, start, point, Footprint(), OPTIONS) is None
    costs, known = hall(wall_at=3.0)  # between all good places and the point
    assert viewpoint(costs, known, start, point, Footprint(), OPTIONS) is None


def test_on_the_way_there_unknown_ground_is_closed():
    costs, known = hall()
    start = np.array([3.0, 2.0, 0.0])
    closed = over_known(costs, known, start)
    assert closed.cost((2.0, 2.0)) == 253 and closed.cost((4.0, 2.0)) == costs.cost((4.0, 2.0))
    assert closed.cost((2.9, 2.0)) == costs.cost((2.9, 2.0))  # it stands there
    split = known.copy()
    split[:, 80:90] = False  # a strip that it would have to cross
    assert over_known(costs, split, start).cost((5.0, 2.0)) == 253
    view = viewpoint(costs, split, start, np.array([2.7, 2.0]), Footprint(), OPTIONS)
    assert view is None or view[0] < 4.0


def test_a_low_box_behind_a_vehicle_that_never_looked_there_is_found():
    """Expected result: it looks back from where it can, sees the box, and passes it."""
    box = Obstacle(kind="low_box", pose=(9.7, 1.25, 0.0))
    bench = NavBench((10.6, 1.55, 0.0), faults=Faults(obstacles=(box,)))
    surroundings = bench.navigator.surroundings
    x = surroundings.layer.lidar.origin[0] + (np.arange(surroundings.layer.looked.shape[1])) * R
    surroundings.layer.looked_at[:, x > 10.2] = 0.0
    assert bench.go(Goal("behind", (8.3, 1.55, 0.0)), limit=60) == "reached"
    assert np.array(bench.rows)[:, 1].max() > 11.5  # where it looked from
    assert not bench.collisions


@pytest.mark.parametrize("y", [1.25, 1.85])
def test_a_low_box_farther_behind_is_found_on_the_way(y):
    """Expected result: it does not reverse farther than the ground is known."""
    box = Obstacle(kind="low_box", pose=(8.2, y, 0.0))
    bench = NavBench((10.6, 1.55, 0.0), faults=Faults(obstacles=(box,)))
    surroundings = bench.navigator.surroundings
    x = surroundings.layer.lidar.origin[0] + (np.arange(surroundings.layer.looked.shape[1])) * R
    surroundings.layer.looked_at[:, x > 9.0] = 0.0
    assert bench.go(Goal("behind", (7.4, 1.55, 0.0)), limit=60) == "reached"
    assert not bench.collisions

"""From goal to standing there: what is refused, what is driven round, and how it ends."""

import numpy as np
import pytest
from nav_bench import CONFIG, LAYOUT, NavBench

from twin.floor_plan import stops
from twin.geometry import wrap_angle
from twin.layout import Faults, Mover, Obstacle
from twin.messages import Goal
from twin.stack.estimation.site_map import floor_map
from twin.stack.planning.navigator import Navigator

STOPS = stops(LAYOUT.site)
AISLE = (8.3, 1.55, 0.0)  # between racks 1 and 2, looking along the aisle
REST = np.zeros(3)


def goal(name="there", pose=(10.2, 1.55, 0.0)):
    return Goal(name, pose)


@pytest.mark.parametrize(
    "pose, word",
    [
        ((np.nan, 0.0, 0.0), "not a finite"),
        ((50.0, 0.0, 0.0), "off the map"),
        ((9.3, 0.5, 0.0), "in an obstacle"),  # in rack 1
        ((9.3, 0.0, 0.0), "in an obstacle"),  # with its side in rack 1
        ((-1.4, 0.0, 0.0), "unknown"),  # behind the wall
    ],
)
def test_goals_that_cannot_be_are_refused_in_one_line(pose, word):
    navigator = Navigator(CONFIG, floor_map(LAYOUT.site))
    why = navigator.go(0.0, goal("bad", pose))
    assert word in why and "\n" not in why
    assert not navigator.active and navigator.outcome == why
    assert navigator.state.outcomes == (("bad", why),)


def test_a_refused_goal_leaves_the_one_under_way_alone():
    navigator = Navigator(CONFIG, floor_map(LAYOUT.site))
    assert navigator.go(0.0, goal()) == ""
    navigator.step(0.0, np.array(AISLE), REST)
    before = navigator.state
    assert navigator.go(0.01, goal("bad", (9.3, 0.5, 0.0)))
    assert navigator.active and navigator.outcome == "" and navigator.state.goal == before.goal
    np.testing.assert_array_equal(navigator.state.path, before.path)


def test_unknown_ground_may_be_crossed_only_while_mapping():
    site_map = floor_map(LAYOUT.site)
    site_map.states[:, 220:240] = -1
    navigator = Navigator(CONFIG, site_map)
    x = float(site_map.origin[0] + 230 * site_map.resolution)
    assert "unknown" in navigator.go(0.0, goal("far", (x, -0.65, 0.0)))
    navigator.surroundings.set_map(site_map, unknown_ok=True)
    assert navigator.go(0.0, goal("far", (x, -0.65, 0.0))) == ""


def test_a_clear_aisle_is_driven_at_speed_on_its_line():
    bench = NavBench((8.0, 1.55, 0.0))
    assert bench.go(goal("end", (13.9, 1.55, 0.0))) == "reached"
    rows = np.array(bench.rows)
    assert rows[:, 4].max() > 0.92
    assert np.abs(rows[:, 2] - 1.55).max() < 0.05
    assert bench.now < 5.9 / 0.95 + 2.5
    off = bench.believed() - (13.9, 1.55, 0.0)
    assert np.hypot(*off[:2]) < 0.010 and abs(wrap_angle(off[2])) < np.radians(0.5)


def test_into_a_dead_end_too_narrow_to_turn_and_out_again():
    bench = NavBench((11.0, 6.0, np.pi / 2))
    assert bench.go(goal("dead end", (13.3, 7.55, 0.0))) == "reached"
    began = bench.now
    assert bench.go(goal("out", (11.0, 5.75, np.pi))) == "reached"
    assert bench.now - began < 20 and bench.navigator.recoveries == 0 and not bench.collisions


def test_a_carton_that_appears_on_the_way_is_passed():
    carton = Obstacle(kind="carton", pose=(9.6, 1.25, 0.1), near=2.0)
    bench = NavBench((7.0, 1.55, 0.0), faults=Faults(obstacles=(carton,)))
    assert bench.go(goal("behind", (10.4, 1.55, 0.0))) == "reached"
    assert not bench.waiting and not bench.collisions


def test_a_low_box_that_only_the_camera_sees_is_passed():
    box = Obstacle(kind="low_box", pose=(9.4, 1.25, 0.0))
    bench = NavBench((7.0, 1.55, 0.0), faults=Faults(obstacles=(box,)))
    assert bench.go(goal("behind", (10.4, 1.55, 0.0))) == "reached"
    assert not bench.collisions


def test_a_closed_aisle_is_driven_round_through_another():
    wall = [Obstacle(kind="table", pose=(9.3, y, np.pi / 2), near=1.9) for y in (1.15, 1.95)]
    bench = NavBench((7.35, 1.55, 0.0), faults=Faults(obstacles=tuple(wall)))
    assert bench.go(goal("behind", (10.9, 1.55, 0.0)), limit=60) == "reached"
    assert bench.navigator.replans >= 1 and not bench.collisions


def test_a_goal_that_something_stands_on_is_given_up_with_a_reason():
    carton = Obstacle(kind="carton", pose=(9.8, 1.55, 0.0))
    bench = NavBench((8.3, 1.55, 0.0), faults=Faults(obstacles=(carton,)))
    outcome = bench.go(goal("there", (9.8, 1.55, 0.0)), limit=90)
    assert outcome.startswith("given up") and "\n" not in outcome
    assert np.abs(bench.rows[-1][4:]).max() < 0.05 and not bench.collisions


def test_a_cart_that_comes_towards_is_let_pass():
    cart = Mover(path=((7.0, 0.3), (7.0, 4.9)), speed=0.4, starts=0.0)
    bench = NavBench((7.2, 4.6, -np.pi / 2), faults=Faults(movers=(cart,)))
    bench.carts[0].way.travel = 0.5
    assert bench.go(goal("south", (7.35, -0.65, 0.0)), limit=60) == "reached"
    assert not bench.collisions


def test_a_pose_that_is_not_finite_stops_the_vehicle_and_the_next_good_one_goes_on():
    bench = NavBench(AISLE)
    bench.navigator.go(0.0, goal())
    for _ in range(80):
        bench.tick()
    stopped = bench.navigator.step(bench.now, np.array([np.nan, 0.0, 0.0]), REST)
    assert not stopped.as_array().any() and bench.navigator.active
    end = bench.now + 20
    while bench.navigator.active and bench.now < end:
        bench.tick()
    assert bench.navigator.outcome == "reached"


def test_carried_off_under_way_it_stops_and_plans_anew():
    """A tag tells at once that the vehicle stands in the next aisle: it does not drive back."""
    bench = NavBench(AISLE)
    bench.navigator.go(0.0, goal())
    for _ in range(120):
        bench.tick()
    carried = bench.pose + np.array([0.0, 2.1, 0.0])
    assert bench.navigator.follower.trajectory is not None
    for k in range(50):
        command = bench.navigator.step(bench.now + 0.01 * k, carried, REST)
        assert not command.as_array().any()
    assert bench.navigator.active

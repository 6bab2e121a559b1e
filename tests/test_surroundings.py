"""What stands about the vehicle: ground that was never looked at, refusals, a new belief."""

import numpy as np
from flat_world import floor, picture

from twin.layout import load_layout
from twin.messages import Goal
from twin.stack.config import nominal_config
from twin.stack.estimation.site_map import floor_map
from twin.stack.planning.clearance import Footprint, room
from twin.stack.planning.surroundings import Surroundings, shrunk

LAYOUT = load_layout()
CONFIG = nominal_config(LAYOUT.site, LAYOUT.options)
AISLE = np.array([9.3, 1.55, 0.0])


def surroundings():
    return Surroundings(CONFIG, floor_map(LAYOUT.site), Footprint())


def see(made, stamp, pose):
    plane = floor(0.0, -1.5, 15.0, 8.0)
    camera = CONFIG.rgbd
    assert made.hear(picture([plane], camera, camera.T_base_camera, pose, stamp=stamp), pose)


def test_ground_that_was_looked_at_is_no_longer_avoided():
    made = surroundings()
    beside = np.array([AISLE[0] + 0.6, AISLE[1], AISLE[2]])
    assert room(beside, Footprint(), made.unseen(AISLE)) <= 0
    for k in range(12):  # comes along the aisle from the west
        see(made, 0.1 * k, AISLE - [1.8 - 0.15 * k, 0.0, 0.0])
    assert room(beside, Footprint(), made.unseen(AISLE)) > 0.1
    # Nothing that the map shows is taken for ground.
    rack = np.array([9.3, 2.6, 0.0])
    assert np.hypot(*(made.unseen(AISLE)[:, :2] - rack[:2]).T).min(initial=9.0) > 0.25


def test_what_seems_to_reach_into_the_vehicle_does_not():
    made = surroundings()
    assert room(AISLE, Footprint(), made.unseen(AISLE)) > 0
    inside = np.array([[9.3, 1.55, 9.3, 1.55, 0.5, 0.0, 0.0]])
    assert room(AISLE, Footprint(), shrunk(inside, AISLE, Footprint())) > 0


def test_goals_are_refused_by_the_map():
    made = surroundings()
    assert made.refusal(Goal("good", tuple(AISLE))) == ""
    for pose, why in (
        ((9.3, 0.5, 0.0), "obstacle"),
        ((99.0, 0.0, 0.0), "off the map"),
        ((np.nan, 0.0, 0.0), "finite"),
    ):
        assert why in made.refusal(Goal("bad", pose))


def test_another_belief_forgets_what_was_seen():
    made = surroundings()
    see(made, 0.0, AISLE)
    assert made.layer.looked.any()
    made.set_belief(CONFIG)
    assert not made.layer.looked.any() and made.costs().cost(AISLE) < 253

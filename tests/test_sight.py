"""A band is driven through in thought: which ground will nobody have looked at?"""

import math

import numpy as np
import pytest

from twin.stack.planning.sight import SightOptions, first_unknown
from twin.stack.planning.teb_trajectory import Trajectory

R = 0.05
HALF = np.array([0.35, 0.25])
OPTIONS = SightOptions()
X = (np.arange(200) + 0.5) * R  # 10 m
SHAPE = (80, 200)


def band(start, end, seconds=6.0):
    """Straight from pose to pose at an even pace, at (x, y, yaw)."""
    share = np.linspace(0.0, 1.0, 31)
    poses = np.array(start) + share[:, None] * (np.array(end, float) - start)
    return Trajectory(np.column_stack([poses, share * seconds]), np.zeros(3))


def look(trajectory, known, solid=None, phase=0.0, within=99.0):
    solid = np.zeros(SHAPE, bool) if solid is None else solid
    return first_unknown(trajectory, phase, within, known, solid, R, np.zeros(2), HALF, OPTIONS)


def test_known_ground_is_driven_over_any_way():
    for end in ((7.0, 2.0, 0.0), (1.0, 2.0, 0.0), (4.0, 3.5, 0.0), (4.0, 2.0, 3.0)):
        assert look(band((4.0, 2.0, 0.0), end), np.ones(SHAPE, bool)) == (math.inf, None)


def test_in_reverse_it_comes_to_where_nobody_looked():
    """Expected result: when the tail, 0.35 m behind the middle, passes x = 3."""
    known = np.broadcast_to(X > 3.0, SHAPE)
    time, point = look(band((5.0, 2.0, 0.0), (2.0, 2.0, 0.0)), known)
    assert time == pytest.approx((5.0 - 3.35) / 0.5, abs=0.2)
    assert point == pytest.approx((2.97, 2.0), abs=0.05)
    later, _ = look(band((5.0, 2.0, 0.0), (2.0, 2.0, 0.0)), known, phase=2.0)
    assert later == pytest.approx(time - 2.0, abs=0.1)
    within = 0.5 * time
    assert look(band((5.0, 2.0, 0.0), (2.0, 2.0, 0.0)), known, within=within)[0] == math.inf


def test_ahead_the_camera_sees_it_in_time():
    known = np.broadcast_to(X < 4.0, SHAPE)
    assert look(band((2.0, 2.0, 0.0), (8.0, 2.0, 0.0)), known)[0] == math.inf
    near = np.broadcast_to(X < 2.5, SHAPE)  # what follows lies under its picture
    assert look(band((2.0, 2.0, 0.0), (8.0, 2.0, 0.0)), near)[0] < 1.0


def test_sideways_it_is_not_seen():
    known = np.broadcast_to((np.arange(80) * R < 2.6)[:, None], SHAPE)
    time, point = look(band((4.0, 2.0, 0.0), (4.0, 3.5, 0.0), seconds=3.0), known)
    assert time == pytest.approx((2.6 - 2.25) / 0.5, abs=0.2) and point[1] > 2.6


def test_what_is_hidden_is_not_seen():
    """Expected result: a wall between the camera and the ground that the vehicle comes to later."""
    known = np.broadcast_to(X < 4.0, SHAPE)
    solid = np.zeros(SHAPE, bool)
    solid[:, 75] = True  # x = 3.75 m
    assert look(band((2.0, 2.0, 0.0), (8.0, 2.0, 0.0)), known, solid)[0] < math.inf

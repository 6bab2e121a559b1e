"""Figures of the scenario `odometry` against hand-worked motions, and its drawn patches."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from evaluation.odometry import Aisle, CourseMonitor, step_errors
from scenarios import odometry
from twin.floor_plan import FOOTPRINT
from twin.geometry import compose2, wrap_angle
from twin.layout import Layout, WetPatch, load_layout
from twin.messages import CourseOrder
from twin.recording.codec import decode, encode

DT = 0.01
WHEELS = np.array([(0.2, 0.2), (0.2, -0.2), (-0.2, 0.2), (-0.2, -0.2)])
AISLE = Aisle(y=-0.65, x=(5.0, 14.0), cruise=0.85)


def watched(poses, wet=()) -> CourseMonitor:
    """A monitor that has seen true poses (n, 3) at 100 Hz; velocities by difference."""
    monitor, poses = CourseMonitor(wet, WHEELS), np.asarray(poses, dtype=float)
    change = np.vstack([np.zeros(3), np.diff(poses, axis=0)])
    change[:, 2] = wrap_angle(change[:, 2])
    for k, (pose, step) in enumerate(zip(poses, change / DT, strict=True)):
        monitor.observe(
            SimpleNamespace(stamp=k * DT, truth=SimpleNamespace(pose=pose, velocity=step))
        )
    return monitor


def straight(y: float, speed: float) -> np.ndarray:
    x = np.arange(4.0, 15.0, speed * DT)
    return np.column_stack([x, np.full(len(x), y), np.zeros(len(x))])


def test_cross_track_is_the_distance_from_the_drawn_line_at_cruise_alone():
    away, way = watched(straight(-0.62, 0.9)).cross_track(AISLE)
    assert away == pytest.approx(0.03) and way == pytest.approx(9.0, abs=0.05)
    assert np.isnan(watched(straight(-0.62, 0.5)).cross_track(AISLE)[0])
    across = straight(-0.62, 0.9)[:, [1, 0, 2]] + (13.0, -4.9, 0.0)  # crosses it at a right angle
    assert np.isnan(watched(across).cross_track(AISLE)[0])


def full_turn(angle: float, drift: float) -> np.ndarray:
    """At rest, a turn on the spot during which the middle strays by `drift` and comes back."""
    s = np.concatenate([np.zeros(20), np.linspace(0, 1, 500), np.ones(20)])
    x = 3.0 + drift * np.sin(np.pi * s)
    return np.column_stack([x, np.full(len(s), 1.0), wrap_angle(angle * s)])


@pytest.mark.parametrize("angle", [2 * np.pi, -2 * np.pi])
def test_turn_drift_is_the_greatest_displacement_while_turning_once(angle):
    turned = watched(full_turn(angle, 0.04))
    assert turned.turn_drift((3.0, 1.0)) == pytest.approx(0.04, abs=1e-4)
    assert np.isnan(turned.turn_drift((5.0, 1.0)))
    assert np.isnan(watched(full_turn(0.9 * angle, 0.04)).turn_drift((3.0, 1.0)))


def test_wheels_on_a_patch_are_counted():
    """Hand-worked: the patch covers the left wheels only, from the front ones on."""
    patch = WetPatch(x=(5.0, 6.0), y=(0.1, 1.0))
    poses = np.column_stack([np.arange(4.0, 7.0, 0.01), np.zeros(300), np.zeros(300)])
    seen = watched(poses, [patch])
    wet = seen.wheels_wet()
    assert wet[int(0.7 / DT)] == 0 and wet[int(1.0 / DT)] == 1 and wet[int(1.5 / DT)] == 2
    assert seen.dry_until() == pytest.approx(0.8, abs=0.011)
    assert watched(poses).dry_until() == np.inf


def test_errors_of_steps_are_those_of_the_odometry_alone():
    """Hand-worked: 0.9 m/s ahead, path reported 2 % long, the track turned and far off from it."""
    stamps = np.arange(0.0, 3.0, DT)
    true = np.column_stack([0.9 * stamps, np.zeros(len(stamps)), np.zeros(len(stamps))])
    track = np.array([compose2((5.0, -3.0, 1.2), (1.02 * x, y, yaw)) for x, y, yaw in true])
    off = step_errors((stamps, true), (stamps, track))
    assert off["step_path_error_mm"] == pytest.approx(0.02 * 0.9 * 0.5 * 1e3)
    assert off["step_first_turn_error_mrad"] == pytest.approx(0.0, abs=1e-6)
    rest = np.zeros((len(stamps), 3))
    assert np.isnan(step_errors((stamps, rest), (stamps, track))["step_path_error_mm"])
    nothing = np.zeros(0), np.zeros((0, 3))
    assert np.isnan(step_errors(nothing, nothing)["step_path_error_mm"])


def test_a_turn_that_never_was_is_no_small_drift():
    """Expected: NaN, which meets no criterion, unless the vehicle turned at both ends."""
    once = watched(full_turn(2 * np.pi, 0.01))
    way = odometry.Course(AISLE, (3.0, 1.0), (5.0, 1.0), ())
    assert np.isnan(odometry.worst_drift(once, way))
    both = odometry.Course(AISLE, (3.0, 1.0), (3.02, 1.0), ())
    assert odometry.worst_drift(once, both) == pytest.approx(0.01, abs=1e-4)


@pytest.mark.parametrize("seed", range(20))
def test_patches_lie_on_the_course_and_off_the_clear_aisle_and_its_turns(seed):
    way = odometry.drawn_course(load_layout().site)
    wet = odometry.patches(way, np.random.default_rng([seed, 1]))
    a, (x0, x1) = way.aisle, way.aisle.x
    reach = np.hypot(*FOOTPRINT) / 2
    for p in wet:
        in_aisle = p.x[0] < x1 + reach and p.x[1] > x0 - reach
        assert not in_aisle or p.y[0] > a.y + reach
    dry = np.array([way.route[0], *way.route[:6]], dtype=float)  # until once around
    dry[0] = 0.0
    path = np.concatenate([np.linspace(a, b, 300) for a, b in pairwise(dry)])
    assert not watched(path, wet).wheels_wet().any()
    later = np.array(way.route[6:], dtype=float)
    path = np.concatenate([np.linspace(a, b, 300) for a, b in pairwise(later)])
    assert watched(path, wet).wheels_wet().max() >= 2
    layout = load_layout()
    dump = layout.model_dump()
    dump["world"]["faults"]["wet"] = [p.model_dump() for p in wet]
    Layout.model_validate(dump)


@pytest.mark.parametrize("east, south", [(15.2, -1.5), (13.0, -1.5), (15.2, -1.4)])
def test_the_course_follows_the_walls(east, south):
    hall = (f"site.hall.x=[-1.0, {east}]", f"site.hall.y=[{south}, 8.0]")
    empty = ("racks", "tags", "places", "hall.partitions")
    layout = load_layout(None, (*hall, *(f"site.{name}=[]" for name in empty)))
    course = odometry.drawn_course(layout.site)
    assert course.aisle.x == (5.65, pytest.approx(east - 0.65))
    assert course.aisle.y == pytest.approx(south + 0.85)
    assert {course.east, course.west} <= {pose[:2] for pose in course.route}


def test_the_order_is_recorded_to_the_bit():
    order = CourseOrder(0.5, odometry.drawn_course(load_layout().site).route)
    assert decode(*encode(order)) == order

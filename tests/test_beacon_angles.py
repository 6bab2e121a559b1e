"""Angles, planes and rays by hand (Liu et al. 2022, Eqs. 1, 3-8, 29); gradients by differences."""

import numpy as np
import pytest
from beacon_world import BeaconWorld
from hypothesis import given, settings
from hypothesis import strategies as st

from twin.geometry import apply, inverse, rot_x, rot_z
from twin.stack.estimation.beacons.angles import (
    angles_of,
    azimuth_elevation,
    crossing_angle,
    measure,
    normal_derivatives,
    normals,
    rays,
    rotation_angle,
    turned,
)
from twin.stack.estimation.beacons.clocks import Aligned, Spin, align, spin
from twin.stack.estimation.beacons.stamps import Counter, HeadParameters, Noise, SyncSequence

HEAD = HeadParameters(0.80, 0.77, 1.60)
first_compiles = settings(deadline=None)
tilts = st.floats(0.5, 1.1)


def test_eq_1_by_hand():
    # Zero at 2.0 s and one turn of 0.1 s before: 2.025 s is a quarter turn later.
    assert rotation_angle(2.025, 2.0, 1.9) == pytest.approx(np.pi / 2)


@first_compiles
@given(tilts, tilts, st.floats(-2, 2))
def test_eq_29_as_written(a, b, c):
    n1 = rot_x(a) @ [0, 0, 1]
    n2 = rot_z(c) @ rot_x(-b) @ [0, 0, 1]
    assert normals(HeadParameters(a, b, c)) == pytest.approx(np.array([n1, n2]), abs=1e-14)


@first_compiles
@given(st.floats(-7, 7))
def test_eq_4(theta):
    n = normals(HEAD)[1]
    assert turned(theta, n) == pytest.approx(rot_z(theta) @ n, abs=1e-14)


def test_planes_by_hand():
    # Tilts of 45 degrees, traces at right angles. A node ahead at the height of the head meets
    # plane 1 when its trace points there, plane 2 a quarter turn before.
    head = HeadParameters(np.pi / 4, np.pi / 4, np.pi / 2)
    level = angles_of(np.array([0.0, 2.0, 0.0]), head)[0]
    assert level == pytest.approx([np.pi / 2, 0.0])
    # At 30 degrees of elevation: sin(az - theta) = tan(el) / tan(phi) for plane 1.
    el = np.pi / 6
    up = np.array([np.cos(1.0) * np.cos(el), np.sin(1.0) * np.cos(el), np.sin(el)])
    lead = np.arcsin(np.tan(el))
    theta = angles_of(up, head)[0]
    assert theta == pytest.approx([1.0 - lead, (1.0 + lead - np.pi / 2) % (2 * np.pi)])


def test_eq_7_by_hand_with_z_up():
    a, e = azimuth_elevation(np.array([1.0, 1.0, np.sqrt(2.0)]))
    assert (a, e) == pytest.approx((np.pi / 4, np.pi / 4))
    a, e = azimuth_elevation(np.array([[-1.0, 0.0, 0.0], [0.0, 2.0, -2.0]]))
    assert a == pytest.approx([np.pi, np.pi / 2]) and e == pytest.approx([0.0, -np.pi / 4])


@first_compiles
@given(
    st.floats(-3.1, 3.1), st.floats(-0.4, 0.4), st.floats(0.3, 20), tilts, tilts, st.floats(1, 2)
)
def test_rays_point_at_the_node(azimuth, elevation, distance, a, b, c):
    """Eqs. 4, 5, 6, 8: the planes at their angles hold the node, and their line points to it."""
    head = HeadParameters(a, b, c)
    d = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation),
                  np.sin(elevation)])  # fmt: skip
    theta = angles_of(distance * d, head)[0]
    for k in range(2):
        assert turned(theta[k], normals(head)[k]) @ d == pytest.approx(0.0, abs=1e-9)  # Eq. 5
    assert rays(theta[0], theta[1], head) == pytest.approx(d, abs=1e-6)
    assert azimuth_elevation(rays(*theta, head)) == pytest.approx((azimuth, elevation), abs=1e-6)


def test_a_node_too_steep_is_never_met():
    assert np.all(np.isnan(angles_of(np.array([0.1, 0.0, 5.0]), HEAD)))


@first_compiles
@given(st.floats(-3, 3), st.floats(-0.3, 0.3), st.integers(0, 1))
def test_gradient_of_a_crossing(azimuth, height, k):
    p = np.array([3 * np.cos(azimuth), 3 * np.sin(azimuth), 3 * height])
    n = normals(HEAD)
    _, *gradient = crossing_angle(n[k], k, p)
    for i in range(3):
        e = 1e-6 * np.eye(3)[i]
        low, high = (crossing_angle(n[k], k, p + s * e)[0] for s in (-1, 1))
        slope = np.remainder(high - low + np.pi, 2 * np.pi) - np.pi
        assert gradient[i] == pytest.approx(slope / 2e-6, abs=1e-7)


def test_derivatives_of_the_normals():
    for i in range(3):
        e = 1e-6 * np.eye(3)[i]
        low, high = (normals(HeadParameters(*(HEAD.as_array() + s * e))) for s in (-1, 1))
        assert normal_derivatives(HEAD)[i] == pytest.approx((high - low) / 2e-6, abs=1e-9)


def measured(world, rng, noisy=True):
    stamps, counter, noise = world.batch(rng, noisy), Counter(), Noise()
    found = align(stamps, SyncSequence(), counter, noise)
    assert isinstance(found, Aligned)
    turn = spin(stamps, found, world.spin_rate, counter, noise)
    assert isinstance(turn, Spin)
    return measure(stamps, found, turn, counter, noise)


def test_eq_3_from_raw_stamps():
    """Against angles of the true geometry: a tick at 30 turns a second is 2 microradians."""
    world = BeaconWorld(head=HEAD)
    seen = measured(world, np.random.default_rng(0), noisy=False)
    true = angles_of(apply(inverse(world.head_pose(0.0)), world.nodes), HEAD)
    assert len(seen.theta) == 12
    assert seen.theta == pytest.approx(true[seen.node, seen.plane], abs=8e-6)


def test_covariance_of_the_angles():
    """Whitened errors of 150 noisy revolutions are standard normal, the shared ones too."""
    world, rng = BeaconWorld(head=HEAD), np.random.default_rng(1)
    true = angles_of(apply(inverse(world.head_pose(0.0)), world.nodes), HEAD)
    squares, shared = [], []
    for _ in range(150):
        seen = measured(world, rng)
        e = seen.theta - true[seen.node, seen.plane]
        squares.append(e @ np.linalg.solve(seen.covariance, e) / len(e))
        shared.append(e.sum() / np.sqrt(seen.covariance.sum()))
    assert np.mean(squares) == pytest.approx(1.0, abs=0.12)
    assert np.std(shared) == pytest.approx(1.0, abs=0.2)

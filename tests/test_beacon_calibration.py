"""Planes by bundle adjustment (Liu et al. 2022, Eqs. 29-33), the mount from stops, the bounds."""

from dataclasses import replace

import numpy as np
import pytest
from beacon_world import NAMES, TRUSS, BeaconWorld
from scipy.optimize import least_squares

from twin.geometry import between2, inverse, rot_x, rot_y, rot_z, transform
from twin.stack.estimation.beacons.angles import Crossings, angles_of, normals
from twin.stack.estimation.beacons.bound import (
    Setting,
    calibration_bound,
    pose_bound,
    position_sigma,
)
from twin.stack.estimation.beacons.calibration import Bundle, average, calibrate
from twin.stack.estimation.beacons.fix import Locator
from twin.stack.estimation.beacons.mount import Stop, _linearised, calibrate_mount
from twin.stack.estimation.beacons.refine import linearise, motion
from twin.stack.estimation.beacons.rigid import euler_xyz, exp_rotation
from twin.stack.estimation.beacons.stamps import HeadParameters, NodeSurvey, Noise

NOMINAL = HeadParameters()
BUILT = HeadParameters(np.pi / 4 + 0.004, np.pi / 4 - 0.003, np.pi / 2 + 0.005)
PLACES = [(0, 0, 0), (0.8, 0.6, 0.3), (-0.4, -0.6, -0.3), (0.5, -0.8, 0.5), (1, 0.2, -0.4)]


def base(x, y, yaw):
    return transform(rot_z(yaw), (x, y, 0.0))


def revolutions(world, rng, noisy=True, places=PLACES, locator=None):
    place, seen = locator or Locator(world.survey()), []
    for pose in places:
        world.T_world_base = base(*pose)
        found = place.crossings(world.batch(rng, noisy))
        assert isinstance(found, tuple)
        seen.append(found[0])
    return seen


# --- planes -------------------------------------------------------------------------------------


def test_angles_are_recovered_from_exact_stamps():
    """Expected result: what ticks leave; the drawing is 3 to 5 mrad off."""
    world = BeaconWorld(head=BUILT)
    found = calibrate(revolutions(world, np.random.default_rng(0), False), world.survey(), NOMINAL)
    off = found.head.as_array() - BUILT.as_array()
    assert np.all(np.abs(off) < 0.2 * np.sqrt(np.diag(found.covariance)))
    assert found.freedom == 60 - 33 and not found.rejected
    T = base(*PLACES[1]) @ world.T_base_head
    assert found.p[1] == pytest.approx(T[:3, 3], abs=1e-3)


def test_errors_of_the_angles_reach_their_bound():
    """25 calibrations, the survey wrong by a new draw each time."""
    world, rng, errors = BeaconWorld(head=BUILT), np.random.default_rng(1), []
    for _ in range(25):
        survey = world.survey(rng)
        found = calibrate(revolutions(world, rng), survey, NOMINAL)
        errors.append(found.head.as_array() - BUILT.as_array())
    heads = [base(*pose) @ world.T_base_head for pose in PLACES]
    bound = calibration_bound(heads, Setting(world.survey(), BUILT))
    ratio = np.sqrt(np.mean(np.square(errors), axis=0) / np.diag(bound))
    assert np.all(ratio < 1.4) and np.all(ratio > 0.65)
    assert np.diag(found.covariance) == pytest.approx(np.diag(bound), rel=0.05)


def test_same_cost_as_scipy():
    """SciPy on the same residuals with a numeric Jacobian ends at the same cost, not below."""
    world, rng = BeaconWorld(head=BUILT), np.random.default_rng(2)
    stops = revolutions(world, rng, places=PLACES[:3])
    found = calibrate(stops, world.survey(), NOMINAL)
    bundle = Bundle(stops, world.survey(), NOMINAL)
    theirs = least_squares(bundle.residuals, np.zeros(bundle.unknowns), x_scale="jac")
    assert found.cost == pytest.approx(2 * theirs.cost, rel=1e-4)


def test_derivatives_of_the_bundle():
    world = BeaconWorld(head=BUILT)
    bundle = Bundle(revolutions(world, np.random.default_rng(0)), world.survey(), NOMINAL)
    part = bundle.linearised(bundle.start, 1)
    assert part is not None
    _, shared, own = part
    whole = np.zeros((bundle.unknowns, 12))
    first = len(bundle.residuals(np.zeros(bundle.unknowns))) - 12 * len(PLACES) + 12
    for i in range(bundle.unknowns):
        e = 1e-6 * np.eye(bundle.unknowns)[i]
        slope = (bundle.residuals(-e) - bundle.residuals(e)) / 2e-6
        whole[i] = slope[first : first + 12]
    size = np.abs(whole).max()
    assert shared == pytest.approx(whole[:21].T, abs=1e-5 * size)
    assert own == pytest.approx(whole[21 + 6 : 21 + 12].T, abs=1e-5 * size)


def test_a_reflection_in_one_stop_is_left_out():
    world, rng = BeaconWorld(head=BUILT), np.random.default_rng(3)
    stops = revolutions(world, rng)
    theta = stops[2].theta.copy()
    theta[5] += 0.002
    stops[2] = type(stops[2])(
        stops[2].node, stops[2].plane, theta, stops[2].time, stops[2].covariance, stops[2].rate
    )
    found = calibrate(stops, world.survey(), NOMINAL)
    assert (2, NAMES[stops[2].node[5]], int(stops[2].plane[5]) + 1) in found.rejected
    off = found.head.as_array() - BUILT.as_array()
    assert off @ np.linalg.solve(found.covariance, off) < 16.0


def test_average_of_revolutions():
    world, rng = BeaconWorld(head=BUILT), np.random.default_rng(4)
    seen = revolutions(world, rng, places=[(0, 0, 0)] * 16)
    mean = average(seen)
    exact = revolutions(world, rng, False, places=[(0, 0, 0)])[0]
    order = np.argsort(2 * mean.node + mean.plane)
    expected = exact.theta[np.argsort(2 * exact.node + exact.plane)]
    assert mean.theta[order] == pytest.approx(expected, abs=1e-4)
    assert np.diag(mean.covariance) == pytest.approx(np.diag(seen[0].covariance) / 16, rel=0.3)
    with pytest.raises(ValueError, match="no revolutions"):
        average([])


def test_calibration_that_cannot_be_is_refused():
    world, rng = BeaconWorld(head=BUILT, blocked=NAMES[4:]), np.random.default_rng(5)
    with pytest.raises(ValueError, match="4 nodes seen, wanted 5"):
        calibrate(revolutions(world, rng), world.survey(), NOMINAL)
    blurred = BeaconWorld(head=BUILT, noise=Noise(crossing=2e-5))
    place = Locator(blurred.survey(), noise=blurred.noise)
    with pytest.raises(ValueError, match="do not determine phi_1, phi_2, phi_r"):
        calibrate(revolutions(blurred, rng, locator=place), blurred.survey(), NOMINAL)


def exact_stops(head, places=PLACES):
    """Angles of all crossings without noise or ticks, believed to 50 microradians."""
    node, plane, sigma = np.repeat(np.arange(6), 2), np.tile([0, 1], 6), 50e-6
    mount, stops = BeaconWorld().T_base_head, []
    for pose in places:
        T = base(*pose) @ mount
        theta = angles_of((TRUSS - T[:3, 3]) @ T[:3, :3], head).ravel()
        stops.append(Crossings(node, plane, theta, np.zeros(12), sigma**2 * np.eye(12), 188.5))
    return stops


def printed_distance(R, t, theta, N, P):
    """Eq. 30 with R from head to world: (R R_theta N) . (P - t), m."""
    return float((R @ rot_z(theta) @ N) @ (np.asarray(P) - t))


def test_eqs_30_and_31_by_hand():
    """Head at (1, 2, 0.5), turned a quarter about z: a node at (1, 5, 0.5) is 3 m ahead, level.

    Expected: plane 1 meets it at 0, plane 2 a quarter turn earlier. A node 0.3 m higher stands
    0.3 cos 45 over plane 1 then (Eq. 30, m); in angle, arcsin(0.1), as sin = tan(el) / tan(phi).
    """
    R, t = rot_x(0.0) @ rot_y(0.0) @ rot_z(np.pi / 2), np.array([1.0, 2.0, 0.5])
    half = np.sqrt(0.5)
    N1, N2 = np.array([0, -half, half]), np.array([-half, 0, half])
    assert normals(NOMINAL) == pytest.approx(np.array([N1, N2]))
    assert printed_distance(R, t, 0.0, N1, (1, 5, 0.5)) == pytest.approx(0.0)
    assert printed_distance(R, t, -np.pi / 2, N2, (1, 5, 0.5)) == pytest.approx(0.0)
    assert printed_distance(R, t, 0.0, N1, (1, 5, 0.8)) == pytest.approx(0.3 * half)
    nodes, rows = np.array([[1, 5, 0.5], [1, 5, 0.8]]), np.arange(3)
    r, J = np.empty(3), np.empty((3, 6))
    A, s = motion(np.zeros(6), np.zeros(3))
    node, plane, theta = np.array([0, 0, 1]), np.array([0, 1, 0]), np.array([0, -np.pi / 2, 0])
    seen = nodes, node, plane, theta
    assert linearise(R, t, rows, *seen, normals(NOMINAL), A, s, r, J)
    assert r == pytest.approx([0.0, 0.0, np.arcsin(0.1)], abs=1e-12)


def test_eqs_32_and_33_the_printed_sum_is_least_where_the_calibration_ends():
    """By any of the nine unknowns of Eq. 31 a step away, the printed sum of squares grows."""
    stops = exact_stops(BUILT)
    found = calibrate(stops, NodeSurvey(NAMES, TRUSS, np.full(6, 30e-6)), NOMINAL)

    def printed(phi, euler, t, k):
        R = rot_x(euler[0]) @ rot_y(euler[1]) @ rot_z(euler[2])
        N, stop = normals(HeadParameters(*phi)), stops[k]
        return sum(
            printed_distance(R, t, theta, N[plane], TRUSS[node]) ** 2
            for node, plane, theta in zip(stop.node, stop.plane, stop.theta, strict=True)
        )

    for k in range(len(stops)):
        best = np.concatenate([found.head.as_array(), euler_xyz(found.R[k]), found.p[k]])
        least = printed(best[:3], best[3:6], best[6:], k)
        assert least < 12 * (1e-6) ** 2
        for step in 1e-4 * np.vstack([np.eye(9), -np.eye(9)]):
            moved = best + step
            assert printed(moved[:3], moved[3:6], moved[6:], k) > 10 * least + 1e-9


# --- mount --------------------------------------------------------------------------------------

MOUNT = transform(rot_z(-2.5) @ rot_y(0.01) @ rot_x(-0.02), (0.12, -0.03, 0.61))
DRAWN = transform(rot_z(-2.45), (0.1, 0.0, 0.6))


def drive(rng, scale, places=PLACES):
    """Stops with errors of `scale` times 1 mm and 0.3 mrad, odometry ten times worse."""
    sigma = np.array([1e-3] * 3 + [3e-4] * 3)
    way_sigma = np.array([2e-3, 2e-3, 2e-3])
    stops, before = [], None
    for pose in places:
        T, e = base(*pose) @ MOUNT, scale * sigma * rng.standard_normal(6)
        T = transform(T[:3, :3] @ exp_rotation(e[3:]), T[:3, 3] + e[:3])
        way = None
        if before is not None:
            way = between2(before, pose) + scale * way_sigma * rng.standard_normal(3)
        stops.append(Stop(T, np.diag(sigma**2), way, np.diag(way_sigma**2)))
        before = pose
    return stops


def test_mount_from_exact_stops():
    found = calibrate_mount(drive(np.random.default_rng(0), 0.0), DRAWN)
    assert found.T_base_head == pytest.approx(MOUNT, abs=1e-8)


def test_errors_of_the_mount_fit_its_covariance():
    rng, squares = np.random.default_rng(1), []
    for _ in range(60):
        found = calibrate_mount(drive(rng, 1.0, PLACES * 2), DRAWN)
        T = inverse(MOUNT) @ found.T_base_head
        e = np.concatenate([MOUNT[:3, :3] @ T[:3, 3], [T[2, 1], T[0, 2], T[1, 0]]])
        squares.append(e @ np.linalg.solve(found.covariance, e))
    assert np.mean(squares) == pytest.approx(6.0, abs=1.4)
    assert found.freedom == 60 + 27 - 36


def test_the_mount_follows_the_poses_of_the_stops():
    stops = drive(np.random.default_rng(0), 0.0)
    found = calibrate_mount(stops, DRAWN)
    for k in range(len(stops)):
        for i in range(6):
            e = 1e-5 * np.eye(6)[i]
            T = stops[k].T_world_head
            T = transform(T[:3, :3] @ exp_rotation(e[3:]), T[:3, 3] + e[:3])
            moved = [*stops[:k], replace(stops[k], T_world_head=T), *stops[k + 1 :]]
            after = calibrate_mount(moved, DRAWN).T_base_head
            turn = MOUNT[:3, :3].T @ after[:3, :3]
            left = np.concatenate(
                [after[:3, 3] - MOUNT[:3, 3], [turn[2, 1], turn[0, 2], turn[1, 0]]]
            )
            assert found.by_stops[:, 6 * k + i] == pytest.approx(left / 1e-5, abs=2e-3)


def test_derivatives_of_the_mount():
    stops = drive(np.random.default_rng(0), 0.0)
    bases = np.array(PLACES, dtype=float)
    J = _linearised(stops, MOUNT, bases)[1]
    for i in range(J.shape[1]):
        e = 1e-6 * np.eye(J.shape[1])[i]
        ends = []
        for step in (e, -e):
            T = transform(MOUNT[:3, :3] @ exp_rotation(step[3:6]), MOUNT[:3, 3] + step[:3])
            ends.append(_linearised(stops, T, bases + step[6:].reshape(-1, 3))[0])
        assert J[:, i] == pytest.approx((ends[1] - ends[0]) / 2e-6, abs=1e-2)


def test_mount_that_stops_leave_open():
    rng = np.random.default_rng(0)
    straight = [(0.3 * i, 0.0, 0.0) for i in range(6)]
    with pytest.raises(ValueError, match="shift x, shift y"):
        calibrate_mount(drive(rng, 1.0, straight), DRAWN)
    with pytest.raises(ValueError, match="2 stops, wanted 3"):
        calibrate_mount(drive(rng, 1.0)[:2], DRAWN)
    broken = drive(rng, 1.0)
    broken[1] = Stop(np.full((4, 4), np.nan), np.eye(6), np.zeros(3), np.eye(3))
    with pytest.raises(ValueError, match="stop 1 is not finite"):
        calibrate_mount(broken, DRAWN)


# --- bounds -------------------------------------------------------------------------------------


def survey(nodes, sigma=30e-6):
    return NodeSurvey(tuple(f"T{i}" for i in range(len(nodes))), nodes, np.full(len(nodes), sigma))


def test_linearised_study_of_the_source():
    """A flat truss of 2 m x 1 m, three nodes, 50 microradians: the pattern 0.40, 2.62, 2.80 mm."""
    T = BeaconWorld().head_pose(0.0)
    sigma = 1e3 * position_sigma(pose_bound(T, Setting(survey(TRUSS[:3]))))
    assert sigma[0] < 0.2 * min(sigma[1], sigma[2])
    assert sigma == pytest.approx([0.40, 2.62, 2.80], rel=0.5)
    every = 1e3 * position_sigma(pose_bound(T, Setting(survey(TRUSS))))
    assert np.all(every < sigma)


def test_bound_grows_as_it_must():
    T = BeaconWorld().head_pose(0.0)

    def sigma(error=0.0, **noise):
        figures = {"crossing": 1e-9, "sync": 1e-9, "spin_jitter": 1e-9} | noise
        return position_sigma(pose_bound(T, Setting(survey(TRUSS, error), noise=Noise(**figures))))

    one, two = sigma(crossing=1e-6), sigma(crossing=2e-6)
    assert two == pytest.approx(2 * one, rel=0.01)
    for alone in ({"sync": 1e-6}, {"spin_jitter": 1e-3}, {"error": 1e-3}):
        assert np.all(sigma(crossing=1e-6, **alone) >= one)
        assert np.any(sigma(crossing=1e-6, **alone) > 1.05 * one)
    # Where nothing but the survey errs, the pose errs in proportion.
    assert sigma(error=2e-3) == pytest.approx(2 * sigma(error=1e-3), rel=0.01)


def test_bound_without_clocks_is_that_of_the_angles():
    """By hand: two nodes' worth of geometry is too few, and averaging goes with the root."""
    T = BeaconWorld().head_pose(0.0)
    assert np.all(np.isinf(pose_bound(T, Setting(survey(TRUSS[:2])))))
    once = pose_bound(T, Setting(survey(TRUSS, 0.0)))
    often = pose_bound(T, Setting(survey(TRUSS, 0.0), revolutions=100))
    assert often == pytest.approx(once / 100, rel=0.02, abs=1e-12)
    line = np.column_stack([np.full(4, 4.0), np.linspace(-1, 1, 4), np.full(4, 0.6)])
    assert np.all(np.isinf(pose_bound(T, Setting(survey(line)))))


def test_bound_of_a_moving_head_is_near_that_at_rest():
    T = BeaconWorld().head_pose(0.0)
    still = pose_bound(T, Setting(survey(TRUSS)))
    moving = pose_bound(T, Setting(survey(TRUSS)), np.array([0.4, 0.3, 0, 0, 0, 0.5]))
    assert position_sigma(moving) == pytest.approx(position_sigma(still), rel=0.05)

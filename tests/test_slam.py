"""Scan matching, pose graph and mapper in flat rooms."""

from itertools import pairwise

import numpy as np
import pytest
from flat_world import box, scan
from hypothesis import given, settings
from hypothesis import strategies as st

from twin.geometry import between2, compose2, wrap_angle
from twin.messages import LidarScan
from twin.stack.estimation.depth_to_scan import DepthScan
from twin.stack.estimation.grid_fusion import fuse
from twin.stack.estimation.likelihood_field import LikelihoodField
from twin.stack.estimation.occupancy_grid import OccupancyGrid, SensorModel
from twin.stack.estimation.pose_graph import Edge, PoseGraph, edge_error, edge_jacobians
from twin.stack.estimation.scan_matching import match_scan
from twin.stack.estimation.scans import beam_points
from twin.stack.estimation.slam import Slam, SlamSettings

ROOM = np.concatenate([box(-3.01, -2.02, 2.97, 1.98), box(1.0, 0.5, 1.6, 1.3)])
NUMBER = st.floats(-2, 2)
POSES = st.tuples(NUMBER, NUMBER, st.floats(-3, 3)).map(np.array)


@pytest.fixture(scope="module")
def field():
    rng = np.random.default_rng(0)
    grid = OccupancyGrid.covering((-4, -3), (4, 3), 0.05)
    for pose in rng.uniform((-2, -1.5, -3), (0.5, 1.5, 3), (25, 3)):
        grid.insert_scan(scan(ROOM, pose, rng), pose, SensorModel())
    return LikelihoodField(grid.occupied, grid.origin, grid.resolution, 0.5)


def test_scan_is_put_where_it_was_taken(field):
    """Expected result: 20 mm and 0.3 degrees (half a cell) from a guess off by 0.2 m and 5."""
    rng = np.random.default_rng(1)
    for pose in rng.uniform((-2, -1.5, -3), (0.5, 1.5, 3), (25, 3)):
        guess = pose + rng.uniform(-1, 1, 3) * (0.2, 0.2, 0.087)
        match = match_scan(field, beam_points(scan(ROOM, pose, rng)), guess)
        assert match is not None and match.inliers > 0.9
        error = match.pose - pose
        assert np.hypot(*error[:2]) < 0.02
        assert abs(wrap_angle(error[2])) < np.radians(0.3)


def test_bare_corridor_is_known_across_only():
    grid = OccupancyGrid.covering((-20, -3), (20, 3), 0.05)
    walls = np.array([[(-40, -1.02), (40, -1.02)], [(-40, 1.03), (40, 1.03)]], dtype=float)
    for x in np.linspace(-8, 8, 9):
        pose = np.array([x, 0.0, 0.0])
        reading = scan(walls, pose)
        grid.insert_scan(reading, pose, SensorModel())
    field = LikelihoodField(grid.occupied, grid.origin, 0.05, 0.5)
    reading = scan(walls, np.zeros(3), np.random.default_rng(0))
    match = match_scan(field, beam_points(reading, 6.0), np.array([0.05, 0.06, 0.03]))
    assert match is not None and abs(match.pose[1]) < 0.02 and abs(match.pose[2]) < 0.01
    along, across = np.sqrt(np.diag(match.covariance)[:2])
    assert along > 5 * across and match.conditioning < 0.15


def test_useless_matches_are_none(field):
    points = np.zeros((50, 2))
    for bad_points, guess in (
        (np.zeros((0, 2)), np.zeros(3)),
        (np.full((50, 2), np.nan), np.zeros(3)),
        (np.zeros((50, 3)), np.zeros(3)),
        (points, np.array([np.nan, 0, 0])),
        (points, np.array([500.0, 0, 0])),
        (points, np.zeros(2)),
    ):
        assert match_scan(field, bad_points, guess) is None


# --- pose graph -------------------------------------------------------------------------------


@given(POSES, POSES, POSES)
@settings(max_examples=50, deadline=None)
def test_jacobians_are_those_of_finite_differences(a, b, measured):
    edge = Edge(0, 1, measured, np.eye(3))
    if abs(abs(edge_error(edge, [a, b])[2]) - np.pi) < 1e-3:
        return  # the error jumps there
    for which, J in enumerate(edge_jacobians(edge, [a, b])):
        for k in range(3):
            ends = []
            for h in (1e-6, -1e-6):
                poses = [a.copy(), b.copy()]
                poses[which][k] += h
                ends.append(edge_error(edge, poses))
            np.testing.assert_allclose((ends[0] - ends[1]) / 2e-6, J[:, k], atol=1e-6)


def drifted_square(rng, sides=4, steps=8):
    """Chain round a square with noisy increments; true poses and the graph."""
    covariance = np.diag([0.02**2, 0.02**2, 0.01**2])
    true = [np.zeros(3)]
    graph = PoseGraph(np.zeros(3), np.full(3, 1e-3))
    for i in range(sides * steps):
        turn = np.pi / 2 if i % steps == steps - 1 else 0.0
        step = np.array([0.5, 0.0, turn])
        true.append(compose2(true[-1], step))
        graph.append(step + rng.normal(0, (0.02, 0.02, 0.01)), covariance)
    return np.array(true), graph


def dense_step(graph):
    """One Gauss-Newton step with a full matrix, for comparison."""
    n = len(graph.poses)
    H, b = np.zeros((3 * n, 3 * n)), np.zeros(3 * n)
    H[:3, :3] += np.diag(graph.first_sigma**-2.0)
    b[:3] += graph.first_sigma**-2.0 * (graph.poses[0] - graph.first)
    for node, pose, covariance in graph.anchors:
        rows, W = slice(3 * node, 3 * node + 3), np.linalg.inv(covariance)
        H[rows, rows] += W
        b[rows] += W @ (graph.poses[node] - pose)
    for edge in graph.chain + graph.loops:
        J = np.zeros((3, 3 * n))
        A, B = edge_jacobians(edge, graph.poses)
        J[:, 3 * edge.start : 3 * edge.start + 3] = A
        J[:, 3 * edge.to : 3 * edge.to + 3] = B
        W = np.linalg.inv(edge.covariance)
        H += J.T @ W @ J
        b += J.T @ W @ edge_error(edge, graph.poses)
    return -np.linalg.solve(H, b).reshape(n, 3)


def test_sparse_step_is_the_dense_one():
    _, graph = drifted_square(np.random.default_rng(2), steps=4)
    n = len(graph.poses) - 1
    for start, to in ((0, n), (2, n - 1), (n - 3, 1)):
        edge = Edge(start, to, np.array([0.1, 0.2, 0.3]), np.diag([1e-4, 2e-4, 1e-4]))
        assert graph.close(edge, gate=np.inf)
    graph.anchor(5, graph.poses[5] + 0.01, np.diag([1e-4, 1e-4, 1e-5]))
    np.testing.assert_allclose(graph._step(), dense_step(graph), rtol=1e-6, atol=1e-8)


def test_closing_a_loop_takes_out_the_drift():
    true, graph = drifted_square(np.random.default_rng(3))
    n = len(true) - 1
    before = np.abs(np.array(graph.poses) - true)[:, :2].max()
    covariance = np.diag([0.005**2, 0.005**2, 0.002**2])
    graph.close(Edge(0, n, between2(true[0], true[n]), covariance))
    assert graph.optimise() < 3
    after = np.abs(np.array(graph.poses) - true)[:, :2].max()
    assert before > 0.1 and after < 0.5 * before
    np.testing.assert_allclose(between2(graph.poses[0], graph.poses[n])[:2], 0, atol=0.01)


def test_a_wrong_loop_is_left_out():
    true, graph = drifted_square(np.random.default_rng(3))
    n, covariance = len(true) - 1, np.diag([0.01**2, 0.01**2, 0.005**2])
    assert not graph.close(Edge(0, n // 2, np.zeros(3), covariance))
    assert not graph.close(Edge(n, n // 2, np.zeros(3), covariance))
    assert graph.close(Edge(0, n // 2, between2(true[0], true[n // 2]), covariance))
    assert graph.close(Edge(n, n // 2, between2(true[n], true[n // 2]), covariance))
    assert len(graph.loops) == 2


def test_a_wrong_loop_that_the_loose_chain_allows_is_taken_out_again():
    """Expected result: two right loops hold; one between, 0.15 m off, passes the chain's gate."""
    true, graph = drifted_square(np.random.default_rng(3))
    n, covariance = len(true) - 1, np.diag([0.01**2, 0.01**2, 0.005**2])
    for start, to in ((0, n), (2, n - 2)):
        assert graph.close(Edge(start, to, between2(true[start], true[to]), covariance))
        assert graph.settle()
    settled = np.array(graph.poses)
    wrong = between2(true[1], true[n - 1]) + np.array([0.15, 0.0, 0.0])
    assert graph.close(Edge(1, n - 1, wrong, covariance))
    assert not graph.settle() and len(graph.loops) == 2
    np.testing.assert_array_equal(np.array(graph.poses), settled)


def test_anchored_chain_does_not_bend_to_a_wrong_loop():
    true, graph = drifted_square(np.random.default_rng(3))
    graph.poses = list(true)
    n, covariance = len(true) - 1, np.diag([0.01**2, 0.01**2, 0.005**2])
    for node in range(1, n + 1, 4):
        graph.anchor(node, true[node], np.diag([0.01**2, 0.01**2, 0.005**2]))
    graph.optimise()
    held = np.array(graph.poses)
    assert np.hypot(*(held - true)[:, :2].T).max() < 0.07  # 0.13 without anchors
    wrong = between2(true[1], true[n - 1]) + np.array([0.20, 0.0, 0.0])
    assert graph.close(Edge(1, n - 1, wrong, covariance))
    assert not graph.settle() and not graph.loops
    np.testing.assert_array_equal(np.array(graph.poses), held)


def test_chain_covariance_is_that_of_many_drives():
    """Expected result: spread of the end of 1500 noisy chains, seen from either end."""
    rng, ends, backs = np.random.default_rng(5), [], []
    for _ in range(1500):
        _, graph = drifted_square(rng, sides=2, steps=4)
        ends.append(between2(graph.poses[1], graph.poses[8]))
        backs.append(between2(graph.poses[8], graph.poses[1]))
    true, graph = drifted_square(rng, sides=2, steps=4)
    graph.poses = list(true)
    for sample, (start, to) in ((ends, (1, 8)), (backs, (8, 1))):
        sample = np.array(sample)
        sample[:, 2] = wrap_angle(sample[:, 2] - between2(true[start], true[to])[2])
        found = np.sqrt(np.diag(graph.chain_covariance(start, to)))
        np.testing.assert_allclose(found, sample.std(axis=0), rtol=0.1)


def test_loops_that_make_no_sense_are_refused():
    _, graph = drifted_square(np.random.default_rng(0), steps=2)
    with pytest.raises(ValueError, match="nodes are 0 to 8"):
        graph.close(Edge(0, 99, np.zeros(3), np.eye(3)))
    with pytest.raises(ValueError, match="not finite"):
        graph.close(Edge(0, 4, np.full(3, np.nan), np.eye(3)))
    assert not graph.loops and graph.optimise() == 0.0


# --- mapper -----------------------------------------------------------------------------------

LIDAR = np.array([0.3, 0.0, 0.0])
HALL = np.concatenate(
    [box(-7.01, -5.02, 6.98, 4.97), box(-4.5, -2.6, 4.52, -0.6), box(-4.5, 0.9, 4.5, 2.6)]
)


def tour(speed=0.12):
    """Poses of a drive once round the lower block of the hall, and on a little."""
    corners = np.array([(-5.5, -3.8), (5.5, -3.8), (5.5, 0.15), (-5.5, 0.15)])
    route = [*corners, corners[0], corners[0] + (2.0, 0.0)]
    poses, yaw = [], 0.0
    for a, b in pairwise(route):
        heading = np.arctan2(*(b - a)[::-1])
        turn = wrap_angle(heading - yaw)
        poses += [np.array([*a, yaw + turn * k / 6]) for k in range(6)]
        yaw = heading
        n = int(np.hypot(*(b - a)) / speed)
        poses += [np.array([*(a + (b - a) * k / n), yaw]) for k in range(n)]
    return poses


def drive(settings_, rng, poses, drift=(0.015, 0.012, 0.006)):
    """Run the mapper with odometry that creeps: a scale error, a sideways one, a turn."""
    mapper = Slam((-8, -6), (8, 6), 0.05, poses[0], (0.01, 0.01, 0.005), LIDAR, settings_)
    odometry, errors = np.array([0.0, 0.0, 0.0]), []
    for k, pose in enumerate(poses):
        if k:
            step = between2(poses[k - 1], pose)
            length = np.hypot(*step[:2])
            step = step + length * np.array(drift) * (1, 1, 1) + rng.normal(0, 5e-4, 3)
            odometry = compose2(odometry, step)
        assert mapper.add_scan(scan(HALL, compose2(pose, LIDAR), rng, stamp=0.1 * k), odometry)
        errors.append(np.hypot(*(mapper.pose - pose)[:2]))
    off = np.hypot(*(compose2(poses[0], odometry) - poses[-1])[:2])
    return mapper, np.array(errors), off


@pytest.fixture(scope="module")
def toured():
    poses = tour()
    return poses, *drive(SlamSettings(), np.random.default_rng(0), poses)


def test_mapper_holds_its_pose_where_odometry_drifts(toured):
    """Expected result: centimetres, where odometry alone is off by more than half a metre."""
    _, mapper, errors, off = toured
    assert off > 0.5
    assert np.sqrt(np.mean(errors**2)) < 0.03 and errors.max() < 0.06
    assert mapper.lost < 0.02 * len(errors)


def test_loop_is_closed_and_the_path_redrawn(toured):
    poses, mapper, _, _ = toured
    assert mapper.graph.loops
    path = np.array([pose for _, pose in mapper.path])
    stamps = np.array([stamp for stamp, _ in mapper.path])
    true = np.array(poses)[np.rint(stamps / 0.1).astype(int)]
    assert np.sqrt(np.mean(np.sum((path - true)[:, :2] ** 2, axis=1))) < 0.03


def test_map_shows_the_walls(toured):
    """Nearly every occupied cell lies within a cell and a half of a wall."""
    mapper = toured[1]
    centres = mapper.lidar.centres(np.argwhere(mapper.lidar.occupied))
    a, e = HALL[:, 0], HALL[:, 1] - HALL[:, 0]
    t = np.clip(np.sum((centres[:, None] - a) * e, axis=2) / np.sum(e * e, axis=1), 0, 1)
    off = np.min(np.linalg.norm(centres[:, None] - a - t[..., None] * e, axis=2), axis=1)
    assert len(centres) > 600 and np.mean(off < 0.075) > 0.95


def test_broken_late_and_repeated_scans_change_nothing(toured):
    _, mapper, _, _ = toured
    pose, cells, ignored = mapper.pose.copy(), mapper.lidar.log_odds.copy(), mapper.ignored
    good = scan(HALL, mapper.pose, stamp=mapper.stamp + 1)
    empty = LidarScan(good.stamp, good.angle_min, good.angle_increment, np.array([]), 30.0)
    nan = LidarScan(good.stamp, good.angle_min, good.angle_increment, np.full(9, np.nan), 30.0)
    late = scan(HALL, mapper.pose, stamp=mapper.stamp - 0.05)
    again = scan(HALL, mapper.pose, stamp=mapper.stamp)
    for reading in (empty, nan, late, again):
        assert not mapper.add_scan(reading, np.zeros(3))
        assert mapper.fault is not None and "\n" not in mapper.fault
    assert not mapper.add_scan(good, np.full(3, np.nan))
    np.testing.assert_array_equal(mapper.pose, pose)
    np.testing.assert_array_equal(mapper.lidar.log_odds, cells)
    assert mapper.ignored == ignored + 5


def test_a_scan_of_elsewhere_does_not_drag_the_pose(toured):
    """A scan that fits nowhere near: the pose follows the odometry."""
    poses = tour()[:40]
    mapper, _, _ = drive(SlamSettings(), np.random.default_rng(1), poses)
    before, lost = mapper.pose.copy(), mapper.lost
    elsewhere = scan(box(-0.7, -0.6, 0.8, 0.9), np.zeros(3), stamp=mapper.stamp + 0.1)
    assert mapper.add_scan(elsewhere, mapper._odometry)
    np.testing.assert_allclose(mapper.pose, before)
    assert mapper.lost == lost + 1


def test_depth_scans_go_with_their_key_frame():
    """A thing that the camera alone sees is drawn, and moves with the path when it is redrawn."""
    mapper = Slam((-8, -6), (8, 6), 0.05, np.zeros(3), (0.01, 0.01, 0.005), LIDAR)
    ahead = LidarScan(0.0, -0.1, 0.01, np.full(21, 1.5), 3.0)
    depth = DepthScan(ahead, np.zeros(21), np.array([0.335, 0.0, 0.0]))
    assert not mapper.add_depth(depth, np.zeros(3))  # no key frame yet
    mapper.add_scan(scan(HALL, LIDAR), np.zeros(3))
    for _ in range(3):
        assert mapper.add_depth(depth, np.array([0.1, 0.0, 0.0]))
    assert not mapper.add_depth(depth, np.full(3, np.nan))
    thing = np.array([0.1 + 0.335 + 1.5, 0.0])
    assert mapper.rgbd.occupied[tuple(mapper.rgbd.cells(thing))]
    table = fuse(mapper.rgbd, mapper.lidar)
    assert table.occupied[tuple(table.cells(thing))]
    mapper.graph.poses[0] = np.array([0.0, 1.0, 0.0])
    mapper.redraw()
    assert not mapper.rgbd.occupied[tuple(mapper.rgbd.cells(thing))]
    assert mapper.rgbd.occupied[tuple(mapper.rgbd.cells(thing + np.array([0.0, 1.0])))]

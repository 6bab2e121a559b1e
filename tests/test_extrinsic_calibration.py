"""Depth camera against lidar: the source's angles, and the calibration on made-up drives."""

from dataclasses import replace

import numpy as np
import pytest
from flat_world import box, floor, picture, scan, upright
from hypothesis import given
from hypothesis import strategies as st

from twin.geometry import (
    compose2,
    inverse,
    look_at,
    rot_x,
    rot_y,
    rot_z,
    transform,
)
from twin.stack.config import Camera
from twin.stack.estimation.extrinsic_calibration import (
    PlaneObservation,
    calibrate,
    fixed_angles,
    rotation_exp,
    rotation_xyz,
)
from twin.stack.estimation.lidar_stand import BoardObservation, LidarStand, find_stand
from twin.stack.estimation.wall_pairs import (
    _incidence,
    observe_boards,
    observe_walls,
    pair,
    wall_lines,
)

ANGLE = st.floats(-3.1, 3.1)
T_BASE_LIDAR = transform(np.eye(3), (0.30, 0.0, 0.18))
CAMERA = Camera(424, 240, 58.0, look_at((0.335, 0.0, 0.62), (1.335, 0.0, 0.62)))
T_DRAWN = inverse(T_BASE_LIDAR) @ CAMERA.T_base_camera
ROOM = np.concatenate([box(-3, -2, 3, 2), box(1.2, 0.9, 1.9, 1.5)])
PLANES = [*upright(ROOM), floor(-3, -2, 3, 2)]


@given(ANGLE, st.floats(-1.5, 1.5), ANGLE)
def test_angles_of_a_rotation_give_it_back(gamma, beta, alpha):
    found = fixed_angles(rotation_xyz(gamma, beta, alpha))
    np.testing.assert_allclose(found, (gamma, beta, alpha), atol=1e-7)


def test_rotation_by_hand():
    """Quarter turns about x, then about z: x goes to y, y to z and stays there, z to -y to x."""
    expected = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]], dtype=float)
    np.testing.assert_allclose(rotation_xyz(np.pi / 2, 0, np.pi / 2), expected, atol=1e-15)


@pytest.mark.parametrize("beta", [np.pi / 2, -np.pi / 2])
def test_gimbal_lock_still_gives_the_rotation(beta):
    R = rotation_xyz(0.4, beta, -0.9)
    np.testing.assert_allclose(rotation_xyz(*fixed_angles(R)), R, atol=1e-9)


@given(ANGLE)
def test_exponential_about_an_axis_is_the_plain_rotation(angle):
    for axis, rot in zip(np.eye(3), (rot_x, rot_y, rot_z), strict=True):
        np.testing.assert_allclose(rotation_exp(angle * axis), rot(angle), atol=1e-12)


def perturbed(rng, shift=0.03, turn=0.035):
    T = T_DRAWN.copy()
    T[:3, :3] = rotation_exp(rng.uniform(-turn, turn, 3)) @ T[:3, :3]
    T[:3, 3] += rng.uniform(-shift, shift, 3)
    return T


def errors(found, true):
    """Shift in m, turn in degrees."""
    R = found[:3, :3] @ true[:3, :3].T
    turn = np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1)))
    return np.linalg.norm(found[:3, 3] - true[:3, 3]), turn


def pairs(true, rng, count):
    """Readings of a drive through the room: scan, picture, and the way between them."""
    camera_in_base = T_BASE_LIDAR @ true
    for i in range(count):
        pose = np.array([*rng.uniform((-1.2, -1.0), (0.2, 0.6)), 2 * np.pi * i / count])
        moved = np.array([*rng.uniform(-0.03, 0.03, 2), rng.uniform(-0.03, 0.03)])
        lidar = compose2(pose, (0.30, 0.0, 0.0))
        yield (
            scan(ROOM, lidar, rng, noise=0.010),
            picture(PLANES, CAMERA, camera_in_base, compose2(pose, moved), rng),
            moved,
        )


@pytest.mark.parametrize("seed", [0, 1])
def test_recovered_from_a_drive(seed):
    """Expected result: 5 mm and 0.2 degrees from a start off by up to 30 mm and 2 degrees."""
    rng = np.random.default_rng(seed)
    true, belief = perturbed(rng), T_DRAWN
    drive = list(pairs(true, rng, 10))
    assert errors(belief, true)[0] > 0.005
    for _ in range(2):  # with a better belief, points find their walls better
        seen = [
            observation
            for scan_, frame, moved in drive
            for observation in observe_walls(
                pair(scan_, frame, CAMERA, T_BASE_LIDAR, belief, moved)
            )
        ]
        belief = calibrate(seen, belief).T_lidar_rgbd
    shift, turn = errors(belief, true)
    assert shift <= 0.005 and turn <= 0.2


def test_motion_between_scan_and_picture_is_undone():
    """A wall seen 0.2 m farther on and turned has its normal and offset in the later frame."""
    scan_, pose = scan(ROOM, (0.3, 0.0, 0.0)), np.array([0.2, 0.05, 0.1])
    frame = picture(PLANES, CAMERA, CAMERA.T_base_camera, pose)
    seen = observe_walls(pair(scan_, frame, CAMERA, T_BASE_LIDAR, T_DRAWN, pose))
    walls = [o for o in seen if abs(o.normal[2]) < 0.5]
    assert walls
    for wall in walls:
        p = wall.points @ T_DRAWN[:3, :3].T + T_DRAWN[:3, 3]
        np.testing.assert_allclose(p @ wall.normal, wall.offset, atol=0.01)


def plane(normal, offset, rng, true, count=200):
    """Points of a camera on a plane given in the lidar's frame."""
    normal = np.asarray(normal, dtype=float)
    p = rng.uniform(-1, 1, (count, 3)) + np.array([2.0, 0.0, 0.2])
    p -= np.outer(p @ normal - offset, normal)
    T = inverse(true)
    return PlaneObservation(normal, offset, p @ T[:3, :3].T + T[:3, 3], 0.01)


def test_perfect_planes_give_the_perfect_pose():
    rng = np.random.default_rng(0)
    true = perturbed(rng, 0.1, 0.1)
    planes = ((1, 0, 0), 2.0), ((0, 1, 0), 0.5), ((0, 0, 1), -0.18)
    found = calibrate([plane(n, d, rng, true) for n, d in planes], T_DRAWN)
    np.testing.assert_allclose(found.T_lidar_rgbd, true, atol=1e-7)
    np.testing.assert_allclose(rotation_xyz(*found.angles), true[:3, :3], atol=1e-7)


def test_what_cannot_be_known_is_named():
    rng = np.random.default_rng(2)
    walls = [plane((1, 0, 0), 2.0, rng, T_DRAWN), plane((0, 1, 0), 0.5, rng, T_DRAWN)]
    with pytest.raises(ValueError, match=r"do not determine shift z;"):
        calibrate(walls, T_DRAWN)


def test_bad_observations_are_refused():
    with pytest.raises(ValueError, match="0 points"):
        calibrate([], T_DRAWN)
    broken = PlaneObservation(np.array([1.0, 0, 0]), np.nan, np.ones((50, 3)))
    with pytest.raises(ValueError, match="not finite"):
        calibrate([broken], T_DRAWN)


def test_lines_of_a_room():
    """Three walls of a room; of the fourth, the scan sees nothing behind the vehicle."""
    room = box(-3, -2, 3, 2)
    pose = np.array([0.5, 0.2, 0.0])
    reading = scan(room, pose, np.random.default_rng(0))
    angles = reading.angle_min + reading.angle_increment * np.arange(len(reading.ranges))
    points = reading.ranges[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    lines = wall_lines(points)
    found = sorted((round(np.degrees(np.arctan2(n[1], n[0]))) % 360, d) for n, d, *_ in lines)
    expected = [(0, 2.5), (90, 1.8), (270, 2.2)]
    assert len(found) == 3
    np.testing.assert_allclose(found, expected, atol=0.6)
    np.testing.assert_allclose([d for _, d in found], [d for _, d in expected], atol=0.006)


def test_constant_error_of_range_is_told_from_a_shift_of_the_camera():
    """Opposite walls read 12 mm too far move apart; a shift moves both alike."""
    rng = np.random.default_rng(4)
    true, offset = perturbed(rng), 0.012
    walls = [((0, 1, 0), 1.5), ((0, -1, 0), 1.2), ((1, 0, 0), 2.0)]
    seen = [plane((0, 0, 1), -0.18, rng, true)]
    for normal, d in walls:
        exact = plane(normal, d, rng, true)
        seen.append(replace(exact, offset=d + offset, bias=1.0))
    found = calibrate(seen, T_DRAWN, range_sigma=1.0)
    assert found.range_offset == pytest.approx(offset, abs=1e-5)
    np.testing.assert_allclose(found.T_lidar_rgbd, true, atol=2e-5)
    blind = calibrate(seen, T_DRAWN)
    assert blind.range_offset == 0.0 and errors(blind.T_lidar_rgbd, true)[0] > 0.005


def test_lidar_that_is_believed_exact_is_left_exact():
    rng = np.random.default_rng(5)
    true = perturbed(rng)
    seen = [plane(n, d, rng, true) for n, d in (((1, 0, 0), 2.0), ((0, 1, 0), 0.5))]
    seen = [replace(s, offset=s.offset + 0.01, bias=1.0) for s in seen]
    seen.append(plane((0, 0, 1), -0.18, rng, true))
    found = calibrate(seen, T_DRAWN, range_sigma=1e-6)
    assert abs(found.range_offset) < 1e-6


def test_incidence_by_hand():
    """Beams over a wall from straight ahead to 45 degrees: mean cosine sin(45) / (pi / 4)."""
    n, a, b = np.array([1.0, 0.0]), np.array([2.0, 0.0]), np.array([2.0, 2.0])
    assert _incidence(n, a, b) == pytest.approx(np.sqrt(0.5) / (np.pi / 4))
    assert _incidence(n, a, a) == pytest.approx(1.0)


def board_at(x: float, y: float, stand: LidarStand, rng) -> BoardObservation:
    """A board that leans back by 45 degrees towards the lidar, and beams of the lidar on it."""
    n = np.array([-x, -y, 0.0]) / np.hypot(x, y) + (0, 0, 1)
    n /= np.linalg.norm(n)
    offset = float(n @ (x, y, 0.0))
    T = stand.T_level_lidar
    angles = np.arctan2(y, x) + np.linspace(-0.1, 0.1, 40)
    beams = np.stack([np.cos(angles), np.sin(angles), np.zeros(40)], axis=1)
    ranges = (offset - n @ T[:3, 3]) / (beams @ T[:3, :3].T @ n) + 0.002 * rng.standard_normal(40)
    return BoardObservation(n, offset, ranges[:, None] * beams[:, :2])


def test_boards_tell_how_the_lidar_hangs():
    """4 mm too high, rolled by 0.3 and pitched by -0.2 degrees; found to 1 mm and 0.05 degrees."""
    rng, true = np.random.default_rng(0), LidarStand((0.004, 0.0052, -0.0035))
    boards = [board_at(x, y, true, rng) for x in (0.8, 1.9) for y in np.linspace(-0.7, 0.7, 8)]
    found = find_stand(boards)
    assert found.boards == 16
    np.testing.assert_allclose(found.values, true.values, atol=0.001)
    sigma = np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(np.subtract(found.values, true.values)) < 3 * sigma)
    assert np.all(sigma < (0.003, 0.002, 0.002))


def test_without_boards_the_lidar_hangs_as_drawn():
    found = find_stand([])
    assert found.values == (0.0, 0.0, 0.0) and found.boards == 0
    assert np.sqrt(found.covariance[0, 0]) == pytest.approx(0.01)


def test_a_board_is_no_wall_and_its_plane_is_found():
    """A face that leans back by 45 degrees, from the floor 1 m before the lidar up to 0.45 m."""
    rng, x = np.random.default_rng(1), 1.3
    face = (np.array([x, -0.4, 0.0]), np.array([0.0, 0.8, 0.0]), np.array([0.45, 0.0, 0.45]))
    line = np.array([[(x + 0.18, -0.4), (x + 0.18, 0.4)]])  # where the scan cuts it
    pose = np.zeros(3)
    seen = pair(
        scan(np.concatenate([ROOM, line]), (0.3, 0.0, 0.0), rng),
        picture([*PLANES, face], CAMERA, CAMERA.T_base_camera, pose, rng),
        *(CAMERA, T_BASE_LIDAR, T_DRAWN, pose),
    )
    (found,) = observe_boards(seen, T_DRAWN)
    n = found.normal * np.sign(found.normal[2])
    np.testing.assert_allclose(n, np.array([-1, 0, 1]) / 2**0.5, atol=0.01)
    np.testing.assert_allclose(found.beams[:, 0], x + 0.18 - 0.3, atol=0.05)
    assert abs(find_stand([found]).values[0]) < 0.004
    offsets = [wall.offset for wall in observe_walls(seen) if abs(wall.normal[0]) > 0.9]
    assert not any(abs(offset - found.beams[:, 0].mean()) < 0.1 for offset in offsets)

"""Walls and boards that lidar and depth camera see at once: the data of the extrinsic calibration.

Lines are fitted to stretches of the scan; the camera's points that, by the belief so far, lie on a
stretch are taken for points of its wall, unless they lean: then it is a sloping board, which tells
how the lidar hangs (`lidar_stand`). What the vehicle moved between the two exposures is known from
odometry and undone.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array, apply, inverse, pose2_to_transform, wrap_angle
from twin.messages import LidarScan, RgbdFrame
from twin.stack.config import Camera
from twin.stack.estimation.extrinsic_calibration import PlaneObservation
from twin.stack.estimation.lidar_stand import BoardObservation
from twin.stack.estimation.scans import beam_points, scan_fault

GAP = 0.25  # m between neighbouring end points at which a stretch of wall ends
BENT = 0.06  # m from the line at which a stretch is split
MIN_BEAMS, MIN_LENGTH = 15, 0.5  # of a stretch, m
MARGIN = 0.10  # m of a stretch's ends, and of the floor under it, that are left out
REACH = 0.15  # m that a camera's point may lie off its wall by the belief so far
MAX_RANGE = 3.0  # m of the camera's points that are used
FLOOR_REACH, FLOOR_TURN = 0.06, 0.04  # m and rad by which the belief may lift or tilt the floor
FLOOR_CLEAR = 0.30  # m between floor that counts and what the scan saw behind it
NOISE_AT_1M = 0.010  # m, 1 sigma of depth
ALIKE = 0.985  # cosine of a line's normal with that of the points on it: 10 degrees
# Of a board: the same, its points' distance (m) along the floor and up from the scan's line, and
# the share of them that must lie within three sigmas of the plane.
BOARD, BOARD_REACH, BOARD_HEIGHT, FLAT = (0.35, 0.94), 0.25, 0.15, 0.9


@dataclass(frozen=True)
class Pair:
    """One scan and one depth picture, in the lidar's frame at the picture by the belief so far.

    Attributes:
        stretches: of the scan: normal (3,), offset (m), ends (2,) and (2,), end points (k, 3).
        p_rgbd, p_lidar: the camera's points in either frame. Shape (n, 3).
        height: of them above the floor, m. Shape (n,).
        before_obstacles: whether they lie well before what the scan saw. Shape (n,).
        floor: z of the floor, m.
    """

    stretches: list[tuple[Array, float, Array, Array, Array]]
    p_rgbd: Array
    p_lidar: Array
    height: Array
    before_obstacles: NDArray[np.bool_]
    floor: float


def wall_lines(points: Array) -> list[tuple[Array, float, Array, Array, Array]]:
    """Straight stretches in the order of the beams: split where bent, fitted by least squares.

    Args:
        points: end points in the order of the beams. Shape (n, 2).

    Returns:
        Normal (2,), offset (m, positive), the two ends (2,) and the points (k, 2) of each stretch.
    """
    if len(points) < MIN_BEAMS:
        return []
    breaks = np.nonzero(np.hypot(*np.diff(points, axis=0).T) > GAP)[0] + 1
    waiting, lines = list(np.split(points, breaks)), []
    while waiting:
        part = waiting.pop()
        if len(part) < MIN_BEAMS:
            continue
        chord = part[-1] - part[0]
        across = np.array([-chord[1], chord[0]]) / max(float(np.hypot(*chord)), 1e-9)
        off = np.abs((part - part[0]) @ across)
        worst = int(np.argmax(off))
        if off[worst] > BENT:
            waiting += [part[:worst], part[worst:]]
            continue
        part = part[2:-2]  # beams that graze a corner hit both sides
        middle = part.mean(axis=0)
        _, vectors = np.linalg.eigh((part - middle).T @ (part - middle))
        normal, along = vectors[:, 0], vectors[:, 1]
        offset = float(normal @ middle)
        reach = (part - middle) @ along
        if np.ptp(reach) >= MIN_LENGTH:
            ends = middle + along * reach.min(), middle + along * reach.max()
            lines.append((np.sign(offset) * normal, abs(offset), *ends, part))
    return lines


def pair(
    scan: LidarScan,
    frame: RgbdFrame,
    camera: Camera,
    T_base_lidar: Array,
    T_lidar_rgbd: Array,
    frame_in_scan: Array,
) -> Pair | None:
    """One pair of readings; None for readings that are of no use.

    Args:
        scan, frame: taken shortly after one another.
        camera: its intrinsics.
        T_base_lidar: on the drawing; its height above the floor is taken for granted.
        T_lidar_rgbd: belief so far.
        frame_in_scan: x, y, yaw of the base at the picture in the base at the scan.
    """
    if scan_fault(scan) is not None or frame.depth_mm.shape != (camera.height, camera.width):
        return None
    v, u = np.nonzero(frame.depth_mm)
    z = 1e-3 * frame.depth_mm[v, u].astype(np.float64)
    keep = z < MAX_RANGE
    u, v, z = u[keep], v[keep], z[keep]
    K = camera.matrix
    p_rgbd = np.stack(
        [(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z], axis=1, dtype=np.float64
    )
    p_lidar = apply(T_lidar_rgbd, p_rgbd)
    # Of the lidar: from its frame at the scan to its frame at the picture.
    T_now_scan = inverse(inverse(T_base_lidar) @ pose2_to_transform(frame_in_scan) @ T_base_lidar)
    stretches = []
    for normal2, offset, *ends, points in wall_lines(beam_points(scan)):
        normal = T_now_scan[:3, :3] @ (*normal2, 0.0)
        offset = offset + float(normal @ T_now_scan[:3, 3])
        a, b = (apply(T_now_scan, np.array([*end, 0.0]))[:2] for end in ends)
        points = apply(T_now_scan, np.column_stack([points, np.zeros(len(points))]))
        stretches.append((normal, offset, a, b, points))
    before = _before_obstacles(scan, apply(inverse(T_now_scan), p_lidar))
    floor = -float(T_base_lidar[2, 3])
    return Pair(stretches, p_rgbd, p_lidar, p_lidar[:, 2] - floor, before, floor)


def observe_walls(seen: Pair, most: int = 150) -> list[PlaneObservation]:
    """Walls and floor of one pair, in the lidar's frame.

    Args:
        seen: the pair.
        most: points used of each plane, evenly spread over those that were seen.
    """
    planes, p_lidar, height = [], seen.p_lidar, seen.height
    for normal, offset, a, b, _ in seen.stretches:
        length = float(np.hypot(*(b - a)))
        along = (p_lidar[:, :2] - a) @ ((b - a) / length)
        on_wall = np.abs(p_lidar @ normal - offset) < REACH
        on_wall &= (along > MARGIN) & (along < length - MARGIN) & (height > MARGIN)
        if np.count_nonzero(on_wall) < MIN_BEAMS or not _alike(p_lidar[on_wall], normal):
            continue
        bias = _incidence(normal[:2], a, b)
        planes += _plane(normal, offset, seen.p_rgbd[on_wall], most, bias)
    floor = np.abs(height) < FLOOR_REACH + FLOOR_TURN * np.hypot(p_lidar[:, 0], p_lidar[:, 1])
    # The foot of a wall would pass for floor that rises: only floor well before it counts.
    floor &= seen.before_obstacles
    return planes + _plane(np.array([0.0, 0.0, 1.0]), seen.floor, seen.p_rgbd[floor], most)


def observe_boards(seen: Pair, T_lidar_rgbd: Array) -> list[BoardObservation]:
    """Sloping boards of one pair, in a level frame at the lidar.

    Args:
        seen: the pair.
        T_lidar_rgbd: belief so far.
    """
    boards, R, t = [], T_lidar_rgbd[:3, :3], T_lidar_rgbd[:3, 3]
    for normal, offset, a, b, beams in seen.stretches:
        length = float(np.hypot(*(b - a)))

        def near(p: Array, normal=normal, offset=offset, a=a, b=b, length=length):
            along = (p[:, :2] - a) @ ((b - a) / length)
            inside = (along > MARGIN) & (along < length - MARGIN)
            inside &= (np.abs(p @ normal - offset) < BOARD_REACH) & (np.abs(p[:, 2]) < BOARD_HEIGHT)
            return inside, along

        chosen, _ = near(seen.p_lidar)
        if np.count_nonzero(chosen) < MIN_BEAMS:
            continue
        # Which points count must not hang on their noise: again by where rays meet the plane.
        rays = seen.p_rgbd / seen.p_rgbd[:, 2:]
        met = rays / (rays @ _by_inverse_depth(seen.p_rgbd[chosen]))[:, None]
        chosen, along = near(met @ R.T + t)
        if np.count_nonzero(chosen) < MIN_BEAMS:
            continue
        plane = _by_inverse_depth(seen.p_rgbd[chosen])
        n = R @ plane / np.linalg.norm(plane)
        d = 1.0 / float(np.linalg.norm(plane)) + float(n @ t)
        sigma = NOISE_AT_1M * _square(seen.p_rgbd[chosen])
        off = np.abs(seen.p_lidar[chosen] @ n - d)
        if not BOARD[0] < abs(n[2]) < BOARD[1] or np.mean(off < 3.0 * sigma) < FLAT:
            continue
        reach = (beams[:, :2] - a) @ ((b - a) / length)
        # Only where the camera sees it: a picture that cuts off a board shows what is beside it.
        beams = beams[(reach > along[chosen].min()) & (reach < along[chosen].max())]
        if len(beams) >= MIN_BEAMS:
            boards.append(BoardObservation(n, d, beams[:, :2], sigma / len(off) ** 0.5))
    return boards


def _by_inverse_depth(points: Array) -> Array:
    """Plane n . p = 1: the error of stereo is the same in 1/z everywhere. Shape (3,)."""
    plane = np.linalg.lstsq(points / points[:, 2:], 1.0 / points[:, 2], rcond=None)[0]
    return np.asarray(plane, float)


def _alike(points: Array, normal: Array) -> bool:
    """Whether the points make a plane that looks the same way, and not a board or a corner."""
    off = points - points.mean(axis=0)
    _, vectors = np.linalg.eigh(off.T @ off)
    return bool(abs(vectors[:, 0] @ normal) > ALIKE)


def _incidence(normal: Array, a: Array, b: Array) -> float:
    """Mean cosine between the beams of a stretch and its normal.

    A constant error of the ranges moves each end point along its beam, the line's middle by that
    share of it. Beams are evenly spread in angle, so the mean is the integral's.
    """
    across = np.array([-normal[1], normal[0]])
    first, last = (float(np.arctan2(end @ across, end @ normal)) for end in (a, b))
    turn = last - first
    return float((np.sin(last) - np.sin(first)) / turn) if abs(turn) > 1e-9 else np.cos(first)


def _before_obstacles(scan: LidarScan, points: Array) -> NDArray[np.bool_]:
    """Whether points in the lidar's frame at the scan lie before what their beam met."""
    angles = np.arctan2(points[:, 1], points[:, 0])
    beam = np.rint(wrap_angle(angles - scan.angle_min) / scan.angle_increment).astype(int)
    beam %= max(round(2 * np.pi / abs(scan.angle_increment)), 1)
    inside = beam < len(scan.ranges)
    met = np.where(inside, np.asarray(scan.ranges)[np.where(inside, beam, 0)], 0.0)
    met = np.where(np.isfinite(met), met, 0.0)
    return np.hypot(points[:, 0], points[:, 1]) < met - FLOOR_CLEAR


def _plane(normal, offset, points, most, bias=0.0) -> list[PlaneObservation]:
    if len(points) < MIN_BEAMS:
        return []
    points = points[np.linspace(0, len(points) - 1, min(most, len(points))).astype(int)]
    return [PlaneObservation(normal, float(offset), points, NOISE_AT_1M * _square(points), bias)]


def _square(points: Array) -> float:
    """Typical squared depth, m^2, in which noise grows; at least that of 0.7 m."""
    return max(float(np.mean(points[:, 2] ** 2)), 0.5)

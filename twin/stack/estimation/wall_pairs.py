"""Walls that lidar and depth camera see at once: the data of the extrinsic calibration.

Lines are fitted to stretches of the scan; the camera's points that, by the belief so far, lie on a
stretch are taken for points of its wall. What the vehicle moved between the two exposures is
known from odometry and undone.
"""

import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array, apply, inverse, pose2_to_transform, wrap_angle
from twin.messages import LidarScan, RgbdFrame
from twin.stack.config import Camera
from twin.stack.estimation.extrinsic_calibration import PlaneObservation
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


def wall_lines(points: Array) -> list[tuple[Array, float, Array, Array]]:
    """Straight stretches in the order of the beams: split where bent, fitted by least squares.

    Args:
        points: end points in the order of the beams. Shape (n, 2).

    Returns:
        Normal (2,), offset (m, positive), and the two ends (2,) of each stretch.
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
            lines.append((np.sign(offset) * normal, abs(offset), *ends))
    return lines


def observe_walls(
    scan: LidarScan,
    frame: RgbdFrame,
    camera: Camera,
    T_base_lidar: Array,
    T_lidar_rgbd: Array,
    frame_in_scan: Array,
    most: int = 150,
) -> list[PlaneObservation]:
    """Walls and floor in one pair of readings.

    Args:
        scan, frame: taken shortly after one another.
        camera: its intrinsics.
        T_base_lidar: on the drawing; its height above the floor is taken for granted.
        T_lidar_rgbd: belief so far.
        frame_in_scan: x, y, yaw of the base at the picture in the base at the scan.
        most: points used of each plane, evenly spread over those that were seen.

    Returns:
        Planes in the lidar's frame at the picture; none for readings that are of no use.
    """
    if scan_fault(scan) is not None or frame.depth_mm.shape != (camera.height, camera.width):
        return []
    v, u = np.nonzero(frame.depth_mm)
    z = 1e-3 * frame.depth_mm[v, u].astype(np.float64)
    keep = z < MAX_RANGE
    u, v, z = u[keep], v[keep], z[keep]
    K = camera.matrix
    p_rgbd = np.stack(
        [(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z], axis=1, dtype=np.float64
    )
    p_lidar = apply(T_lidar_rgbd, p_rgbd)
    height = p_lidar[:, 2] + T_base_lidar[2, 3]
    T_scan_frame = pose2_to_transform(frame_in_scan)
    # Of the lidar: from its frame at the scan to its frame at the picture.
    T_now_scan = inverse(inverse(T_base_lidar) @ T_scan_frame @ T_base_lidar)
    seen = []
    for normal2, offset, a, b in wall_lines(beam_points(scan)):
        normal = T_now_scan[:3, :3] @ (*normal2, 0.0)
        offset = offset + float(normal @ T_now_scan[:3, 3])
        a, b = (apply(T_now_scan, np.array([*end, 0.0]))[:2] for end in (a, b))
        length = float(np.hypot(*(b - a)))
        along = (p_lidar[:, :2] - a) @ ((b - a) / length)
        on_wall = np.abs(p_lidar @ normal - offset) < REACH
        on_wall &= (along > MARGIN) & (along < length - MARGIN) & (height > MARGIN)
        bias = _incidence(normal[:2], a, b)
        seen += _plane(normal, offset, p_rgbd[on_wall], most, bias)
    floor = np.abs(height) < FLOOR_REACH + FLOOR_TURN * np.hypot(p_lidar[:, 0], p_lidar[:, 1])
    # The foot of a wall would pass for floor that rises: only floor well before it counts.
    floor &= _before_obstacles(scan, apply(inverse(T_now_scan), p_lidar))
    z_floor = -float(T_base_lidar[2, 3])
    seen += _plane(np.array([0.0, 0.0, 1.0]), z_floor, p_rgbd[floor], most)
    return seen


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

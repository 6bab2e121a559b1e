"""Rooms drawn as line segments, and scans and depth pictures of them by plain geometry."""

import numpy as np

from twin.geometry import apply, pose2_to_transform
from twin.messages import LidarScan, RgbdFrame

BEAMS, FIRST, STEP = 1081, -np.radians(135.0), np.radians(0.25)


def box(x0, y0, x1, y1):
    """Four walls. Shape (4, 2, 2)."""
    c = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], dtype=float)
    return np.stack([c, np.roll(c, -1, axis=0)], axis=1)


def cast(segments, pose, angles):
    """Distance along each angle (in the sensor) to the nearest segment; inf if none."""
    a, e = segments[:, 0], segments[:, 1] - segments[:, 0]
    d = np.stack([np.cos(angles + pose[2]), np.sin(angles + pose[2])], axis=1)[:, None]
    w = a - np.asarray(pose[:2])
    cross = d[..., 0] * e[:, 1] - d[..., 1] * e[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (w[:, 0] * e[:, 1] - w[:, 1] * e[:, 0]) / cross
        s = (w[:, 0] * d[..., 1] - w[:, 1] * d[..., 0]) / cross
    good = (t > 0) & (s >= 0) & (s <= 1)
    return np.where(good, t, np.inf).min(axis=1)


def scan(segments, pose, rng=None, stamp=0.0, noise=0.010):
    """Scan of 270 degrees by a sensor at a pose (x, y, yaw)."""
    ranges = cast(segments, pose, FIRST + STEP * np.arange(BEAMS))
    if rng is not None:
        ranges = ranges + rng.normal(0, noise, BEAMS)
    return LidarScan(stamp, FIRST, STEP, np.where(ranges < 30, ranges, np.inf), 30.0)


def picture(planes, camera, T_base_camera, pose, rng=None, stamp=0.0, noise=0.0079):
    """Depth picture of upright or level rectangles: (corner, edge, edge), each (3,), in world."""
    T = pose2_to_transform(pose) @ T_base_camera
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.matrix).T
    rays = rays @ T[:3, :3].T
    eye = apply(T, np.zeros(3))
    depth = np.full((camera.height, camera.width), np.inf)
    for corner, e, f in np.asarray(planes, dtype=float):
        n = np.cross(e, f)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = ((corner - eye) @ n) / (rays @ n)
            hit = eye + rays * t[..., None] - corner
            a, b = hit @ e / (e @ e), hit @ f / (f @ f)
        good = (t > 0) & (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1)
        depth = np.where(good & (t < depth), t, depth)
    if rng is not None:
        depth = depth + noise * np.minimum(depth, 20) ** 2 * rng.standard_normal(depth.shape)
    depth_mm = np.where((depth > 0.1) & (depth < 10), np.rint(1000 * depth), 0).astype(np.uint16)
    return RgbdFrame(stamp, np.zeros((*depth.shape, 3), np.uint8), depth_mm)


def upright(segments, top=2.0):
    """Walls of segments from the floor up, for `picture`."""
    return [
        (np.array([*a, 0.0]), np.array([*(b - a), 0.0]), np.array([0.0, 0.0, top]))
        for a, b in segments
    ]


def floor(x0, y0, x1, y1):
    return (np.array([x0, y0, 0.0]), np.array([x1 - x0, 0.0, 0.0]), np.array([0.0, y1 - y0, 0.0]))

"""Rigid-body geometry in plain numpy.

A transform `T_a_b` maps coordinates in frame b to frame a: `p_a = T_a_b @ p_b`, and the letters
cancel when transforms are chained: `T_a_c = T_a_b @ T_b_c`. Angles in radians, lengths in metres.
A planar pose is an array `(x, y, yaw)`.
"""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def wrap_angle(angle):
    """Angle brought to (-pi, pi]. Accepts a scalar or an array of any shape."""
    return -((-np.asarray(angle) + np.pi) % (2.0 * np.pi) - np.pi)


def rot2(yaw: float) -> Array:
    """Planar rotation matrix. Shape (2, 2)."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s], [s, c]])


def rot_x(angle: float) -> Array:
    """Rotation about x. Shape (3, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rot_y(angle: float) -> Array:
    """Rotation about y. Shape (3, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def rot_z(angle: float) -> Array:
    """Rotation about z. Shape (3, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def transform(rotation: Array, translation) -> Array:
    """Homogeneous transform from a rotation (3, 3) and a translation (3,). Shape (4, 4)."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation
    return T


def inverse(T: Array) -> Array:
    """Inverse of a homogeneous transform: `T_b_a` from `T_a_b`. Shape (4, 4)."""
    R = T[:3, :3]
    return transform(R.T, -R.T @ T[:3, 3])


def apply(T_a_b: Array, p_b: Array) -> Array:
    """Points of frame b in frame a. Shape (..., 3) in and out."""
    return np.asarray(p_b) @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def pose2_to_transform(pose) -> Array:
    """`T_world_base` of a vehicle standing on the floor at a planar pose (x, y, yaw)."""
    return transform(rot_z(pose[2]), (pose[0], pose[1], 0.0))


def compose2(pose_a_b, pose_b_c) -> Array:
    """Planar pose of c in a from b in a and c in b. Shape (3,)."""
    xy = np.asarray(pose_a_b[:2]) + rot2(pose_a_b[2]) @ np.asarray(pose_b_c[:2])
    return np.array([xy[0], xy[1], wrap_angle(pose_a_b[2] + pose_b_c[2])])


def between2(pose_w_a, pose_w_b) -> Array:
    """Planar pose of b in a, both given in w. Shape (3,)."""
    xy = rot2(pose_w_a[2]).T @ (np.asarray(pose_w_b[:2]) - np.asarray(pose_w_a[:2]))
    return np.array([xy[0], xy[1], wrap_angle(pose_w_b[2] - pose_w_a[2])])


def quat_wxyz(rotation: Array) -> Array:
    """Unit quaternion (w, x, y, z), w >= 0, of a rotation matrix. Shape (4,)."""
    R = rotation
    # Shepperd's method: divide by the largest component, so no case is near singular.
    t = np.array([np.trace(R), R[0, 0], R[1, 1], R[2, 2]])
    i = int(np.argmax(t))
    if i == 0:
        q = np.array([1 + t[0], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    else:
        a, b, c = (i - 1), i % 3, (i + 1) % 3
        q = np.zeros(4)
        q[0] = R[c, b] - R[b, c]
        q[1 + a] = 1 + R[a, a] - R[b, b] - R[c, c]
        q[1 + b] = R[b, a] + R[a, b]
        q[1 + c] = R[c, a] + R[a, c]
    q /= np.linalg.norm(q)
    return q if q[0] >= 0 else -q


def rotation_from_quat(quat_wxyz) -> Array:
    """Rotation matrix of a quaternion (w, x, y, z), normalised first. Shape (3, 3)."""
    w, x, y, z = np.asarray(quat_wxyz) / np.linalg.norm(quat_wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def look_at(eye, target, up=(0.0, 0.0, 1.0)) -> Array:
    """`T_parent_camera` of a camera at `eye` whose optical axis meets `target`.

    Optical frame: z forward, x right, y down. Shape (4, 4).
    """
    eye = np.asarray(eye, dtype=float)
    z = np.asarray(target, dtype=float) - eye
    z /= np.linalg.norm(z)
    x = np.cross(z, np.asarray(up, dtype=float))
    x /= np.linalg.norm(x)
    return transform(np.column_stack([x, np.cross(z, x), z]), eye)


def swept_rectangles(a, b, length: float, width: float, pieces: int = 40):
    """Rectangles of a body on its straight way from pose (x, y, yaw) a to b, turning evenly."""
    turn = math.remainder(b[2] - a[2], 2 * math.pi)
    for i in range(pieces + 1):
        k = i / pieces
        x, y = a[0] + k * (b[0] - a[0]), a[1] + k * (b[1] - a[1])
        yield rectangle(x, y, a[2] + k * turn, length, width)


def rectangle(x, y, yaw, length, width) -> list[tuple[float, float]]:
    """Corners of a rectangle centred at (x, y), its length along yaw."""
    c, s = math.cos(yaw), math.sin(yaw)
    half = [(length / 2, width / 2), (-length / 2, width / 2)]
    half += [(-a, -b) for a, b in half]
    return [(x + c * a - s * b, y + s * a + c * b) for a, b in half]


def rectangles_overlap(first, second) -> bool:
    """Separating-axis test of two rectangles given by their corners in order."""
    for box in (first, second):
        for i in range(2):
            ax, ay = box[i + 1][0] - box[i][0], box[i + 1][1] - box[i][1]
            a = [ax * px + ay * py for px, py in first]
            b = [ax * px + ay * py for px, py in second]
            if max(a) <= min(b) or max(b) <= min(a):
                return False
    return True

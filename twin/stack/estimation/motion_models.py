"""How a pose moves when the odometry reports a step: two models that draw a sample for each pose.

A step is the pose (x, y, yaw) of the base after it in the axes of the base before it. Both models
put zero-mean normal noise on the parts of a step; they differ in the parts. Poses are (n, 3) in
world; nothing is drawn here, the standard normal numbers are passed in.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from twin.geometry import Array, wrap_angle

# m: below this the direction of a step is noise; the turn is then taken as one (Xu's model).
SHORT = 0.005


@dataclass(frozen=True)
class MotionNoise:
    """One sigma of the noise per unit of motion.

    The squares are the alphas of Thrun et al. 2005, Table 5.6, and of Nav2's omnidirectional model.
    Chosen several times larger than what wheels and inertial unit show on dry floor, so that a slip
    of some centimetres stays within the cloud.
    """

    turn_by_turn: float = 0.05  # rad per rad
    turn_by_path: float = 0.05  # rad per m
    along_by_path: float = 0.08  # m per m
    along_by_turn: float = 0.02  # m per rad
    across_by_path: float = 0.08  # m per m, square to the step
    across_by_turn: float = 0.02  # m per rad


def omnidirectional(poses: Array, step: Array, noise: MotionNoise, normals: Array) -> Array:
    """Poses after a step of a vehicle that moves any way: noise along, across and in yaw.

    Args:
        poses: in world. Shape (n, 3).
        step: what the odometry reports. Shape (3,).
        noise: of the vehicle.
        normals: standard normal numbers. Shape (n, 3).

    Source: Nav2, OmniMotionModel; the direction of the step is held in the axes of the base.
    """
    path, turn = float(np.hypot(step[0], step[1])), abs(float(step[2]))
    bearing = float(np.arctan2(step[1], step[0]))
    sigmas = (
        float(np.hypot(noise.along_by_path * path, noise.along_by_turn * turn)),
        float(np.hypot(noise.across_by_path * path, noise.across_by_turn * turn)),
        float(np.hypot(noise.turn_by_path * path, noise.turn_by_turn * turn)),
    )
    # NumPy takes sines of single precision many at a time; a step of a metre is off by 0.1 um.
    way = (poses[:, 2] + bearing).astype(np.float32)
    c, s = np.cos(way), np.sin(way)
    return _move_omni(poses, normals, c, s, path, float(step[2]), sigmas)


def split(step: Array) -> tuple[float, float, float]:
    """First turn, path and second turn of a step (Xu et al., Eqs. 8-11).

    A step backwards is split as a path of negative length, so that reversing is not two half turns
    with the noise of both.
    """
    x, y, yaw = (float(v) for v in step)
    path = float(np.hypot(x, y))
    if path < SHORT:
        # A turn on the spot: the shift stays, in the direction of the base, as good as none.
        return 0.0, path if x >= 0 else -path, float(wrap_angle(yaw))
    first = float(np.arctan2(y, x))
    if abs(first) > np.pi / 2:
        first, path = float(wrap_angle(first + np.pi)), -path
    return first, path, float(wrap_angle(yaw - first))


def spread(parts: tuple[float, float, float], noise: MotionNoise) -> Array:
    """Sigmas of first turn, path and second turn (Xu et al., Eqs. 12-14). Shape (3,)."""
    first, path, second = (abs(part) for part in parts)
    turns = float(np.hypot(first, second))
    return np.array(
        [
            np.hypot(noise.turn_by_turn * first, noise.turn_by_path * path),
            np.hypot(noise.along_by_path * path, noise.along_by_turn * turns),
            np.hypot(noise.turn_by_turn * second, noise.turn_by_path * path),
        ]
    )


def turn_path_turn(poses: Array, step: Array, noise: MotionNoise, normals: Array) -> Array:
    """Poses after a step taken as turn, straight path, turn (Xu et al., Eqs. 8-15).

    Args and shapes as in `omnidirectional`. The noise is subtracted, as the source has it.
    """
    parts = split(step)
    return _move_turns(poses, normals, *parts, spread(parts, noise))


def mismatch(step: Array, other: Array) -> Array:
    """Difference of two steps in first turn, path and second turn (Xu et al., Eqs. 16-18).

    With the reported step and the step between two assumed poses it is the error of the odometry
    under that assumption. Shape (3,).

    Both are split alike, as paths ahead or back: a strafe lies between the two, and half a turn
    apart is no error.
    """
    a, b = split(step), split(other)
    if abs(wrap_angle(a[0] - b[0])) > np.pi / 2:
        b = b[0] + np.pi, -b[1], b[2] - np.pi
    return np.array([wrap_angle(a[0] - b[0]), a[1] - b[1], wrap_angle(a[2] - b[2])])


@njit(cache=True)
def _move_omni(poses, normals, c, s, path, turn, sigmas):
    moved = np.empty_like(poses)
    for i in range(len(poses)):
        along = path + sigmas[0] * normals[i, 0]
        across = sigmas[1] * normals[i, 1]
        moved[i, 0] = poses[i, 0] + c[i] * along - s[i] * across
        moved[i, 1] = poses[i, 1] + s[i] * along + c[i] * across
        moved[i, 2] = _wrapped(poses[i, 2] + turn + sigmas[2] * normals[i, 2])
    return moved


@njit(cache=True)
def _move_turns(poses, normals, first, path, second, sigmas):
    moved = np.empty_like(poses)
    for i in range(len(poses)):
        heading = poses[i, 2] + first - sigmas[0] * normals[i, 0]
        length = path - sigmas[1] * normals[i, 1]
        moved[i, 0] = poses[i, 0] + length * np.cos(heading)
        moved[i, 1] = poses[i, 1] + length * np.sin(heading)
        moved[i, 2] = _wrapped(heading + second - sigmas[2] * normals[i, 2])
    return moved


@njit(cache=True)
def _wrapped(angle):
    return angle - 2 * np.pi * np.ceil((angle - np.pi) / (2 * np.pi))

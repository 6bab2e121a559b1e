"""Kinematics of a vehicle on four mecanum wheels (Li & An 2025, section 4, Fig. 7).

Wheels in the order front-left, front-right, rear-left, rear-right; a positive wheel speed drives
forward. The rollers that touch the floor lie along y - x at front left and rear right, along y + x
at the other two; a wheel holds the base only along its roller. With a roller that stands at angle
a from the lowest point of the wheel, its axis seen from above is (cos a, 1) instead of (1, 1), so

    r w = vx_wheel -+ vy_wheel / cos a.

A roller carries the wheel from -pi/n to pi/n, and its mean cosine c = sin(pi/n) / (pi/n) stays:
0.9886 for 12 rollers, by which the vehicle strafes less than with the ideal wheel. With
vx_wheel = vx - y omega and vy_wheel = vy + x omega, and the lever L = half_track + half_base / c:

    r w = [1 -1/c -L; 1 1/c L; 1 1/c -L; 1 -1/c L] (vx, vy, omega)

Four wheels for three velocities: the forward problem is solved by least squares, which is simple
because the columns are orthogonal.
"""

from functools import cache

import numpy as np

from twin.geometry import Array
from twin.stack.config import Wheels

SIGNS = np.array([[1.0, -1.0, -1.0], [1.0, 1.0, 1.0], [1.0, 1.0, -1.0], [1.0, -1.0, 1.0]])


@cache  # the unit asks 500 times a second
def _columns(wheels: Wheels) -> Array:
    """Rim travel for a unit of vx, vy, omega, without the signs. Shape (3,)."""
    c = np.sinc(1.0 / wheels.rollers)  # numpy's sinc is sin(pi x) / (pi x)
    return np.array([1.0, 1.0 / c, wheels.half_track + wheels.half_base / c])


def wheel_speeds(wheels: Wheels, body_velocity: Array) -> Array:
    """Inverse kinematics.

    Args:
        wheels: dimensions.
        body_velocity: vx, vy (m/s), omega (rad/s) in base. Shape (..., 3).

    Returns:
        Wheel speeds, rad/s. Shape (..., 4).
    """
    return (np.asarray(body_velocity) * _columns(wheels)) @ SIGNS.T / wheels.radius


def body_velocity(wheels: Wheels, speeds: Array) -> Array:
    """Forward kinematics, by least squares over the four wheels.

    Takes increments as well as rates: wheel angles in rad give a base displacement in m and rad.

    Args:
        wheels: dimensions.
        speeds: wheel speeds, rad/s. Shape (..., 4).

    Returns:
        vx, vy (m/s), omega (rad/s) in base. Shape (..., 3).
    """
    return np.asarray(speeds) @ SIGNS * wheels.radius / (4.0 * _columns(wheels))


def within_limits(wheels: Wheels, body_velocity: Array) -> Array:
    """The same motion, slowed until no wheel exceeds its greatest speed. Shape (3,)."""
    fastest = float(np.abs(wheel_speeds(wheels, body_velocity)).max())
    return np.asarray(body_velocity) * min(1.0, wheels.max_wheel_speed / max(fastest, 1e-12))

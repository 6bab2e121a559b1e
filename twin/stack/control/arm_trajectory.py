"""Joint motions towards a moving part and in its frame. The hand points down all along."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import ruckig

from twin.geometry import Array
from twin.stack.config import Arm
from twin.stack.control.arm_kinematics import ArmKinematics, Unreachable
from twin.stack.control.arm_path import STEP, JointTable


@dataclass(frozen=True)
class Grasp:
    """Where the TCP must be to close on a part that moves with constant velocity, in mount."""

    stamp: float  # time to which `position` belongs, s
    position: Array  # (3,) m
    velocity: Array  # (3,) m/s
    yaw: float  # along which the fingers close, rad

    def at(self, time: float) -> Array:
        """TCP in mount at a time. Shape (3,)."""
        return self.position + self.velocity * (time - self.stamp)


class JointState(NamedTuple):
    """Reference of the six joints at one time. Shapes (6,)."""

    q: Array  # rad
    qd: Array  # rad/s
    qdd: Array  # rad/s^2

    @classmethod
    def still(cls, q: Array) -> "JointState":
        return cls(q, np.zeros(6), np.zeros(6))


class TooLate(Unreachable):
    """The arm cannot be there in time."""


def state_above(
    kinematics: ArmKinematics, grasp: Grasp, height: float, near: float, time: float
) -> JointState:
    """Joint state that stands above a moving part and moves with it.

    Velocity and acceleration are differences of the closed form over one step.

    Args:
        kinematics: of the arm.
        grasp: the moving part.
        height: of the TCP above the grasp point, m.
        near: joint 6 is the choice nearest to this, rad.
        time: s.
    """
    p = np.array([grasp.at(time + k * STEP) for k in (-1, 0, 1)])
    p[:, 2] += height
    q = kinematics.inverse_down(p, np.full(3, grasp.yaw), near)
    return JointState(q[1], (q[2] - q[0]) / (2 * STEP), (q[2] - 2 * q[1] + q[0]) / STEP**2)


def rendezvous(
    arm: Arm, start: JointState, goal: JointState, duration: float | None = None
) -> ruckig.Trajectory:
    """Jerk-limited joint motion between two moving states (ruckig: Berscheid & Kroger 2021).

    Args:
        arm: limits.
        start, goal: states.
        duration: wanted, s; None for the shortest. The result may be longer if this is too short.

    Raises:
        Unreachable: a state itself is beyond a joint's limit.
    """
    task = ruckig.InputParameter(6)
    task.current_position, task.target_position = start.q, goal.q
    task.current_velocity, task.target_velocity = start.qd, goal.qd
    task.current_acceleration, task.target_acceleration = start.qdd, goal.qdd
    task.max_velocity, task.max_acceleration = arm.max_speed, arm.max_acceleration
    task.max_jerk = arm.max_jerk
    if duration is not None:
        task.minimum_duration = duration
    trajectory = ruckig.Trajectory(6)
    try:
        ruckig.Ruckig(6).calculate(task, trajectory)
    except ruckig.RuckigError as error:
        reason = str(error).strip().splitlines()[-1].removeprefix("[ruckig] ")
        raise Unreachable(f"no approach: {reason}") from None
    return trajectory


def table_of(trajectory: ruckig.Trajectory, duration: float) -> JointTable:
    """A ruckig trajectory as a table of whole steps."""
    times = np.arange(int(np.ceil(duration / STEP - 1e-6)) + 1) * STEP
    return JointTable(*(np.array(a) for a in zip(*map(trajectory.at_time, times), strict=True)))


def straight(
    kinematics: ArmKinematics,
    grasp: Grasp,
    near: float,
    start: float,
    duration: float,
    heights: tuple[float, float],
    stop: bool = False,
) -> JointTable:
    """Straight up or down in the frame of a moving part (quintic in height).

    Args:
        kinematics: of the arm.
        grasp: the moving part.
        near: joint 6 is the choice nearest to this, rad.
        start: time of the first sample, s.
        duration: s, a whole number of steps.
        heights: of the TCP above the grasp point, first and last, m.
        stop: leave the part's frame on the way and come to rest in the mount's.
    """
    x = np.linspace(0.0, 1.0, round(duration / STEP) + 1)
    rise = x**3 * (10 - 15 * x + 6 * x**2)
    # Way of the frame in durations: its speed is 1 throughout, or 1 - rise on the way to rest.
    way = x - x**4 * (2.5 - 3 * x + x**2) if stop else x
    p = grasp.at(start) + np.outer(duration * way, grasp.velocity)
    p[:, 2] += heights[0] + (heights[1] - heights[0]) * rise
    return JointTable.from_positions(kinematics.inverse_down(p, np.full(len(x), grasp.yaw), near))

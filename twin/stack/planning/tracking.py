"""Tracking: the command that keeps the vehicle on a moving reference.

The command is the reference's velocity through the inverse of the wheel loops' answer, plus a
proportional response to the error of the localised pose. One law serves the legs of `drive` and the
trajectories of the elastic band.
"""

import numpy as np

from twin.geometry import Array, rot2, wrap_angle
from twin.messages import BodyVelocity
from twin.stack.config import DriveLimits
from twin.stack.planning.teb_trajectory import Trajectory

GAIN = np.array([3.0, 3.0, 4.0])  # 1/s on x, y, yaw: below the wheel loops' 10 rad/s; not tuned
TICK = 0.010  # s between steps
MARGIN = 1.10  # of the limits that feedback may use


def pose_error(goal: Array, pose: Array) -> Array:
    """What leads from a pose to a goal, x, y, yaw in world. Shape (3,)."""
    error = np.asarray(goal, dtype=float) - pose
    error[2] = wrap_angle(error[2])
    return error


class VelocityLaw:
    """Feed-forward and feedback.

    Args:
        limits: of the vehicle.
    """

    def __init__(self, limits: DriveLimits):
        self._limits = limits
        self._acceleration = self._washed = np.zeros(3)
        self._most = np.array([limits.speed, limits.strafe_speed, limits.turn_rate])

    def reset(self) -> None:
        """The vehicle stands."""
        self._acceleration = self._washed = np.zeros(3)

    def command(self, pose: Array, reference: Array, speed: Array, push: Array) -> BodyVelocity:
        """Command of this tick.

        Args:
            pose: localised x, y, yaw in world.
            reference: pose in world where the vehicle should be now.
            speed: the reference's velocity in world axes, the loops' dead time ahead of now.
            push: its acceleration, likewise.
        """
        world = speed + GAIN * pose_error(reference, pose)
        R_base_world = rot2(pose[2]).T
        wanted = np.array([*(R_base_world @ world[:2]), world[2]])
        lead = self._lead(np.array([*(R_base_world @ push[:2]), push[2]]))
        return self._clipped(wanted + lead)

    def _lead(self, acceleration: Array) -> Array:
        """What must be added to a velocity, in base axes, so that the wheel loops follow it.

        The inverse of their answer is 1 + L T s^2 / (T s + 1): the lag L times the acceleration,
        washed out with T by the loops' integrators.
        """
        change = acceleration - self._acceleration
        self._washed = (self._washed + change) * np.exp(-TICK / self._limits.lag_washout)
        self._acceleration = acceleration
        return self._limits.velocity_lag * self._washed

    def _clipped(self, velocity: Array) -> BodyVelocity:
        """Scaled back, in direction, to the vehicle's limits."""
        share = float(np.sum(np.abs(velocity) / self._most)) / MARGIN
        return BodyVelocity(*(velocity / max(share, 1.0)))


class TrajectoryFollower:
    """Drives along a trajectory, slower than its own time where told to stop.

    The place on the trajectory is its *phase*, s; the phase's *rate* is 1, and goes to 0 within the
    vehicle's deceleration to stop. So a stop stays on the way that was found free.

    Args:
        limits: of the vehicle.
    """

    def __init__(self, limits: DriveLimits):
        self._limits, self._law = limits, VelocityLaw(limits)
        self.trajectory: Trajectory | None = None
        self.phase, self.rate = 0.0, 1.0

    def start(self, trajectory: Trajectory) -> None:
        """Follow a trajectory from its first node on, from now on."""
        self.trajectory, self.phase, self.rate = trajectory, 0.0, 1.0

    def stop(self) -> None:
        """Forget the trajectory; only for a vehicle that stands."""
        self.trajectory, self.phase, self.rate = None, 0.0, 1.0
        self._law.reset()

    @property
    def reference(self) -> tuple[Array, Array]:
        """Pose in world and velocity in base where the vehicle should be. Shapes (3,)."""
        assert self.trajectory is not None
        pose, velocity, _ = self.trajectory.motion(self.phase)
        return pose, self.rate * velocity

    @property
    def remaining(self) -> float:
        """Seconds to the trajectory's end at its own pace."""
        return 0.0 if self.trajectory is None else max(self.trajectory.duration - self.phase, 0.0)

    @property
    def stopped(self) -> bool:
        """Whether the reference stands."""
        return self.trajectory is None or self.rate == 0.0 or self.remaining == 0.0

    def stopping_time(self) -> float:
        """Seconds that it takes to come to rest from the reference's velocity."""
        if self.trajectory is None:
            return 0.0
        return self._stopping_time(self.reference[1])

    def step(self, pose: Array, brake: bool) -> BodyVelocity:
        """Command of this tick.

        Args:
            pose: localised x, y, yaw in world.
            brake: whether to come to rest, on the way.
        """
        if self.trajectory is None:
            return BodyVelocity()
        _, velocity, _ = self.trajectory.motion(self.phase)
        whole = max(self._stopping_time(velocity), TICK)
        rate = self.rate
        self.rate = float(np.clip(rate + (-TICK if brake else TICK) / whole, 0.0, 1.0))
        change = (self.rate - rate) / TICK
        self.phase = min(self.phase + 0.5 * (rate + self.rate) * TICK, self.trajectory.duration)
        reference, _, _ = self.trajectory.motion(self.phase)
        ahead = min(self.phase + self.rate * self._limits.dead_time, self.trajectory.duration)
        there, velocity, push = self.trajectory.motion(ahead)
        R_world_base = rot2(there[2])
        push = self.rate**2 * push + change * velocity
        velocity = self.rate * velocity
        return self._law.command(
            pose,
            reference,
            np.array([*(R_world_base @ velocity[:2]), velocity[2]]),
            np.array([*(R_world_base @ push[:2]), push[2]]),
        )

    def _stopping_time(self, velocity: Array) -> float:
        speed, turn = float(np.hypot(*velocity[:2])), abs(float(velocity[2]))
        return speed / self._limits.acceleration + turn / self._limits.turn_acceleration

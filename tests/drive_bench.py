"""Test bench of navigation: the plant without cameras, driven in closed loop by the fused pose."""

from dataclasses import dataclass, field

import numpy as np

from twin.geometry import wrap_angle
from twin.layout import load_layout
from twin.messages import BodyVelocity
from twin.plant.actuators.arm_drive import ArmDrive
from twin.plant.actuators.wheel_drive import WheelDrive
from twin.plant.as_built import AsBuilt
from twin.plant.sensors.encoders import WheelEncoders
from twin.plant.sensors.imu import ImuSensor
from twin.plant.sensors.suite import SensorSuite
from twin.plant.world import World
from twin.stack.config import StackConfig
from twin.stack.control_unit import ControlUnit
from twin.stack.estimation.fusion import FusedOdometry
from twin.stack.estimation.odometry import WheelOdometry
from twin.stack.planning.drive import Drive


@dataclass
class Track:
    """What happened, a row a tick: planar poses in world, and the fused covariance."""

    truth: list = field(default_factory=list)
    fused: list = field(default_factory=list)
    wheels: list = field(default_factory=list)
    covariance: list = field(default_factory=list)

    def errors(self, estimate: list) -> np.ndarray:
        """Estimate minus truth: x, y in m and yaw in rad. Shape (n, 3)."""
        error = np.array(estimate) - np.array(self.truth)
        error[:, 2] = wrap_angle(error[:, 2])
        return error

    def ape(self, estimate: list) -> np.ndarray:
        """Absolute position error. Shape (n,)."""
        return np.hypot(*self.errors(estimate)[:, :2].T)

    def nees(self) -> np.ndarray:
        """Normalised error squared of the fused pose, by degree of freedom. Shape (n,)."""
        error = self.errors(self.fused)
        return (
            np.einsum("ni,ni->n", error, np.linalg.solve(self.covariance, error[..., None])[..., 0])
            / 3
        )


class DriveBench:
    """One vehicle at its dock, as built by seed.

    Args:
        seed: of deviations and noise.
        latency_scale: factor on the sensors' latency.
        overrides: of the layout.
    """

    def __init__(self, seed: int, latency_scale: float = 1.0, overrides: tuple[str, ...] = ()):
        layout = load_layout(None, overrides)
        built, imu, wheels = np.random.default_rng(seed).spawn(3)
        self.as_built = AsBuilt.draw(built, layout.world.tolerances)
        self.world = World(layout, self.as_built, pool=1)
        model = self.world.model
        self.config = StackConfig(site=layout.site, options=layout.options)
        start = np.array(layout.site.dock)
        self.unit = ControlUnit(self.config.wheels)
        self.fused = FusedOdometry(self.config, start)
        self.odometry = WheelOdometry(self.config.wheels, start)
        self.drive = Drive(self.config.drive)
        self.track = Track()
        self._wheels, self._encoders = WheelDrive(model), WheelEncoders(model, wheels)
        self._arms = [ArmDrive(model, f"arm{i}/", np.zeros(6)) for i in range(2)]
        self._suite = SensorSuite([ImuSensor(model, imu)], latency_scale)
        self._suite.sample(0.0, model, self.world.data)
        self._wheel_state = None

    def tick(self) -> None:
        """Ten milliseconds of stack and plant."""
        now = self.world.time
        self.fused.step([*self._suite.arrived(now), *([self._wheel_state] if now else [])])
        if self._wheel_state is not None:
            self.odometry.update(self._wheel_state)
        pose = self.fused.pose(now)
        command = self.drive.step(now, pose, self.fused.velocity)
        self._record(pose)
        self._run(command)

    def _record(self, pose: np.ndarray) -> None:
        self.track.truth.append(self.world.truth().pose)
        self.track.fused.append(pose)
        self.track.wheels.append(self.odometry.pose)
        self.track.covariance.append(self.fused.covariance)

    def _run(self, command: BodyVelocity) -> None:
        world = self.world
        for _ in range(5):
            counts = self._encoders.counts(world.data)
            pwm, self._wheel_state = self.unit.step(counts, command)
            self._wheels.apply(world.data, pwm)
            for arm in self._arms:
                arm.apply(world.data)
            world.step()
            self._suite.sample(world.time, world.model, world.data)

    def stand_until_ready(self, limit: float = 5.0) -> None:
        """Learn the gyro bias at the dock."""
        while not self.fused.ready and self.world.time < limit:
            self.tick()

    def go(self, route, limit: float = 60.0) -> float:
        """Drive a route to its end; returns the time that it took, s."""
        began = self.world.time
        self.drive.start(began, self.fused.pose(began), route)
        while not self.drive.done and self.world.time < began + limit:
            self.tick()
        return self.world.time - began

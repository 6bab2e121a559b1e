"""The world with its faults, driven by body velocity alone: wheels, control unit, no stack."""

import numpy as np

from twin.layout import load_layout
from twin.messages import BodyVelocity
from twin.plant.actuators.arm_drive import ArmDrive
from twin.plant.actuators.wheel_drive import WheelDrive
from twin.plant.as_built import AsBuilt
from twin.plant.faults import FaultDriver
from twin.plant.sensors.encoders import WheelEncoders
from twin.plant.world import World
from twin.stack.config import StackConfig
from twin.stack.control_unit import ControlUnit
from twin.stack.estimation.odometry import WheelOdometry

EXACT = (
    "world.tolerances.scale=0",
    "world.tolerances.dock_xy=0",
    "world.tolerances.dock_yaw_deg=0",
)
STAND = BodyVelocity()


class Rig:
    """One vehicle, exactly as drawn, at its dock.

    Args:
        overrides: of the layout, such as `world.faults.wet=[...]`.
    """

    def __init__(self, *overrides: str):
        layout = load_layout(None, (*EXACT, *overrides))
        built = AsBuilt.draw(np.random.default_rng(0), layout.world.tolerances)
        self.world = World(layout, built, pool=1)
        self.faults = FaultDriver(self.world, layout)
        config = StackConfig(site=layout.site, options=layout.options)
        self._unit = ControlUnit(config.wheels)
        self._encoders = WheelEncoders(self.world.model, np.random.default_rng(1))
        self._wheels = WheelDrive(self.world.model)
        self._arms = [ArmDrive(self.world.model, f"arm{i}/", np.zeros(6)) for i in range(2)]
        self._command = np.zeros(3)
        self.odometry = WheelOdometry(config.wheels, np.array(layout.site.dock))
        self.wheel_state = None

    @property
    def pose(self) -> np.ndarray:
        """True pose of the vehicle. Shape (3,)."""
        return self.world.base_motion()[0]

    def tick(self, command: BodyVelocity = STAND) -> None:
        """Ten milliseconds under one command."""
        for _ in range(5):
            counts = self._encoders.counts(self.world.data)
            pwm, self.wheel_state = self._unit.step(counts, command)
            self._wheels.apply(self.world.data, pwm)
            for arm in self._arms:  # they hold still
                arm.apply(self.world.data)
            self.faults.step()
            self.world.step()
        self.odometry.update(self.wheel_state)

    def drive(self, seconds: float, vx=0.0, vy=0.0, omega=0.0, ramp: float = 0.8) -> None:
        """Drive at a velocity, to which the command goes at `ramp` m/s^2 (and rad/s^2)."""
        wanted = np.array([vx, vy, omega])
        for _ in range(round(seconds * 100)):
            self._command += np.clip(wanted - self._command, -ramp * 0.01, ramp * 0.01)
            self.tick(BodyVelocity(*self._command))

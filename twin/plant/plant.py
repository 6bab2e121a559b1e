"""The simulated plant as the loop sees it: readings out, commands in, one step at a time."""

from dataclasses import replace

import numpy as np

from twin.layout import Layout
from twin.messages import AnyOrder, Commands, Order, Reading, TransportOrder
from twin.plant.actuators.arm_drive import ArmDrive
from twin.plant.actuators.gripper_drive import GripperDrive
from twin.plant.actuators.wheel_drive import WheelDrive
from twin.plant.as_built import AsBuilt
from twin.plant.faults import FaultDriver
from twin.plant.feeder import Feeder
from twin.plant.sensors.beacons import fitted_network
from twin.plant.sensors.camera import MastCamera
from twin.plant.sensors.encoders import WheelEncoders
from twin.plant.sensors.floor_camera import FloorCamera
from twin.plant.sensors.imu import ImuSensor
from twin.plant.sensors.joints import ArmSensor, GripperSensor
from twin.plant.sensors.lidar import LidarSensor
from twin.plant.sensors.rendering import RenderWorker
from twin.plant.sensors.rgbd import RgbdCamera
from twin.plant.sensors.suite import SensorSuite
from twin.plant.world import Truth, World

PARKED_WIDTH = 0.025  # m between the pads at the start
IDLE_POOL = 1  # parts of each class in the store of a plant that feeds none
STEPS_PER_TICK = 5  # physics steps of 2 ms in a tick of the stack


class OrderDesk:
    """Sends the order once, at the start, over the plant's network."""

    period, latency = 1e9, 0.1  # s; the latency is a guess

    def __init__(self, order: AnyOrder):
        self._order = order

    def sample(self, stamp: float, model, data) -> AnyOrder:
        return replace(self._order, stamp=stamp)


class Plant:
    """World, feeder, faults, sensors and actuators of one run.

    Args:
        layout: what stands where.
        seed: of everything random in the plant.
        order: what the desk sends; None for the parts of `layout.world.order`. Parts are fed only
            when it is an order for parts.

    Raises:
        LayoutError: the models cannot be put together.
    """

    def __init__(self, layout: Layout, seed: int, order: AnyOrder | None = None):
        built, wheels, feed, *noise = np.random.default_rng(seed).spawn(11)
        self.layout, self.as_built = layout, AsBuilt.draw(built, layout.world.tolerances)
        if order is None:
            order = Order(0.0, tuple((c, n) for c, n in layout.world.order.items() if n))
        self._feeding = isinstance(order, Order)
        pool, transport = None if self._feeding else IDLE_POOL, isinstance(order, TransportOrder)
        self.world = World(layout, self.as_built, pool, parcel=transport)
        model = self.world.model
        self.feeder = Feeder(self.world, layout, feed)
        self.faults = FaultDriver(self.world, layout)
        self._encoders = WheelEncoders(model, wheels)
        self._wheels = WheelDrive(model)
        self._arms = [
            ArmDrive(model, f"arm{i}/", self.as_built.arm_joint_zero[i]) for i in range(2)
        ]
        self._grippers = [GripperDrive(model, f"arm{i}/") for i in range(2)]
        self.renderer = RenderWorker(model)
        k = layout.world.sensors.noise_scale
        self._mast_camera = MastCamera(self.renderer, noise[3], k)
        cameras = (
            self._mast_camera,
            RgbdCamera(self.renderer, noise[4], k, self.as_built.rgbd_focal),
            FloorCamera(self.renderer, model, noise[5], k),
        )
        self.sensors = (
            OrderDesk(order),
            ImuSensor(model, noise[0], k),
            *(ArmSensor(i, drive) for i, drive in enumerate(self._arms)),
            *(GripperSensor(i, g, noise[1], k) for i, g in enumerate(self._grippers)),
            LidarSensor(model, noise[2], self.as_built.lidar_mount, k),
            *(cameras if layout.world.sensors.cameras else ()),
            *fitted_network(model, layout, self.as_built, noise[6], noise[7]),
        )
        self._suite = SensorSuite(self.sensors, layout.world.sensors.latency_scale)
        self._begun = False

    def park(self, joints) -> None:
        """Before the run: leave the arms where their encoders read `joints`, shape (2, 6), rad.

        Without this they stand straight up, as the model draws them.
        """
        for drive, q in zip(self._arms, joints, strict=True):
            drive.set_rest(self.world.data, np.asarray(q))
        for gripper in self._grippers:
            gripper.set_rest(self.world.data, PARKED_WIDTH)
        self.world.refresh()

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return self.world.time

    def truth(self) -> Truth:
        """The true state, for evaluation and recording only."""
        return self.world.truth()

    def readings(self) -> tuple[Reading, ...]:
        """What has arrived since the last call."""
        if not self._begun:  # the first exposures, of the state at the start
            self._begun = True
            self._suite.sample(self.time, self.world.model, self.world.data)
        return self._suite.arrived(self.time)

    def encoder_counts(self):
        """The wheels' hardware counters, for the control unit. Shape (4,)."""
        return self._encoders.counts(self.world.data)

    def apply(self, commands: Commands) -> None:
        """Hand the set-points of arms and grippers to their drives, and switch the camera."""
        self._mast_camera.on = commands.mast_camera
        for command in commands.arms:
            self._arms[command.arm].command(command)
        for command in commands.grippers:
            self._grippers[command.arm].command(command)

    def step(self, pwm) -> None:
        """One physics step of 2 ms under the wheels' duty `pwm`, shape (4,)."""
        data = self.world.data
        self._wheels.apply(data, pwm)
        for drive in (*self._arms, *self._grippers):
            drive.apply(data)
        if self._feeding:
            self.feeder.step()
        self.faults.step()
        self.world.step()
        self._suite.sample(self.time, self.world.model, data)

    def close(self) -> None:
        """Free the renderer."""
        self.renderer.close()

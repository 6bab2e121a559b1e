"""Test bench of one arm: on a block at deck height beside a belt, with a tray slot and one part."""

import mujoco
import numpy as np

from twin.geometry import apply, inverse, rot_z, transform
from twin.layout import load_layout, models_dir
from twin.messages import GripperCommand
from twin.plant.actuators.arm_drive import ArmDrive
from twin.plant.actuators.gripper_drive import GripperDrive
from twin.stack.config import StackConfig
from twin.stack.control.arm_motion import ArmMotion

PART_MASS, PART_RADIUS, PART_HALF = 0.040, 0.010, 0.015  # kg, m: hex nut, 20 mm across flats
DECK, BELT = 0.55, 0.70  # m


class ArmBench:
    """Frames as on the vehicle: base axes, the arm at its mount, the belt along -x."""

    def __init__(self, arm: int, belt_speed: float, part, slot, zero_offset=None):
        """Args: part (x, y, yaw) on the belt and slot (x, y, z of its floor), in base, m."""
        layout = load_layout()
        self.config = StackConfig(site=layout.site, options=layout.options)
        self.T_base_mount = self.config.T_base_arm[arm]
        spec = mujoco.MjSpec()
        spec.option.timestep, spec.option.impratio = 0.002, 10
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        box = mujoco.mjtGeom.mjGEOM_BOX
        world = spec.worldbody
        world.add_geom(type=box, size=[0.35, 0.25, 0.005], pos=[0, 0, DECK - 0.005])
        belt = world.add_geom(name="belt", type=box, size=[2.0, 0.10, 0.005])
        belt.pos, belt.friction = [0, 0.45, BELT - 0.005], [0.9, 0.005, 0.0001]
        belt.surfacevel = [1e-9, 0, 0, 0, 0, 0]
        for k, (dx, dy) in enumerate([(0.027, 0), (-0.027, 0), (0, 0.027), (0, -0.027)]):
            wall = world.add_geom(name=f"wall{k}", type=box)
            wall.size = [0.003, 0.03, 0.003] if dx else [0.03, 0.003, 0.003]
            wall.pos = [slot[0] + dx, slot[1] + dy, slot[2] + 0.003]
        floor = world.add_geom(name="slot", type=box, size=[0.03, 0.03, 0.003])
        floor.pos = [slot[0], slot[1], slot[2] - 0.003]
        body = world.add_body(name="part", pos=[part[0], part[1], BELT + PART_RADIUS])
        body.quat = [np.cos(part[2] / 2), 0, 0, np.sin(part[2] / 2)]
        body.add_freejoint(name="part")
        for k in range(3):  # a hexagonal prism lying on a flat, its axis along x
            nut = body.add_geom(type=box, mass=PART_MASS / 3, friction=[0.3, 0.005, 0.0001])
            nut.size = [PART_HALF, PART_RADIUS / np.sqrt(3), PART_RADIUS]
            nut.quat = [np.cos(k * np.pi / 6), np.sin(k * np.pi / 6), 0, 0]
        frame = world.add_frame(pos=self.T_base_mount[:3, 3])
        frame.quat = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
        arm_spec = mujoco.MjSpec.from_file(str(models_dir() / "arm" / "arm.xml"))
        spec.attach(arm_spec, frame=frame, prefix="arm/")
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.model.geom_surfacevel[self.model.geom("belt").id, 0] = -belt_speed
        self.drive = ArmDrive(
            self.model, "arm/", np.zeros(6) if zero_offset is None else zero_offset
        )
        self.gripper = GripperDrive(self.model, "arm/")
        self.motion = ArmMotion(arm, self.config)
        self.tick, self.tracking = 0, []
        self.drive.set_rest(self.data, self.motion.state(0.0).q)
        self.gripper.set_rest(self.data, 0.050)
        mujoco.mj_forward(self.model, self.data)

    @property
    def now(self) -> float:
        return self.tick * 0.010

    def to_mount(self, p_base):
        return apply(inverse(self.T_base_mount), p_base)

    def part_pose(self):
        """`T_base_part` and its velocity, from truth: the bench knows them exactly."""
        body = self.data.body("part")
        return transform(body.xmat.reshape(3, 3), body.xpos), self.data.joint("part").qvel[:3]

    def grip(self, width, force=20.0):
        self.gripper.command(GripperCommand(0, width, force))

    def step(self):
        """One tick of 10 ms; returns the TCP's distance from its reference, m."""
        command = self.motion.command(self.now)
        tcp = self.data.site("arm/tcp").xpos.copy()
        wanted = self.motion.kinematics.forward(command.position)[:3, 3]
        error = float(np.linalg.norm(self.to_mount(tcp) - wanted))
        self.drive.command(command)
        for _ in range(5):
            self.drive.apply(self.data)
            self.gripper.apply(self.data)
            mujoco.mj_step(self.model, self.data)
        mujoco.mj_kinematics(self.model, self.data)  # after mj_step poses are a step old
        self.tick += 1
        self.tracking.append(error)
        return error

    def run_until(self, time):
        """Largest tracking error until then, m."""
        errors = [0.0]
        while self.now < time - 1e-6:
            errors.append(self.step())
        return max(errors)

    def mount_yaw(self, yaw_base):
        R = inverse(self.T_base_mount)[:3, :3] @ rot_z(yaw_base)
        return float(np.arctan2(R[1, 0], R[0, 0]))

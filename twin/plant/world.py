"""The compiled cell: steps it, tells the truth about it, and fails loudly when physics does."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np

from twin.geometry import Array, rotation_from_quat, transform
from twin.layout import Layout, LayoutError
from twin.plant.as_built import AsBuilt
from twin.plant.contacts import CollisionCounter
from twin.plant.factory import build
from twin.plant.grips import Grip, GripWatcher
from twin.plant.shapes import Shape, shapes_of

ARMS = ("arm0", "arm1")
GRIP_STEPS = 5  # physics steps between looks at what the hands hold: once a tick of the stack


class PlantError(RuntimeError):
    """The simulation is no longer physics. The message is one line."""


@dataclass(frozen=True)
class Truth:
    """What is really so, at one time. For sensors' models, recorder and evaluation only."""

    stamp: float
    pose: Array  # (3,) x, y, yaw of the base in world
    T_world_base: Array  # (4, 4)
    velocity: Array  # (3,) vx, vy, omega of the base in base axes
    joint_position: Array  # (2, 6) rad
    T_world_tcp: Array  # (2, 4, 4)
    finger_width: Array  # (2,) m between the pads
    grips: tuple[Grip, Grip]  # what each hand holds
    part_names: tuple[str, ...]
    part_position: Array  # (n, 3) of the parts' frames in world
    part_quat: Array  # (n, 4) w, x, y, z
    part_velocity: Array  # (n, 3) m/s in world

    def T_world_part(self, name: str) -> Array:
        """Pose of one part. Shape (4, 4)."""
        i = self.part_names.index(name)
        return transform(rotation_from_quat(self.part_quat[i]), self.part_position[i])


class World:
    """The cell in MuJoCo. After construction and after `step`, all derived data belong to `time`.

    Args:
        layout: what stands where.
        as_built: deviations of this machine from the drawing.
        pool: parts of each class in the feeder's store; None lets the order decide.
        models: folder of the models, the installed one by default.
        parcel: whether one lies at goods-in.

    Raises:
        LayoutError: the models cannot be put together.
    """

    def __init__(
        self,
        layout: Layout,
        as_built: AsBuilt,
        pool: int | None = None,
        models: Path | None = None,
        parcel: bool = False,
    ):
        # MuJoCo would print its warnings and write MUJOCO_LOG.TXT into the working folder; `step`
        # reports them instead.
        mujoco.set_mju_user_warning(lambda text: None)
        spec = build(layout, as_built, pool, models, parcel)
        try:
            self.model = spec.compile()
        except ValueError as error:
            raise LayoutError(f"models: {str(error).splitlines()[0]}") from None
        self.data = mujoco.MjData(self.model)
        m = self.model
        self._belt = m.geom("line/belt").id
        self.set_belt_speed(layout.world.line.speed)
        self.part_names = tuple(
            m.body(b).name for b in range(m.nbody) if m.body(b).name.startswith("part_")
        )
        self._base_dof = int(m.joint("agv/base").dofadr[0])
        self._base_qpos = int(m.joint("agv/base").qposadr[0])
        part_joint = [m.joint(name).id for name in self.part_names]
        self._part_qpos = m.jnt_qposadr[part_joint][:, None] + np.arange(7)
        self._part_dof = m.jnt_dofadr[part_joint][:, None] + np.arange(6)
        self._arm_qpos = np.array(
            [[m.joint(f"{a}/joint{j}").qposadr[0] for j in range(1, 7)] for a in ARMS]
        )
        self._finger_qpos = np.array(
            [[m.joint(f"{a}/finger_{s}").qposadr[0] for s in ("left", "right")] for a in ARMS]
        )
        self._tcp = [m.site(f"{a}/tcp").id for a in ARMS]
        self._counter = CollisionCounter(m)
        self._grips, self._steps = GripWatcher(m), 0
        self._stale = False
        mujoco.mj_forward(m, self.data)

    # --- time --------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Seconds since the start."""
        return self.data.time

    def step(self) -> None:
        """One physics step of 2 ms under the present `data.ctrl`.

        The halves of `mj_step` are taken in the order 2, 1, so that positions, contacts and
        velocities belong to the new state; after a plain `mj_step` they would be one step old,
        2 mm at full speed.

        Raises:
            PlantError: MuJoCo warned, reset itself, or a state is not finite.
        """
        if self._stale:
            mujoco.mj_step1(self.model, self.data)
            self._stale = False
        before = self.data.time
        mujoco.mj_step2(self.model, self.data)
        self._steps += 1
        if self._steps % GRIP_STEPS == 0:  # here, since these contacts have their forces now
            self._grips.observe(self.data)
        mujoco.mj_step1(self.model, self.data)
        if self.data.warning.number.any():
            raise PlantError(f"MuJoCo warned at {before:.3f} s: {self._warnings()}")
        if not self.data.time > before:
            raise PlantError(f"physics was reset at {before:.3f} s")
        self._counter.observe(self.data.time, self.data)

    def _warnings(self) -> str:
        """Names of MuJoCo's warnings so far, such as BADQPOS: not a number in a position."""
        number = self.data.warning.number
        kinds = mujoco.mjtWarning.__members__
        return ", ".join(
            name.removeprefix("mjWARN_")
            for name, kind in kinds.items()
            if kind.value < len(number) and number[kind.value]
        )

    # --- what the feeder and the faults may write -----------------------------------------------

    def place_part(self, name: str, position, quat_wxyz, velocity=(0.0, 0.0, 0.0)) -> None:
        """Put a part somewhere, with a velocity in world. For feeder and faults alone."""
        if name not in self.part_names:
            raise PlantError(f"there is no part '{name}' in the store")
        self.place(name, position, quat_wxyz, velocity)

    def place(self, joint: str, position, quat_wxyz, velocity=(0.0, 0.0, 0.0)) -> None:
        """Put what hangs on a free joint somewhere, with a velocity in world.

        Its own joints keep their positions and come to rest. For feeder and faults alone.
        """
        v = self._write_pose(self.data, joint, position, quat_wxyz)
        self.data.qvel[v : v + 3] = velocity
        self._stale = True

    def would_touch(self, joint: str, position, quat_wxyz) -> tuple[str, ...]:
        """Names of all, save the floor, that would be touched if something were placed there."""
        m = self.model
        scratch = mujoco.MjData(m)
        mujoco.mj_copyData(scratch, m, self.data)
        self._write_pose(scratch, joint, position, quat_wxyz)
        mujoco.mj_forward(m, scratch)
        tree = m.body_treeid[m.joint(joint).bodyid[0]]
        pairs = scratch.contact.geom[scratch.contact.dist < 0]
        ours = m.body_treeid[m.geom_bodyid[pairs]] == tree
        others = np.where(ours[:, 0], pairs[:, 1], pairs[:, 0])[ours[:, 0] != ours[:, 1]]
        return tuple(sorted({m.geom(g).name for g in others.tolist()} - {"floor"}))

    def _write_pose(self, data: mujoco.MjData, joint: str, position, quat_wxyz) -> int:
        """Write the pose of a free joint, and rest for its whole tree. Returns its first dof."""
        m = self.model
        q, v = int(m.joint(joint).qposadr[0]), int(m.joint(joint).dofadr[0])
        data.qpos[q : q + 7] = (*position, *quat_wxyz)
        data.qvel[m.dof_treeid == m.dof_treeid[v]] = 0.0
        return v

    def refresh(self) -> None:
        """Bring all derived data up to the state, after it was set before the run."""
        mujoco.mj_forward(self.model, self.data)

    def move_to(self, data: mujoco.MjData) -> None:
        """Go on in other memory, which gets the present state."""
        mujoco.mj_copyData(data, self.model, self.data)
        self.data = data

    def set_belt_speed(self, speed: float) -> None:
        """Run the belt at `speed` m/s along its direction."""
        self.model.geom_surfacevel[self._belt, 0] = speed

    # --- truth -------------------------------------------------------------------------------

    def belt_frame(self) -> Array:
        """x, y, yaw in world of the belt's upstream end, as built; x along its way. Shape (3,)."""
        R = self.data.geom_xmat[self._belt].reshape(3, 3)
        start = self.data.geom_xpos[self._belt] - R[:, 0] * self.model.geom_size[self._belt, 0]
        return np.array([*start[:2], np.arctan2(R[1, 0], R[0, 0])])

    @property
    def collisions(self):
        """Onsets of all collisions so far."""
        return self._counter.onsets

    def base_motion(self) -> tuple[Array, Array]:
        """Pose (3,) x, y, yaw of the base in world, and velocity (3,) vx, vy, omega in its axes."""
        d, q, v = self.data, self._base_qpos, self._base_dof
        R = rotation_from_quat(d.qpos[q + 3 : q + 7])
        velocity = R.T @ d.qvel[v : v + 3]
        pose = np.array([d.qpos[q], d.qpos[q + 1], np.arctan2(R[1, 0], R[0, 0])])
        return pose, np.array([velocity[0], velocity[1], d.qvel[v + 5]])

    def base_height(self) -> float:
        """Of the base's origin over the floor, m: what the rollers give."""
        return float(self.data.qpos[self._base_qpos + 2])

    def truth(self) -> Truth:
        """The true state now."""
        d, q = self.data, self._base_qpos
        R = rotation_from_quat(d.qpos[q + 3 : q + 7])
        pose, velocity = self.base_motion()
        tcp = [transform(d.site_xmat[s].reshape(3, 3), d.site_xpos[s]) for s in self._tcp]
        parts = d.qpos[self._part_qpos]
        return Truth(
            stamp=d.time,
            pose=pose,
            T_world_base=transform(R, d.qpos[q : q + 3]),
            velocity=velocity,
            joint_position=d.qpos[self._arm_qpos],
            T_world_tcp=np.array(tcp),
            finger_width=d.qpos[self._finger_qpos].sum(axis=1),
            grips=self._grips.held,
            part_names=self.part_names,
            part_position=parts[:, :3],
            part_quat=parts[:, 3:],
            part_velocity=d.qvel[self._part_dof[:, :3]],
        )

    # --- for a recorder ------------------------------------------------------------------------

    @cached_property
    def shapes(self) -> tuple[Shape, ...]:
        """Everything that can be seen, as plain primitives and meshes."""
        return shapes_of(self.model)

    def body_poses(self) -> tuple[Array, Array]:
        """Positions (nbody, 3) and quaternions wxyz (nbody, 4) of all bodies in world."""
        return self.data.xpos.copy(), self.data.xquat.copy()

"""Drive of one parallel gripper: speed-limited opening with a force limit (Robotiq Hand-E class).

The set-point runs towards the wanted opening at most at `MAX_SPEED`, and never further ahead of
the fingers than the force limit can hold, so a grip builds up its force and does not wind up.
"""

import mujoco
import numpy as np

from twin.messages import GripperCommand

STROKE = 0.050  # m: models/arm/README.md, as the two below
MAX_SPEED = 0.150  # m/s of the opening
MAX_FORCE = 185.0  # N, each finger
# Fingers and rotor weigh 0.13 kg in the opening's coordinate: 175 rad/s, damping 0.9. Not tuned.
KP, KD = 4000.0, 40.0  # N/m, N s/m


class GripperDrive:
    """Gripper of one arm in the plant.

    Args:
        model: the compiled world.
        prefix: of the arm's names, "arm0/".
    """

    def __init__(self, model: mujoco.MjModel, prefix: str):
        fingers = [model.joint(f"{prefix}finger_{side}") for side in ("left", "right")]
        self._qpos = np.array([int(j.qposadr[0]) for j in fingers])
        self._dof = np.array([int(j.dofadr[0]) for j in fingers])
        self._ctrl = model.actuator(f"{prefix}grip").id
        self._dt = model.opt.timestep
        self._goal: GripperCommand | None = None
        self._reference: float | None = None
        self.force = 0.0  # N, each finger, closing positive: what the drive itself measures

    def width(self, data: mujoco.MjData) -> float:
        """Opening between the pads, m."""
        return float(data.qpos[self._qpos].sum())

    def set_rest(self, data: mujoco.MjData, width: float) -> None:
        """Before the run begins: put the fingers at an opening."""
        data.qpos[self._qpos] = width / 2
        data.qvel[self._dof] = 0.0

    def command(self, goal: GripperCommand) -> None:
        """Take a new opening and force limit."""
        self._goal = goal

    def apply(self, data: mujoco.MjData) -> None:
        """Write the drive's force. Call once at each physics step, before it."""
        width, speed = self.width(data), float(data.qvel[self._dof].sum())
        if self._reference is None:
            self._reference = width
        goal = self._goal or GripperCommand(-1, width, 20.0)
        limit = min(max(goal.force, 0.0), MAX_FORCE)
        target = min(max(goal.width, 0.0), STROKE)
        step = MAX_SPEED * self._dt
        wanted = self._reference + min(max(target - self._reference, -step), step)
        lead = limit / KP
        reference = min(max(wanted, width - lead), width + lead)
        reference_speed = (reference - self._reference) / self._dt
        self._reference = reference
        force = KP * (reference - width) + KD * (reference_speed - speed)
        force = min(max(force, -limit), limit)
        self.force = -force
        data.ctrl[self._ctrl] = force

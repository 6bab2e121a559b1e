"""Six joint drives of one arm: PD on the encoder, feed-forward, torque and speed limits.

    tau = kp (q_d + qd_d t - q_e) + kd (qd_d - qd_e) + tau_ff,   |tau| <= max_torque

where t is the time since the set-point and q_e the encoder's angle: the true one plus the joint's
as-built zero offset. The drive knows no other angle.
"""

import mujoco
import numpy as np

from twin.geometry import Array
from twin.messages import ArmCommand

# 75 rad/s with the stretched arm's inertia (about 1.1, 0.45, 0.06 kg m^2 with the rotors), damping
# 0.7 and above; on the folded arm kd dt / I stays below 1. Computed, not tuned.
KP = np.array([6000.0, 6000.0, 2500.0, 400.0, 400.0, 350.0])  # N m/rad
KD = np.array([120.0, 120.0, 50.0, 9.0, 9.0, 8.0])  # N m s/rad
MAX_TORQUE = np.array([50.0, 50.0, 32.0, 32.0, 32.0, 20.0])  # N m: models/arm/README.md
MAX_SPEED = np.radians(180.0)  # rad/s: the same
RESOLUTION = 2 * np.pi / 2**19  # rad: 19-bit absolute encoder at the output, a common joint module
HOLD = 0.050  # s after which a drive that hears nothing stands still: guess


class ArmDrive:
    """Drives of one arm in the plant.

    Args:
        model: the compiled world.
        prefix: of the arm's names, "arm0/".
        zero_offset: as built, what the encoder reads too much, rad. Shape (6,).
    """

    def __init__(self, model: mujoco.MjModel, prefix: str, zero_offset: Array):
        joints = [model.joint(f"{prefix}joint{i}") for i in range(1, 7)]
        self._qpos = np.array([int(j.qposadr[0]) for j in joints])
        self._dof = np.array([int(j.dofadr[0]) for j in joints])
        self._ctrl = np.array([model.actuator(f"{prefix}motor{i}").id for i in range(1, 7)])
        self._dt = model.opt.timestep
        self._zero = np.array(zero_offset, dtype=float)
        self._goal: ArmCommand | None = None
        self._since = 0.0
        self._last: Array | None = None

    def encoder(self, data: mujoco.MjData) -> Array:
        """What the joint encoders read, rad. Shape (6,)."""
        return np.round((data.qpos[self._qpos] + self._zero) / RESOLUTION) * RESOLUTION

    def set_rest(self, data: mujoco.MjData, q: Array) -> None:
        """Before the run begins: stand where the encoders read q, rad. Shape (6,)."""
        data.qpos[self._qpos] = q - self._zero
        data.qvel[self._dof] = 0.0

    def command(self, goal: ArmCommand) -> None:
        """Take new set-points."""
        self._goal, self._since = goal, 0.0

    def apply(self, data: mujoco.MjData) -> None:
        """Write the motors' torques. Call once at each physics step, before it."""
        q = self.encoder(data)
        qd = (q - self._last) / self._dt if self._last is not None else np.zeros(6)
        self._last = q
        if self._goal is None:  # switched on without a word: hold
            self._goal = ArmCommand(-1, q, np.zeros(6), np.zeros(6))
        goal = self._goal
        late = self._since > HOLD
        speed = np.zeros(6) if late else np.clip(goal.velocity, -MAX_SPEED, MAX_SPEED)
        ahead = goal.position + np.clip(goal.velocity, -MAX_SPEED, MAX_SPEED) * min(
            self._since, HOLD
        )
        torque = KP * (ahead - q) + KD * (speed - qd) + goal.torque
        # A joint at full speed is not driven faster.
        torque = np.where((np.abs(qd) > MAX_SPEED * 1.05) & (torque * qd > 0), 0.0, torque)
        data.ctrl[self._ctrl] = np.clip(torque, -MAX_TORQUE, MAX_TORQUE)
        self._since += self._dt

"""Feed-forward torque of one arm by inverse dynamics (recursive Newton-Euler in pinocchio)."""

from pathlib import Path

import numpy as np
import pinocchio as pin

from twin.geometry import Array

FINGERS = ("finger_left", "finger_right")
FRICTION_SPEED = 0.02  # rad/s at which the friction term saturates: guess, above encoder noise


class ArmDynamics:
    """Rigid-body model of the six joints, the fingers held half open.

    Args:
        model_path: the arm's own MJCF file. pinocchio reads only the first child of worldbody.
    """

    def __init__(self, model_path: Path):
        full = pin.buildModelFromMJCF(str(model_path))
        half_open = pin.neutral(full)
        fingers = [full.getJointId(name) for name in FINGERS]
        for joint in fingers:
            half_open[full.joints[joint].idx_q] = 0.0125
        self.model = pin.buildReducedModel(full, fingers, half_open)
        self._friction = np.array([full.upperDryFrictionLimit[i] for i in range(self.model.nv)])
        self._damping = np.array(full.damping[: self.model.nv])
        self._data = self.model.createData()
        self._tcp = self.model.getFrameId("tcp")
        self._hand = pin.Inertia(self.model.inertias[6])

    def set_payload(self, mass: float) -> None:
        """A point mass in the hand, kg."""
        point = pin.Inertia(
            mass, self.model.frames[self._tcp].placement.translation, np.zeros((3, 3))
        )
        self.model.inertias[6] = self._hand + point

    def torque(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Joint torques for a motion, friction of the drawing included, N m. Shape (6,)."""
        tau = pin.rnea(self.model, self._data, q, qd, qdd)
        return tau + self._damping * qd + self._friction * np.tanh(qd / FRICTION_SPEED)

    def forward(self, q: Array) -> Array:
        """`T_mount_tcp` by the rigid-body model, a check on the closed form. Shape (4, 4)."""
        pin.framesForwardKinematics(self.model, self._data, q)
        return self._data.oMf[self._tcp].homogeneous

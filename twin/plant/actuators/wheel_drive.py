"""PWM bridge of the four wheel motors; the motor itself is MuJoCo's `dcmotor` in models/agv.

The bridge puts the mean voltage of its duty on the motor. Its 24 V are stabilised from the 28 V
battery (Li & An 2025, section 1.3), so they do not sag with the load; ripple of the current at the
switching frequency is far above the drive's time constant and left out.
"""

import mujoco
import numpy as np

from twin.geometry import Array

SUPPLY = 24.0  # V
WHEELS = ("agv/wheel_fl", "agv/wheel_fr", "agv/wheel_rl", "agv/wheel_rr")


class WheelDrive:
    """Duty in [-1, 1] to motor volts."""

    def __init__(self, model: mujoco.MjModel):
        self._ctrl = np.array([model.actuator(name).id for name in WHEELS])

    def apply(self, data: mujoco.MjData, pwm: Array) -> None:
        """Put the duty `pwm`, shape (4,), on the bridges; it is held until the next call."""
        data.ctrl[self._ctrl] = SUPPLY * np.clip(pwm, -1.0, 1.0)

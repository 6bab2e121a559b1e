"""Wheel-speed loop of the mecanum base (Li & An 2025, section 1.2)."""

import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array
from twin.messages import BodyVelocity, WheelState
from twin.stack.config import Wheels
from twin.stack.control import mecanum
from twin.stack.control_unit.counts import CountDecoder
from twin.stack.control_unit.wheel_pid import (
    NOMINAL_GAINS,
    NOMINAL_MOTOR,
    MotorDrawing,
    PidGains,
    WheelPid,
)

PERIOD = 0.002  # s between calls


class ControlUnit:
    """Counts to wheel speeds and body velocity; wanted body velocity to PWM.

    The unit keeps its own time, counted in periods since it was switched on.

    Args:
        wheels: nominal dimensions of the base.
        motor: nominal drive.
        gains: of the wheel-speed loops.
        start: time of the first call, s.
    """

    def __init__(
        self,
        wheels: Wheels,
        motor: MotorDrawing = NOMINAL_MOTOR,
        gains: PidGains = NOMINAL_GAINS,
        start: float = 0.0,
    ):
        self._wheels = wheels
        self._decoder = CountDecoder(wheels.counts_per_turn * wheels.gear_ratio, PERIOD)
        self._pid = WheelPid(wheels.gear_ratio, PERIOD, motor, gains)
        self._start, self._calls = start, 0
        self._command = BodyVelocity()
        self._reference = np.zeros(4)  # rad/s, of that command

    def step(
        self, ticks: NDArray[np.uint16], body_velocity: BodyVelocity
    ) -> tuple[Array, WheelState]:
        """One period: duty of the four drives in [-1, 1], shape (4,), and the wheels' state."""
        stamp = self._start + self._calls * PERIOD
        self._calls += 1
        speed = self._decoder.update(ticks)
        if body_velocity is not self._command:  # a new one comes every fifth call at most
            self._command = body_velocity
            allowed = mecanum.within_limits(self._wheels, body_velocity.as_array())
            self._reference = mecanum.wheel_speeds(self._wheels, allowed)
        pwm = self._pid.step(self._reference, speed, self._decoder.angle)
        measured = mecanum.body_velocity(self._wheels, speed)
        return pwm, WheelState(stamp, self._decoder.total, speed, measured)

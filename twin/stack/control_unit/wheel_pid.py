"""Speed control of the four wheel drives: feed-forward of the motor's law plus PI with anti-windup.

Steady state of a DC motor behind a gearbox of ratio n (Maxon key information 2009, "motor as an
energy converter"): V = k n w + R tau / (k n), tau the torque at the wheel. The feed-forward takes
back EMF and dry friction from the data sheet; the PI closes what is left.
"""

from dataclasses import dataclass

import numpy as np

from twin.geometry import Array


@dataclass(frozen=True)
class MotorDrawing:
    """Nominal drive as the data sheet gives it: maxon EC 45 flat, 24 V, no. 339281."""

    supply: float = 24.0  # V
    torque_constant: float = 0.0509  # N m/A = V s/rad: 253 mN m at 4.97 A, stall
    resistance: float = 4.83  # ohm: 24 V at 4.97 A, stall
    friction: float = 0.12  # N m at the wheel: motor's no-load current and gearbox, guess


@dataclass(frozen=True)
class PidGains:
    """In volts. Set from the drive's plant, V -> w, which is first order.

    With a quarter of the vehicle's 60 kg on each wheel the inertia at the wheel is about
    15 x 0.076^2 + 0.0037 = 0.09 kg m^2 (0.0051 of it turns even when the rollers spin freely) and
    the motor's own damping (k n)^2 / R = 0.21 N m s/rad: time constant 0.4 s, gain 1 / (k n).
    """

    proportional: float = 4.0  # V s/rad: closed loop 0.4 s / (1 + 4 / 1.02) = 0.08 s
    integral: float = 20.0  # V/rad: zero at 5 rad/s, below the loop's 12 rad/s
    derivative: float = 0.0  # V s^2/rad: the plant is first order, D would only amplify counts
    dead_band: float = 0.02  # rad/s of reference below which no friction is fed forward
    # Parking: a spring and a damper at the wheel, 60 rad/s and damping 0.8 with 0.09 kg m^2,
    # brought to volts by k n / R = 0.21 N m/V. Arms at work push with some 30 N: 0.1 mm.
    hold_stiffness: float = 1540.0  # V/rad
    hold_damping: float = 40.0  # V s/rad
    hold_below: float = 0.15  # rad/s: wheels slower than this are taken hold of


NOMINAL_MOTOR, NOMINAL_GAINS = MotorDrawing(), PidGains()


class WheelPid:
    """PID on the speeds of four wheels at once; output is the PWM duty in [-1, 1].

    Args:
        gear_ratio: motor turns a wheel turn.
        period: seconds between calls.
        motor: nominal drive.
        gains: of the controller.
    """

    def __init__(
        self,
        gear_ratio: float,
        period: float,
        motor: MotorDrawing = NOMINAL_MOTOR,
        gains: PidGains = NOMINAL_GAINS,
    ):
        self._period, self._motor, self._gains = period, motor, gains
        self._back_emf = motor.torque_constant * gear_ratio  # V s/rad at the wheel
        self._friction = motor.friction * motor.resistance / self._back_emf  # V
        self.integral = np.zeros(4)  # V
        self._error = np.zeros(4)
        self._held: Array | None = None  # rad, angle at which the wheels are parked

    def step(self, reference: Array, speed: Array, angle: Array) -> Array:
        """Duty of the four drives from wanted and measured wheel speeds, rad/s. Shape (4,).

        Anti-windup by clamping: an integrator stands still while its drive is saturated and the
        error would push it further out. Told to stand, the wheels are parked once they are slow:
        their angle (rad, of any origin) is held, so that working arms do not push the vehicle off.
        """
        g = self._gains
        if np.any(reference):
            self._held = None
        elif self._held is None and np.max(np.abs(speed)) < g.hold_below:
            self._held = angle.copy()
        if self._held is not None:
            self.integral, self._error = np.zeros(4), -speed
            volts = g.hold_stiffness * (self._held - angle) - g.hold_damping * speed
            return np.clip(volts / self._motor.supply, -1.0, 1.0)
        error = reference - speed
        slope = (error - self._error) / self._period
        self._error = error
        moving = np.abs(reference) > g.dead_band
        forward = self._back_emf * reference + self._friction * np.sign(reference) * moving
        candidate = self.integral + g.integral * self._period * error
        volts = forward + g.proportional * error + g.derivative * slope + candidate
        saturated = np.abs(volts) > self._motor.supply
        outward = volts * error > 0
        self.integral = np.where(saturated & outward, self.integral, candidate)
        return np.clip(volts / self._motor.supply, -1.0, 1.0)

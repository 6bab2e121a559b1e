"""Extended Kalman filter of planar motion from wheels and inertial unit.

As in Li & An 2025, section 2.2, measured acceleration drives the prediction and the wheels correct
it; here the measured rate drives the yaw too. What the wheels report differs from the motion of the
vehicle by a slip that changes slowly and grows with speed: it is part of the state, in units of its
expected size, so a wheel that lies by a constant per cent is not taken for white noise.
"""

from dataclasses import dataclass

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from twin.geometry import Array, rot2, wrap_angle
from twin.stack.config import Imu

POSITION = slice(0, 2)  # m, in world
YAW = 2  # rad
VELOCITY = slice(3, 5)  # m/s, of the base in base axes
RATE = 5  # rad/s
GYRO_BIAS = 6  # rad/s
ACCEL_BIAS = slice(7, 9)  # m/s^2, in base axes
SLIP = slice(9, 12)  # what the wheels report minus the motion, in units of `slip_size`
SIZE = 12

POSE = slice(0, 3)
TWIST = slice(3, 6)


@dataclass(frozen=True)
class Noise:
    """What the filter believes of the vehicle's motion and wheels.

    Slip and white noise of the wheels were tuned on drives of the default cell (seeds 0-4), where
    wheels turn true to 0.1 per cent at cruise, but for vehicles on which one stands a little off
    the floor.
    """

    # Size of the slip of vx, vy (m/s) and omega (rad/s): constant, per m/s, per rad/s of turning.
    slip: tuple[tuple[float, float, float], ...] = (
        (0.002, 0.002, 0.002),
        (0.002, 0.004, 0.002),
        (0.005, 0.003, 0.015),
    )
    slip_time: float = 0.5  # s, correlation time of the slip
    wheel: tuple[float, float, float] = (0.003, 0.004, 0.010)  # m/s, m/s, rad/s: white
    vibration: float = 0.002  # m/s^2/sqrt(Hz): the deck tilts 0.1 mrad under acceleration
    blind_accel: float = 1.0  # m/s^2/sqrt(Hz), while the inertial unit is silent; guess
    blind_turn: float = 3.0  # rad/s^2/sqrt(Hz), likewise
    mistaken: tuple[float, float, float] = (0.1, 0.1, 0.2)  # m/s, m/s, rad/s; guess
    still: tuple[float, float, float] = (0.001, 0.001, 0.0002)  # m/s, m/s, rad/s: sway; guess


GATE = 16.27  # squared Mahalanobis distance: chi-square, 3 degrees of freedom, 99.9 %


class MotionEkf(ExtendedKalmanFilter):
    """The filter proper: readings in order of time, no clock.

    Args:
        imu: data sheet of the inertial unit.
        pose: x, y, yaw at the start.
        sigma: standard deviation of that pose, m, m, rad.
        noise: belief about motion and wheels.
    """

    def __init__(self, imu: Imu, pose: Array, sigma, noise: Noise | None = None):
        super().__init__(dim_x=SIZE, dim_z=3)
        self.imu, self.noise = imu, noise or Noise()
        self._slip_law = np.array(self.noise.slip)
        self.x = np.zeros(SIZE)
        self.x[POSE] = pose
        start = np.zeros(SIZE)
        start[POSE] = sigma
        start[TWIST] = 0.01, 0.01, 0.01  # it starts at rest; guess
        start[GYRO_BIAS] = imu.gyro_bias_start
        start[ACCEL_BIAS] = imu.accel_bias_start
        start[SLIP] = 1.0
        self.P = np.diag(start**2)
        self.acceleration = np.zeros(2)  # of the velocity in base axes, m/s^2

    def advance(self, dt: float, accel: Array | None, gyro: float | None) -> None:
        """Predict over `dt` by mean specific force (2,) and rate; None while the unit is silent."""
        x = self.x
        blind = accel is None or gyro is None
        rate = x[RATE] if gyro is None else gyro - x[GYRO_BIAS]
        vx, vy = x[VELOCITY]
        spin = np.array([[0.0, rate], [-rate, 0.0]])  # the axes turn under the velocity
        thrust = -spin @ x[VELOCITY] if accel is None else accel - x[ACCEL_BIAS]
        self.acceleration = thrust + spin @ x[VELOCITY]
        R = rot2(x[YAW] + 0.5 * rate * dt)
        step = x[VELOCITY] * dt + 0.5 * self.acceleration * dt**2
        swing = R @ np.array([-step[1], step[0]])  # change of the step per rad of yaw

        turn = np.array([vy, -vx])  # change of acceleration per rad/s of rate
        by_rate = np.zeros(SIZE)  # derivative of the new state by the rate
        by_rate[POSITION] = 0.5 * dt * swing + 0.5 * dt**2 * (R @ turn)
        by_rate[YAW] = dt
        by_rate[VELOCITY] = dt * turn
        by_rate[RATE] = 1.0
        by_accel = np.zeros((SIZE, 2))
        by_accel[POSITION] = 0.5 * dt**2 * R
        by_accel[VELOCITY] = dt * np.eye(2)

        F = np.eye(SIZE)
        F[POSITION, YAW] = swing
        F[POSITION, VELOCITY] = R @ (dt * np.eye(2) + 0.5 * dt**2 * spin)
        F[VELOCITY, VELOCITY] += dt * spin
        F[RATE, RATE] = 0.0
        if blind:  # the rate is carried over, the body velocity too
            by_rate[POSITION], by_rate[VELOCITY] = 0.5 * dt * swing, 0.0
            F[POSITION, VELOCITY], F[VELOCITY, VELOCITY] = dt * R, np.eye(2)
            F[:, RATE] = by_rate
        else:
            F[:, GYRO_BIAS] -= by_rate
            F[:, ACCEL_BIAS] -= by_accel
        keep = np.exp(-dt / self.noise.slip_time)
        F[SLIP, SLIP] *= keep

        self.F = F
        self.Q = self._process_noise(dt, rate, by_rate, by_accel, blind)
        x = x.copy()
        x[POSITION] += R @ step
        x[YAW] = wrap_angle(x[YAW] + rate * dt)
        x[VELOCITY] += self.acceleration * dt
        x[RATE] = rate
        x[SLIP] *= keep
        self._predicted = x
        self.predict()

    def predict_x(self, u=0) -> None:
        self.x = self._predicted

    def _process_noise(self, dt: float, rate: float, by_rate: Array, by_accel: Array, blind: bool):
        n, imu = self.noise, self.imu
        # A one-sided density d gives the mean over dt the variance d^2 / (2 dt).
        gyro = n.blind_turn**2 * dt if blind else imu.gyro_noise**2 / (2 * dt)
        accel = n.blind_accel if blind else float(np.hypot(imu.accel_noise, n.vibration))
        Q = gyro * np.outer(by_rate, by_rate) + accel**2 / (2 * dt) * by_accel @ by_accel.T
        # A scale error adds up over a turn; as white noise it does over a quarter turn.
        Q[YAW, YAW] += imu.gyro_scale**2 * (np.pi / 2) * abs(rate) * dt
        drift = 2 * dt / imu.bias_time
        Q[GYRO_BIAS, GYRO_BIAS] += imu.gyro_bias_stability**2 * drift
        Q[ACCEL_BIAS, ACCEL_BIAS] += imu.accel_bias_stability**2 * drift * np.eye(2)
        Q[SLIP, SLIP] += np.eye(3) * (1 - np.exp(-2 * dt / n.slip_time))
        return Q

    def slip_size(self, x: Array) -> tuple[Array, Array]:
        """Expected size of the slip, shape (3,), and its derivative by vx, vy, omega, (3, 3)."""
        law = self._slip_law
        speed = float(np.hypot(*x[VELOCITY]))
        size = law @ (1.0, speed, abs(x[RATE]))
        direction = x[VELOCITY] / max(speed, 1e-9)
        by_twist = np.column_stack([np.outer(law[:, 1], direction), law[:, 2] * np.sign(x[RATE])])
        return size, by_twist

    def update_wheels(self, velocity: Array, interval: float) -> bool:
        """Correct by the mean body velocity (3,) of the wheels over the interval that ends now.

        Returns:
            False if the reading lies outside the gate; the state is then unchanged.
        """
        expected, H, R = self._wheel_model(interval)
        return self._gated(velocity, expected, H, R)

    def agrees(self, velocity: Array, interval: float) -> bool:
        """Whether such a reading lies inside the gate."""
        expected, H, R = self._wheel_model(interval)
        return self._inside(velocity - expected, H, R)

    def _wheel_model(self, interval: float) -> tuple[Array, Array, Array]:
        """Expected reading of the wheels, its Jacobian and its noise."""
        # The mean over the interval lags behind the velocity at its end. That the lag depends on
        # the biases too is left out of the Jacobian: 5 ms times their error.
        lag = 0.5 * interval * np.array([*self.acceleration, 0.0])
        R = np.diag(np.square(self.noise.wheel))
        return self.wheels_of(self.x) - lag, self.wheel_jacobian(self.x), R

    def wheels_of(self, x: Array) -> Array:
        """Body velocity that the wheels report in a state: motion plus slip. Shape (3,)."""
        return x[TWIST] + self.slip_size(x)[0] * x[SLIP]

    def wheel_jacobian(self, x: Array) -> Array:
        """Derivative of `wheels_of` by the state. Shape (3, 12)."""
        size, by_twist = self.slip_size(x)
        H = np.zeros((3, SIZE))
        H[:, TWIST] = np.eye(3) + x[SLIP, None] * by_twist
        H[:, SLIP] = np.diag(size)
        return H

    def park(self, pose: Array, covariance: Array, twist: Array) -> bool:
        """Correct by the knowledge that the vehicle is parked; this teaches the biases.

        Parked wheels do not slip: the pose is the one at which it came to rest, carried on by the
        wheels' counts, with the covariance it had then. The unit's readings, which a deck tilting
        under working arms would turn into motion, no longer move it.

        Args:
            pose: x, y, yaw in world by that rule. Shape (3,).
            covariance: of the pose when it came to rest. Shape (3, 3).
            twist: vx, vy, omega that the wheels report. Shape (3,).
        """
        H = np.zeros((3, SIZE))
        H[:, TWIST] = np.eye(3)
        R = np.diag(np.square(self.noise.still))
        inside = self._gated(twist, self.x[TWIST], H, R)
        self.x[POSE] = pose
        self.P[POSE, :], self.P[:, POSE] = 0.0, 0.0
        self.P[POSE, POSE] = covariance
        return inside

    def loosen_twist(self, offset: Array) -> None:
        """Give up the belief in the velocity: wheels that do not slip contradict it by (3,)."""
        self.P[TWIST, TWIST] += np.diag(np.square(self.noise.mistaken) + np.square(offset))

    def forget_slip(self) -> None:
        """Wheels that grip again slip by an amount that has nothing to do with the one before."""
        self.x[SLIP] = 0.0
        self.P[SLIP, :], self.P[:, SLIP] = 0.0, 0.0
        self.P[SLIP, SLIP] = np.eye(3)

    def _inside(self, innovation: Array, H: Array, R: Array) -> bool:
        return bool(innovation @ np.linalg.solve(H @ self.P @ H.T + R, innovation) <= GATE)

    def _gated(self, z: Array, expected: Array, H: Array, R: Array) -> bool:
        if not self._inside(z - expected, H, R):
            return False
        self.update(z, lambda x: H, lambda x: expected, R)
        self.x[YAW] = wrap_angle(self.x[YAW])
        return True

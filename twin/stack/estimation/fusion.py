"""Feeds the filter: orders the readings, tells standing from driving, answers where we are now.

Wheel counts arrive at once, the inertial unit later. The filter therefore lives at the newest time
for which the inertial unit has spoken, and the pose of the present is carried on from there.
"""

from collections import deque
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array, compose2
from twin.messages import ImuReading, WheelState
from twin.stack.config import StackConfig
from twin.stack.estimation.ekf import GYRO_BIAS, POSE, SLIP, TWIST, MotionEkf, Noise
from twin.stack.estimation.odometry import displacement, exp2
from twin.stack.estimation.pose_history import PoseHistory
from twin.stack.estimation.rewind import Rewind
from twin.stack.estimation.slip import SlipMonitor, closure

SILENCE = 0.10  # s without the inertial unit after which the wheels go on alone
STILL_TIME = 0.20  # s that all wheels must stand before the vehicle is said to stand
STILL_COUNTS = 150  # counts that a parked wheel may wander: 24 mrad, arms at work shake it
MAX_ACCEL = 15.0  # m/s^2: beyond what tyres can do (1.5 g); such a reading is broken
MAX_RATE = 10.0  # rad/s: ten times what the drive can do; likewise
REWIND = 0.3  # s of the wheels' word that is taken back when they turn out to slip
SLIP_GATE = 11.34  # squared size of the slip state: chi-square, 3 degrees of freedom, 99 %
READY_SIGMA = 0.8e-4  # rad/s of gyro bias: 1.6 mrad of yaw over a mission of 20 s of driving


class FusedOdometry:
    """Pose and velocity of the vehicle from wheels and inertial unit.

    Args:
        config: the nominal drawing; start covariance from `odometry_start_sigma`.
        start: x, y, yaw believed at the start, in world.
    """

    def __init__(self, config: StackConfig, start: Array, noise: Noise | None = None):
        self._wheels = config.wheels
        self._rim_angle = 2 * np.pi / (config.wheels.gear_ratio * config.wheels.counts_per_turn)
        self.ekf = MotionEkf(config.imu, start, config.odometry_start_sigma, noise)
        self.history = PoseHistory()
        self.stamp: float | None = None  # of the filter's state
        self.ignored = 0  # readings that came too late or were broken
        self.standing = False
        self.slip = SlipMonitor()
        self._shaken = False  # an inertial reading was dropped: what it told is missing
        self._rewind = Rewind(self.ekf, REWIND)
        # Since the vehicle stands: pose, wheels and covariance of the moment it came to rest.
        self._parked: tuple[Array, WheelState, Array] | None = None
        self._wheel_queue: list[WheelState] = []
        self._last_wheel: WheelState | None = None
        self._still: deque[WheelState] = deque()

    @property
    def covariance(self) -> Array:
        """Of x, y, yaw. Shape (3, 3)."""
        return self.ekf.P[POSE, POSE].copy()

    @property
    def velocity(self) -> Array:
        """vx, vy, omega in base. Shape (3,)."""
        return self.ekf.x[TWIST].copy()

    @property
    def ready(self) -> bool:
        """Whether the gyro bias is known well enough to drive: stand for 2-3 s after switch-on."""
        return bool(self.ekf.P[GYRO_BIAS, GYRO_BIAS] < READY_SIGMA**2)

    def pose(self, now: float) -> Array:
        """x, y, yaw in world, carried on from the filter's time to `now`. Shape (3,)."""
        ahead = 0.0 if self.stamp is None else max(now - self.stamp, 0.0)
        return compose2(self.ekf.x[POSE], exp2(self.ekf.x[TWIST] * ahead))

    def step(self, readings: Iterable) -> None:
        """Take the readings of a tick, in any order; other kinds than wheels and IMU are passed by.

        Broken and late readings leave the state as it is and are counted in `ignored`.
        """
        imus = []
        for reading in readings:
            if isinstance(reading, WheelState) and self._usable(reading, reading.ticks):
                self._wheel_queue.append(reading)
            elif isinstance(reading, ImuReading) and self._plausible(reading):
                imus.append(reading)
        self._wheel_queue.sort(key=lambda r: r.stamp)
        for imu in sorted(imus, key=lambda r: r.stamp):
            accel, gyro = imu.accel[:2], float(imu.gyro[2])
            while self._wheel_queue and self._wheel_queue[0].stamp <= imu.stamp:
                wheel = self._wheel_queue.pop(0)
                if self._advance(wheel.stamp, accel, gyro):
                    self._correct(wheel)
            self._advance(imu.stamp, accel, gyro)
        while self._wheel_queue and self._is_silent(self._wheel_queue[-1].stamp):
            wheel = self._wheel_queue.pop(0)
            if self._advance(wheel.stamp, None, None):
                self._correct(wheel)
        if self.stamp is not None:
            self.history.add(self.stamp, self.ekf.x[POSE])

    def _usable(self, reading: WheelState | ImuReading, *arrays: NDArray) -> bool:
        good = np.isfinite(reading.stamp) and all(np.all(np.isfinite(a)) for a in arrays)
        late = good and self.stamp is not None and reading.stamp < self.stamp
        self.ignored += (not good) or late
        return bool(good and not late)

    def _plausible(self, reading: ImuReading) -> bool:
        if not self._usable(reading, reading.accel, reading.gyro):
            return False
        wild = np.max(np.abs(reading.accel[:2])) > MAX_ACCEL or abs(reading.gyro[2]) > MAX_RATE
        self.ignored += bool(wild)
        self._shaken |= bool(wild)
        return not wild

    def _is_silent(self, newest: float) -> bool:
        oldest = self._wheel_queue[0].stamp if self.stamp is None else self.stamp
        return newest - oldest > SILENCE

    def _advance(self, stamp: float, accel: Array | None, gyro: float | None) -> bool:
        """Predict to `stamp`; False if the state is already newer."""
        if self.stamp is None:
            self.stamp = stamp
        dt = stamp - self.stamp
        if dt < 0:
            self.ignored += 1
            return False
        if dt > 0:
            self._rewind.advance(dt, accel, gyro)
            self.stamp = stamp
        return True

    def _correct(self, wheel: WheelState) -> None:
        last, self._last_wheel = self._last_wheel, wheel
        if last is None or wheel.stamp <= last.stamp:
            return
        interval = wheel.stamp - last.stamp
        moved = wheel.ticks - last.ticks
        mean = displacement(self._wheels, moved) / interval
        stands = self._wheels_stand(wheel)
        if self._parked is not None and stands:  # arms at work shake the wheels: that is no slip
            self.ekf.update_wheels(mean, interval)
        else:
            speeds = np.asarray(moved * self._rim_angle / interval, dtype=np.float64)
            self._believe(wheel.stamp, mean, speeds, interval)
        # Wheels may be locked while the vehicle slides on: it is parked once they grip.
        self.standing = stands and not self.slip.slipping
        if not self.standing:
            self._parked = None
            return
        if self._parked is None:
            self._parked = (self.ekf.x[POSE].copy(), wheel, self.covariance)
        self._rewind.clear()
        pose, since, covariance = self._parked
        moved = exp2(displacement(self._wheels, wheel.ticks - since.ticks))
        self.ekf.park(compose2(pose, moved), covariance, mean)

    def _believe(self, stamp: float, mean: Array, speeds: Array, interval: float) -> None:
        """Correct by the wheels while they grip; else go on by inertia alone."""
        ekf, slip = self.ekf, self.slip
        before = slip.slipping
        closes = slip.closes(closure(self._wheels, speeds), mean)
        inside = ekf.agrees(mean, interval) and bool(np.sum(ekf.x[SLIP] ** 2) < SLIP_GATE)
        shaken, self._shaken = self._shaken, False
        if not slip.update(stamp, closes, inside, mean - ekf.x[TWIST], shaken):
            if not before:
                self._take_back()
            return
        if slip.mistaken:
            ekf.loosen_twist(mean - ekf.x[TWIST])
        if before:
            ekf.forget_slip()
        ekf.update_wheels(mean, interval)
        self._rewind.mark(stamp)

    def _take_back(self) -> None:
        """Undo what the wheels said of late: slip grows for a while before it shows."""
        for k, (stamp, pose) in enumerate(self._rewind.back()):
            if k == 0:
                self.history.forget(stamp)
            self.history.add(stamp, pose)

    def _wheels_stand(self, wheel: WheelState) -> bool:
        self._still.append(wheel)
        while wheel.stamp - self._still[1 if len(self._still) > 1 else 0].stamp >= STILL_TIME:
            self._still.popleft()
        if wheel.stamp - self._still[0].stamp < STILL_TIME:
            return False
        ticks = np.array([w.ticks for w in self._still])
        return bool(np.all(np.ptp(ticks, axis=0) <= STILL_COUNTS))

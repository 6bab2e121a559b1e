"""Joint encoders of an arm, and width and force of its gripper, as its controller reports them."""

import numpy as np

from twin.messages import ArmReading, GripperReading
from twin.plant.actuators.arm_drive import RESOLUTION, ArmDrive
from twin.plant.actuators.gripper_drive import GripperDrive

PERIOD = 0.010  # s: UFACTORY's real-time report runs at 100 Hz
LATENCY = 0.004  # s: one controller cycle at 250 Hz
WIDTH_RESOLUTION = 0.050 / 255  # m: Hand-E reports its position in 255 steps over the stroke
WIDTH_NOISE = 0.0001  # m, 1 sigma: guess
FORCE_NOISE = 1.0  # N, 1 sigma: from motor current; guess


class ArmSensor:
    """Position and speed of the six joints, by the encoders on which the drives close."""

    period, latency = PERIOD, LATENCY

    def __init__(self, arm: int, drive: ArmDrive):
        self._arm, self._drive = arm, drive
        self._last: tuple[float, np.ndarray] | None = None

    def sample(self, stamp: float, model, data) -> ArmReading:
        q = self._drive.encoder(data)
        before, last = self._last if self._last is not None else (stamp - self.period, q)
        self._last = (stamp, q)
        # The controller has only counts: speed is their mean change over the period.
        return ArmReading(stamp, self._arm, q, (q - last) / max(stamp - before, RESOLUTION))


class GripperSensor:
    """Opening between the pads and closing force of one gripper."""

    period, latency = PERIOD, LATENCY

    def __init__(
        self, arm: int, drive: GripperDrive, rng: np.random.Generator, noise_scale: float = 1.0
    ):
        self._arm, self._drive, self._rng, self._k = arm, drive, rng, noise_scale

    def sample(self, stamp: float, model, data) -> GripperReading:
        width = self._drive.width(data) + self._k * self._rng.normal(0, WIDTH_NOISE)
        width = round(width / WIDTH_RESOLUTION) * WIDTH_RESOLUTION
        force = self._drive.force + self._k * self._rng.normal(0, FORCE_NOISE)
        return GripperReading(stamp, self._arm, width, force)

"""2D lidar: rays against the hall, the stations and loose parts.

Hokuyo UTM-30LX (maker's specification C-42-03731): 270 degrees in 1081 steps of 0.25 degrees,
0.1-30 m, accuracy 30 mm up to 10 m and 50 mm beyond, repeated accuracy sigma < 10 mm up to 10 m
and < 30 mm beyond, 40 scans a second, of which every fourth is sent (SCIP 2.0, scan interval).
All beams of a scan are taken at one instant: the 19 ms of the sweep are neglected.
"""

import mujoco
import numpy as np

from twin.geometry import Array
from twin.messages import LidarScan
from twin.plant.sensors.mount import Mount

BEAMS = 1081
ANGLE_MIN = -np.radians(135.0)
ANGLE_INCREMENT = np.radians(0.25)
RANGE_MIN, RANGE_MAX, RANGE_FAR = 0.1, 30.0, 10.0  # m
NOISE, NOISE_FAR = 0.010, 0.030  # m, 1 sigma, up to and beyond RANGE_FAR
OFFSET = 0.010  # m, 1 sigma of a unit's constant error: the 30 mm are taken as 3 sigma
# Seen: 0 hall, 1 line and stations, 4 parts. Not 2, the vehicle itself (its maker masks it), nor
# 3, which holds collision shapes only.
GROUPS = np.array([1, 1, 0, 0, 1, 0], dtype=np.uint8)


class LidarSensor:
    """Lidar at site `agv/lidar`; its plane is the site's x-y plane, angle 0 along x.

    Args:
        model: the compiled cell.
        rng: this sensor's own noise.
        deviation: `T_drawn_true` of the mount as built, (4, 4).
        noise_scale: factor on all noise.
    """

    period = 0.100
    latency = 0.030  # s: 19 ms sweep and transfer of 1081 steps; guess

    def __init__(
        self,
        model: mujoco.MjModel,
        rng: np.random.Generator,
        deviation: Array | None = None,
        noise_scale: float = 1.0,
    ):
        self._rng, self._k = rng, noise_scale
        self._mount = Mount(model, "agv/lidar", deviation)
        self._body = model.site_bodyid[model.site("agv/lidar").id]
        angles = ANGLE_MIN + ANGLE_INCREMENT * np.arange(BEAMS)
        self._beams = np.stack([np.cos(angles), np.sin(angles), np.zeros(BEAMS)], axis=1)
        self._offset = rng.normal(0, OFFSET)

    def sample(self, stamp: float, model, data) -> LidarScan:
        T_world_lidar = self._mount.pose(data)
        beams_world = self._beams @ T_world_lidar[:3, :3].T
        hit = np.full(BEAMS, -1, dtype=np.int32)
        distance = np.full(BEAMS, -1.0)
        mujoco.mj_multiRay(
            model,
            data,
            T_world_lidar[:3, 3],
            beams_world.flatten(),
            GROUPS,
            True,
            self._body,
            hit,
            distance,
            None,
            BEAMS,
            RANGE_MAX,
        )
        sigma = np.where(distance > RANGE_FAR, NOISE_FAR, NOISE)
        noise = self._offset + sigma * self._rng.standard_normal(BEAMS)
        ranges = np.round(distance + self._k * noise, 3)  # sent in whole millimetres
        seen = (hit >= 0) & (ranges >= RANGE_MIN) & (ranges <= RANGE_MAX)
        return LidarScan(
            stamp, ANGLE_MIN, ANGLE_INCREMENT, np.where(seen, ranges, np.inf), RANGE_MAX
        )

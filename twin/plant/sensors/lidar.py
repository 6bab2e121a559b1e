"""2D lidar: rays against the hall, the machines, obstacles and loose parts.

Hokuyo UTM-30LX (maker's specification C-42-03731): 270 degrees in 1081 steps of 0.25 degrees,
0.1-30 m, accuracy 30 mm up to 10 m and 50 mm beyond, repeated accuracy sigma < 10 mm up to 10 m
and < 30 mm beyond, 40 scans a second, of which every fourth is sent (SCIP 2.0, scan interval).
All beams of a scan are taken at one instant: the 19 ms of the sweep are neglected.

Two surfaces are read wrongly. Black gloss throws the light elsewhere or takes it, and is heard from
close by only. Clear glass lets the beam through to what stands behind it, and sends it back to the
sensor near the normal alone (Foster, Sun, Park & Kuipers 2013, "VisAGGE"). The range and the angle
are guesses. What the glass takes from the light on its way there and back is left out.
"""

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array
from twin.messages import LidarScan
from twin.plant.obstacles import BLACK, GLASS
from twin.plant.sensors.mount import Mount

BEAMS = 1081
ANGLE_MIN = -np.radians(135.0)
ANGLE_INCREMENT = np.radians(0.25)
RANGE_MIN, RANGE_MAX, RANGE_FAR = 0.1, 30.0, 10.0  # m
NOISE, NOISE_FAR = 0.010, 0.030  # m, 1 sigma, up to and beyond RANGE_FAR
OFFSET = 0.010  # m, 1 sigma of a unit's constant error: the 30 mm are taken as 3 sigma
BLACK_RANGE = 0.5  # m up to which a black surface is heard: guess
GLASS_COSINE = np.cos(np.radians(3.0))  # of the beam to the normal of glass that is heard: guess
PAST = 1e-3  # m behind the face of a glass at which its beam is followed on
# Seen: 0 hall, 1 machines and obstacles, 4 parts. Not 2, the vehicle itself (its maker masks it),
# nor 3, which holds collision shapes only.
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
        names = [model.geom(g).name.rpartition("/")[2] for g in range(model.ngeom)]
        self._black = np.array([name == BLACK for name in names] + [False])  # -1: no hit
        self._glass = np.array([name == GLASS for name in names] + [False])

    def sample(self, stamp: float, model, data) -> LidarScan:
        hit, distance = self._cast(model, data)
        sigma = np.where(distance > RANGE_FAR, NOISE_FAR, NOISE)
        noise = self._offset + sigma * self._rng.standard_normal(BEAMS)
        ranges = np.round(distance + self._k * noise, 3)  # sent in whole millimetres
        seen = (hit >= 0) & (ranges >= RANGE_MIN) & (ranges <= RANGE_MAX)
        return LidarScan(
            stamp, ANGLE_MIN, ANGLE_INCREMENT, np.where(seen, ranges, np.inf), RANGE_MAX
        )

    def _cast(self, model, data) -> tuple[NDArray[np.int32], Array]:
        """The geom that each beam is heard from (-1: none), and how far. Shapes (BEAMS,)."""
        T_world_lidar = self._mount.pose(data)
        eye, beams_world = T_world_lidar[:3, 3], self._beams @ T_world_lidar[:3, :3].T
        hit = np.full(BEAMS, -1, dtype=np.int32)
        distance, normal = np.full(BEAMS, -1.0), np.zeros((BEAMS, 3))
        mujoco.mj_multiRay(
            model,
            data,
            eye,
            beams_world.flatten(),
            GROUPS,
            True,
            self._body,
            hit,
            distance,
            normal.reshape(-1),
            BEAMS,
            RANGE_MAX,
        )
        cosine = np.abs(np.einsum("ij,ij->i", normal, beams_world))
        for i in np.flatnonzero(self._glass[hit] & (cosine < GLASS_COSINE)):
            hit[i], distance[i] = self._behind(
                model, data, eye, beams_world[i], hit[i], distance[i]
            )
        hit[self._black[hit] & (distance > BLACK_RANGE)] = -1
        return hit, distance

    def _behind(self, model, data, eye, beam, glass: int, distance: float) -> tuple[int, float]:
        """What a beam meets behind a glass, and how far it is; a second glass is not heard."""
        found = np.array([-1], dtype=np.int32)
        start = distance + PAST
        body = model.geom_bodyid[glass]
        further = mujoco.mj_ray(model, data, eye + start * beam, beam, GROUPS, True, body, found)
        if found[0] < 0 or self._glass[found[0]]:
            return -1, -1.0
        return int(found[0]), start + further

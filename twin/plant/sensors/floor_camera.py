"""Camera that looks straight down at the floor: 320x240 grey, 20 Hz, with its own ring of light.

A global-shutter sensor of the mast camera's pixel class, binned: its noise figures stand in
`twin.plant.sensors.camera`. The ring of light in the well allows a short exposure; what it leaves
of motion is smeared along the floor's true way through the picture.
"""

from concurrent.futures import Future

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array, rotation_from_quat
from twin.messages import FloorFrame
from twin.plant.sensors.camera import CORNER_LOSS, DARK_NOISE, FULL_WELL, LENS_BLUR
from twin.plant.sensors.rendering import RenderWorker, View

WIDTH, HEIGHT = 320, 240
PERIOD = 0.05  # s
EXPOSURE = 0.0005  # s: ring light, pulsed; guess
# s: exposure, read-out, 77 kB at 1 Gbit/s, the rest for the driver and the host's queue: estimate.
LATENCY = 0.030
GROUPS = (0,)  # floor and what is stuck on it; the well keeps the rest out of sight
BANK = 1 << 20  # stored standard normals; a frame uses a random stretch of them
REACH = 3  # px to each side that smear may reach: 0.95 m/s for 0.5 ms is half a pixel


class FloorCamera:
    """Sensor of `FloorFrame` readings.

    Args:
        worker: the cell's renderer.
        model: the compiled cell.
        rng: source of the noise.
        noise_scale: factor on the noise; 0 gives clean (still blurred) pictures.
        camera: name of the camera in the model, on a body fixed to `agv/base`.
    """

    period = PERIOD
    latency = LATENCY

    def __init__(
        self,
        worker: RenderWorker,
        model,
        rng: np.random.Generator,
        noise_scale: float = 1.0,
        camera: str = "agv/tag_camera",
    ):
        self._worker, self._rng = worker, rng
        self._view = View(camera, WIDTH, HEIGHT, GROUPS)
        joint = model.joint("agv/base")
        self._qpos, self._dof = int(joint.qposadr[0]), int(joint.dofadr[0])
        mount = model.body(model.camera(camera).bodyid[0])
        self._height = float(mount.pos[2])
        self._p_camera = mount.pos[:2].copy()
        self._focal = 0.5 * HEIGHT / np.tan(np.radians(model.camera(camera).fovy[0]) / 2)
        self._bank = rng.standard_normal(BANK, dtype=np.float32)
        electrons = np.arange(256, dtype=np.float32) / 255.0 * FULL_WELL
        sigma = np.sqrt(DARK_NOISE**2 + electrons) * 255.0 / FULL_WELL * noise_scale
        self._sigma = sigma.astype(np.float32)
        v, u = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
        radius2 = (u - WIDTH / 2) ** 2 + (v - HEIGHT / 2) ** 2
        self._fall_off = (1.0 - CORNER_LOSS * radius2 / radius2.max()).astype(np.float32)

    def sample(self, stamp: float, model, data) -> Future[FloorFrame]:
        """Expose now, half before and half after; the picture comes from the worker."""
        offset = int(self._rng.integers(BANK - WIDTH * HEIGHT))
        way = self._way(data)
        return self._worker.submit(
            data, self._view, lambda rgb: self._read_out(stamp, rgb, offset, way)
        )

    def _way(self, data) -> Array:
        """How far the floor below the camera moves in the picture while exposed, u and v, px."""
        R_world_base = rotation_from_quat(data.qpos[self._qpos + 3 : self._qpos + 7])
        vx, vy = (R_world_base.T @ data.qvel[self._dof : self._dof + 3])[:2]
        omega = data.qvel[self._dof + 5]
        vx, vy = vx - omega * self._p_camera[1], vy + omega * self._p_camera[0]
        # the picture's u is to the vehicle's right and v backwards; the floor goes the other way
        return np.array([vy, vx]) * (EXPOSURE * self._focal / self._height)

    def _read_out(self, stamp: float, rgb, offset: int, way: Array) -> FloorFrame:
        light = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        if np.hypot(*way) > 0.05:
            light = cv2.filter2D(light, -1, smear(way))
        light = cv2.GaussianBlur(light, (0, 0), LENS_BLUR)
        stretch = self._bank[offset : offset + light.size].reshape(light.shape)
        noise = cv2.multiply(cv2.LUT(light, self._sigma), stretch)
        image = cv2.multiply(light, self._fall_off, dtype=cv2.CV_32F)
        return FloorFrame(stamp, np.asarray(cv2.add(image, noise, dtype=cv2.CV_8U), np.uint8))


def smear(way: Array) -> NDArray[np.float32]:
    """Kernel that spreads a point evenly along `way` (u, v in px) about its middle; sums to 1."""
    kernel = np.zeros((2 * REACH + 1, 2 * REACH + 1))
    for part in np.linspace(-0.5, 0.5, 15):
        u, v = np.clip(part * way, -REACH + 0.01, REACH - 0.01) + REACH
        i, j = int(v), int(u)
        a, b = v - i, u - j
        kernel[i : i + 2, j : j + 2] += np.outer((1 - a, a), (1 - b, b))
    return (kernel / kernel.sum()).astype(np.float32)

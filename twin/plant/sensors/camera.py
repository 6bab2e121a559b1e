"""Industrial camera on the mast: 640x480 colour, 20 Hz.

A global-shutter GigE camera. Noise after the EMVA 1288 linear model: dark noise and photon noise,
with the class figures of a 4.5 um Sony Pregius pixel (Balluff, technical documentation of IMX420:
SNRmax 43.8 dB, i.e. 24 000 electrons full well; dynamic range 71.7 dB, i.e. 6.2 electrons dark).
"""

from concurrent.futures import Future

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.messages import CameraFrame
from twin.plant.sensors.rendering import RenderWorker, View

WIDTH, HEIGHT = 640, 480
PERIOD = 0.05  # s
# s: 2 ms exposure, 8 ms sensor read-out, 8 ms for 0.92 MB at 1 Gbit/s, the rest for the driver and
# the host's queue: estimate.
LATENCY = 0.040
FULL_WELL = 24_000.0  # electrons at grey value 255
DARK_NOISE = 6.2  # electrons
LENS_BLUR = 0.6  # px, 1 sigma of the lens' point spread: guess
CORNER_LOSS = 0.15  # light lost in the corners: guess
GROUPS = (0, 1, 2, 4)
BANK = 1 << 22  # stored standard normals; a frame uses a random stretch of them


class Optics:
    """Lens and sensor: light in grey values to what is read out.

    Args:
        rng: fills the bank of noise.
        noise_scale: factor on the noise.
    """

    def __init__(self, rng: np.random.Generator, noise_scale: float = 1.0):
        self._bank = rng.standard_normal(BANK, dtype=np.float32)
        grey = np.arange(256, dtype=np.float32)
        electrons = grey / 255.0 * FULL_WELL
        sigma = np.sqrt(DARK_NOISE**2 + electrons) * 255.0 / FULL_WELL * noise_scale
        self._sigma = sigma.astype(np.float32)
        v, u = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
        radius2 = (u - WIDTH / 2) ** 2 + (v - HEIGHT / 2) ** 2
        fall_off = 1.0 - CORNER_LOSS * radius2 / radius2.max()
        self._fall_off = np.repeat(fall_off[:, :, None], 3, axis=2).astype(np.float32)

    def draw(self, rng: np.random.Generator) -> int:
        """Where in the bank a frame's noise begins."""
        return int(rng.integers(BANK - WIDTH * HEIGHT * 3))

    def read_out(self, rgb, offset: int) -> NDArray[np.uint8]:
        """The picture. `rgb`, (480, 640, 3), may be float and brighter than 255: it saturates."""
        light = cv2.GaussianBlur(rgb, (0, 0), LENS_BLUR)
        grey = light if light.dtype == np.uint8 else np.clip(light, 0, 255).astype(np.uint8)
        noise = cv2.LUT(grey, self._sigma)
        stretch = self._bank[offset : offset + noise.size].reshape(noise.shape)
        noise = cv2.multiply(noise, stretch, dst=noise)
        image = cv2.multiply(light, self._fall_off, dtype=cv2.CV_32F)
        return np.asarray(cv2.add(image, noise, dtype=cv2.CV_8U), np.uint8)


class MastCamera:
    """Sensor of `CameraFrame` readings.

    Args:
        worker: the cell's renderer.
        rng: source of the noise.
        noise_scale: factor on the noise; 0 gives clean (still blurred) pictures.
        camera: name of the camera in the model.
    """

    period = PERIOD
    latency = LATENCY

    def __init__(
        self,
        worker: RenderWorker,
        rng: np.random.Generator,
        noise_scale: float = 1.0,
        camera: str = "agv/mast_camera",
    ):
        self._worker, self._rng = worker, rng
        self.on = False  # pictures are taken only while the stack asks for them
        self._view = View(camera, WIDTH, HEIGHT, GROUPS)
        self._optics = Optics(rng, noise_scale)

    def sample(self, stamp: float, model, data) -> Future[CameraFrame] | None:
        """Expose now; the picture comes from the worker. None while it is off."""
        if not self.on:
            return None
        offset = self._optics.draw(self._rng)
        return self._worker.submit(
            data, self._view, lambda rgb: CameraFrame(stamp, self._optics.read_out(rgb, offset))
        )

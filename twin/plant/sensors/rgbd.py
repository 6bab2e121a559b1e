"""Front depth camera: colour and registered depth, 424x240, 10 Hz, after the Intel RealSense D435.

Depth comes from stereo, so its error grows with the square of the range: RMS error = z^2 subpixel /
(f baseline) (Intel, "Tuning depth cameras for best performance"), with a baseline of 50 mm, f of
212 px at 424 columns and 90 degrees, and a subpixel RMS of 0.08 px: 7.5 mm at 1 m and 1.5 % at 2 m,
inside the data sheet's 2 %.
"""

from concurrent.futures import Future

import cv2
import numpy as np

from twin.messages import RgbdFrame
from twin.plant.sensors.rendering import RenderWorker, View

WIDTH, HEIGHT = 424, 240
PERIOD = 0.1  # s
LATENCY = 0.050  # s: stereo matching and USB, two frames at 30 Hz and a little less: estimate
BASELINE = 0.050  # m, D435 data sheet
SUBPIXEL = 0.08  # px RMS, Intel's tuning paper
COLOUR_NOISE = 2.0  # grey values, 1 sigma: guess
RANGE_MIN, RANGE_MAX = 0.105, 10.0  # m: data sheet, MinZ at 424x240
EDGE_STEP = 0.05  # relative jump of depth beside which the matcher finds nothing: guess
GROUPS = (0, 1, 2, 4)


class RgbdCamera:
    """Sensor of `RgbdFrame` readings.

    Args:
        worker: the cell's renderer.
        rng: source of the noise.
        noise_scale: factor on the noise of colour and depth; holes stay.
        lens: true over calibrated focal length; disparities are taken for depth by the latter.
        camera: name of the camera in the model; its field of view gives the focal length.
    """

    period = PERIOD
    latency = LATENCY

    def __init__(
        self,
        worker: RenderWorker,
        rng: np.random.Generator,
        noise_scale: float = 1.0,
        lens: float = 1.0,
        camera: str = "agv/rgbd",
    ):
        self._worker, self._rng, self._noise_scale = worker, rng, noise_scale
        self._lens = lens
        self._view = View(camera, WIDTH, HEIGHT, GROUPS)

    def sample(self, stamp: float, model, data) -> Future[RgbdFrame]:
        """Expose now; the picture comes from the worker."""
        seed = int(self._rng.integers(1 << 63))
        fovy = np.radians(model.camera(self._view.camera).fovy[0])
        focal = 0.5 * HEIGHT / np.tan(fovy / 2)

        def read_out(rgb, depth) -> RgbdFrame:
            rng = np.random.Generator(np.random.SFC64(seed))
            colour = rng.standard_normal(rgb.shape, dtype=np.float32)
            noisy = cv2.add(rgb, colour * (COLOUR_NOISE * self._noise_scale), dtype=cv2.CV_8U)
            return RgbdFrame(stamp, noisy, self._measure(depth, focal, rng))

        return self._worker.submit(data, self._view, read_out, depth=True)

    def _measure(self, depth, focal: float, rng: np.random.Generator):
        """Depth in mm with stereo noise and holes. Shape (h, w), uint16."""
        sigma = depth**2 * (SUBPIXEL * self._noise_scale / (focal * BASELINE))
        noisy = depth + sigma * rng.standard_normal(depth.shape, dtype=np.float32)
        z = depth.astype(np.float32)
        kernel = np.ones((3, 3), np.uint8)
        step = cv2.dilate(z, kernel) - cv2.erode(z, kernel)
        valid = (noisy > RANGE_MIN) & (depth < RANGE_MAX) & (step < EDGE_STEP * z)
        return np.where(valid, np.rint(noisy * (1000.0 / self._lens)), 0).astype(np.uint16)

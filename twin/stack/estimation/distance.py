"""Distance S from the vehicle to the place where it picks, seen by the depth camera.

Li & An 2025, section 3.2, take S between the RGB-D camera and the work piece and carry it over to
the base by the transforms among the links. Here the camera measures the front of the hood out of
which the parts come: it stands across the belt, in view during the whole approach, and the drawing
says how far before it the vehicle is to stop. Between pictures, S shrinks by the distance driven.
"""

import numpy as np

from twin.geometry import Array, apply, between2, rot2
from twin.messages import RgbdFrame
from twin.stack.config import Camera, StackConfig

BAND = (0.06, 0.17)  # m above the belt: over the parts, below the hood's top
HALF_WIDTH = 0.10  # m beside the belt's centre line
MIN_POINTS = 60
SLICE = 0.05  # m along x, of the search for the face
SHARE = 0.4  # of the hood's area in the band that a face must show
MAX_YAW, MAX_LATERAL = np.radians(6.0), 0.15  # off the approach, beyond which we do not look
MAX_JUMP = 0.15  # m between seen and expected S: then it was something else
NOISE_AT_1M = 0.010  # m, 1 sigma of the face at 1 m, growing with distance squared: guess


def points_in_base(frame: RgbdFrame, camera: Camera) -> Array:
    """Back-projects depth. Shape (n, 3) in base, pixels without a return left out."""
    v, u = np.nonzero(frame.depth_mm)
    z = 1e-3 * frame.depth_mm[v, u].astype(np.float64)
    K = camera.matrix
    x, y = (u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z
    p_camera = np.stack([x, y, z], axis=1, dtype=np.float64)
    return apply(camera.T_base_camera, p_camera)


def hood_at_pick(config: StackConfig) -> Array:
    """Where the middle of the hood's front is, in base, once the vehicle stands to pick: x, y."""
    line = config.site.line
    along = config.line_hood * np.array([np.cos(line.direction), np.sin(line.direction)])
    front = np.array([*(np.asarray(line.origin) + along), line.direction])
    return between2(config.site.pick, front)[:2]


def measure_distance(frame: RgbdFrame, config: StackConfig) -> float | None:
    """S in metres along the approach from base to pick pose; None if the hood is not seen.

    The vehicle must be on the approach: beside the belt and parallel to it. Points are taken in a
    band over the belt. The face is the nearest slice along x whose area is a good part of the
    hood's: an arm that reaches into the band is too small, a wall behind is farther away. The
    median of its points is free of the bias that a nearest point has under noise.
    """
    drawn_x, drawn_y = hood_at_pick(config)
    if drawn_x < 0:
        return None  # parts come from behind: the camera looks forward
    points = points_in_base(frame, config.rgbd)
    height = points[:, 2] - config.site.line.height
    in_band = (
        (height > BAND[0]) & (height < BAND[1]) & (np.abs(points[:, 1] - drawn_y) < HALF_WIDTH)
    )
    x = points[in_band, 0]
    if len(x) < MIN_POINTS:
        return None
    area = ((x - config.rgbd.T_base_camera[0, 3]) / config.rgbd.focal) ** 2  # m^2 of each pixel
    edges = np.arange(x.min(), x.max() + 2 * SLICE, SLICE)
    areas, _ = np.histogram(x, bins=edges, weights=area)
    around = np.convolve(areas, np.ones(3), mode="same")  # noise spreads the face over slices
    large = np.nonzero(around > SHARE * 2 * HALF_WIDTH * (BAND[1] - BAND[0]))[0]
    if len(large) == 0:
        return None
    first = large[0] + np.argmax(areas[large[0] : large[0] + 3])
    face = x[np.abs(x - edges[first] - 0.5 * SLICE) < 2 * SLICE]
    return float(np.median(face) - drawn_x)


class DistanceToPick:
    """S at any time: what the camera saw, carried on by the driven distance.

    Pictures differ from the fused pose by an offset that hardly changes during an approach; it is
    averaged with each picture's weight, and S is the pose's own distance plus this offset.
    """

    def __init__(self, config: StackConfig):
        self._config = config
        self._pick = np.asarray(config.site.pick, dtype=float)
        self.offset, self._weight = 0.0, 0.0
        self.measured = False

    def reset(self) -> None:
        """Forget what was seen: a new approach begins."""
        self.offset, self._weight, self.measured = 0.0, 0.0, False

    def update(self, frame: RgbdFrame, pose_at_exposure: Array | None) -> float | None:
        """Take a picture with the fused pose (x, y, yaw) of its exposure; S as seen, or None."""
        if pose_at_exposure is None:
            return None
        _, lateral, yaw = between2(self._pick, pose_at_exposure)
        if abs(yaw) > MAX_YAW or abs(lateral) > MAX_LATERAL:
            return None
        seen = measure_distance(frame, self._config)
        expected = self._along(pose_at_exposure)
        if seen is None or abs(seen - expected) > MAX_JUMP:
            return None
        reach = seen + hood_at_pick(self._config)[0] - self._config.rgbd.T_base_camera[0, 3]
        weight = (NOISE_AT_1M * reach**2) ** -2
        self._weight += weight
        self.offset += (seen - expected - self.offset) * weight / self._weight
        self.measured = True
        return seen

    def distance(self, pose: Array) -> float:
        """S for the fused pose of now, m; negative beyond the pick pose."""
        return self._along(pose) + self.offset

    def _along(self, pose: Array) -> float:
        return float((rot2(self._pick[2]).T @ (self._pick[:2] - np.asarray(pose)[:2]))[0])

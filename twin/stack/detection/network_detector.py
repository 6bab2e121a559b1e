"""Connectors on the belt by the trained networks, behind the same message as `contour`.

The networks say what lies where; the drawing of that one class, laid over what is seen inside the
box, says how it lies (Li & An 2025, section 3.1). A part of which either is unsure is not told
of: the next picture, 50 ms later, is a second look.
"""

import numpy as np

from twin.geometry import Array
from twin.messages import PART_CLASSES, CameraFrame, Detection
from twin.stack.config import StackConfig
from twin.stack.detection.box_outline import FACTOR, look_into
from twin.stack.detection.boxes import Boxes
from twin.stack.detection.frames import hindrance
from twin.stack.detection.network import Network
from twin.stack.detection.pose_fit import PoseFitter
from twin.stack.detection.roi import Region
from twin.stack.detection.silhouette import projection
from twin.stack.detection.window import belt_window

MIN_QUALITY = 0.7  # of the fit: below, the pose is not to be relied on


class NetworkDetector:
    """Finds the parts on the belt in frames of the mast camera.

    Args:
        config: the drawing of vehicle, site and parts.
        network: trained; the installed one by default.

    Raises:
        NetworkError: the installed network is not what its card says.
    """

    def __init__(self, config: StackConfig, network: Network | None = None):
        self._line = config.site.line
        self._camera = config.camera
        self._P = projection(config.camera)
        self._size = (config.camera.height, config.camera.width)
        self._network = network or Network()
        self._fitters = {c: PoseFitter(d, self._line.height) for c, d in config.parts.items()}
        self.reason: str | None = None  # why the last picture was not looked at

    def detect(self, frame: CameraFrame, pose: Array) -> tuple[Detection, ...]:
        """Parts that lie wholly inside the window; none, and a `reason`, for a bad picture.

        Args:
            frame: one picture.
            pose: estimated pose of the base in world at exposure, (3,).
        """
        polygon = self.window(pose)
        self.reason = hindrance(frame.image, self._size, polygon)
        if self.reason is not None:
            return ()
        boxes = self.look(frame, polygon)
        found = [self._measure(frame, boxes, k, polygon) for k in range(len(boxes.box))]
        return tuple(d for d in found if d is not None)

    def window(self, pose: Array) -> Array:
        """The part of the belt that is looked at, as a polygon in the image. Shape (k, 2)."""
        return belt_window(self._line, pose, self._P, self._size)

    def look(self, frame: CameraFrame, polygon: Array) -> Boxes:
        """What the networks are sure of inside a polygon of the picture; boxes in its px."""
        region = Region.around(polygon, self._size)
        boxes = self._network.see(frame.image, region, self._camera, self._line.height)
        return boxes[boxes.score >= self._network.card.threshold]

    def _measure(self, frame, boxes: Boxes, k: int, polygon: Array) -> Detection | None:
        """Outline and pose of one box."""
        box = boxes.box[k]
        seen = look_into(frame.image, box)
        if seen is None or not _inside(seen.contour, polygon):
            return None  # nothing there, or partly outside the window
        part_class = PART_CLASSES[int(boxes.part_class[k])]
        fitter = self._fitters[part_class]
        fit = fitter.fit(seen.evidence, seen.corner, FACTOR, box, self._P)
        if fit is None or fit.quality < MIN_QUALITY:
            return None
        return Detection(
            part_class=part_class,
            confidence=float(boxes.score[k]),
            p_base=np.array([fit.pose[0], fit.pose[1], self._line.height]),
            yaw=float(fit.pose[2]),
            contour_px=seen.contour,
            centroid_px=seen.contour.mean(axis=0),
            symmetric=fit.symmetric,
        )


def _inside(points: Array, polygon: Array) -> bool:
    """Whether all points, (k, 2), lie in a convex polygon, (m, 2), of either sense."""
    edges = np.roll(polygon, -1, axis=0) - polygon
    to = points[:, None, :] - polygon[None, :, :]
    side = edges[None, :, 0] * to[:, :, 1] - edges[None, :, 1] * to[:, :, 0]
    return bool((side >= 0).all() or (side <= 0).all())

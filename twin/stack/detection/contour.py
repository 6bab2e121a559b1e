"""Connectors on the belt: from one picture to classes and poses in the vehicle's base frame.

Crop, Gaussian blur, morphological closing, edge, contour, centroid and axis (Li & An 2025, section
3.1). The edge is where the brightness falls to about half of what the part shows beside it: there a
blurred edge truly lies, so the outline of a bright face is no fatter than that of a dark one.
"""

import cv2
import numpy as np

from twin.geometry import Array
from twin.messages import CameraFrame, Detection
from twin.stack.config import StackConfig
from twin.stack.detection.classify import Classifier
from twin.stack.detection.frames import hindrance
from twin.stack.detection.silhouette import projection
from twin.stack.detection.window import belt_window

BLUR = 0.3  # px
CONTRAST = 22  # grey values above the belt that may be a part
SHADE = 12  # grey values below the belt that are a bore
NEAR = np.ones((3, 3), np.uint8)  # one pixel about
LEVEL = 0.42  # of the brightness one pixel about: the edge of a blurred step (tuned on renders)
CLOSING = 5  # px: bridges threads, and the line where the bore's rim is as dark as the belt
MIN_AREA, MAX_AREA = 90, 6000  # px
MARGIN = 8  # px around a blob
MIN_IOU = 0.78  # below, it is no connector, or not one alone


class ContourDetector:
    """Finds the parts on the belt in frames of the mast camera.

    Args:
        config: the drawing of vehicle, site and parts.
    """

    def __init__(self, config: StackConfig):
        self._line = config.site.line
        self._P = projection(config.camera)
        self._size = (config.camera.height, config.camera.width)
        self._classifier = Classifier(config.parts, self._line.height)
        self._close = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (CLOSING, CLOSING))
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
        corners = np.rint(polygon).astype(np.int32)
        u0, v0, width, height = cv2.boundingRect(corners)
        inside = np.zeros((height, width), np.uint8)
        cv2.fillConvexPoly(inside, corners - (u0, v0), 1)
        crop = np.ascontiguousarray(frame.image[v0 : v0 + height, u0 : u0 + width])
        crop = cv2.GaussianBlur(crop, (0, 0), BLUR)
        samples = crop[::6, ::6][inside[::6, ::6] > 0]
        if samples.size == 0:
            return ()
        belt = np.median(samples, axis=0)
        # Metal is brighter than the belt in red, where nickel and gold look alike; the bore of a
        # coupling nut is darker, and the green belt shows that best in green.
        above = cv2.subtract(crop[:, :, 0], np.full_like(crop[:, :, 0], belt[0]))
        below = cv2.subtract(np.full_like(crop[:, :, 1], belt[1]), crop[:, :, 1])
        candidates = ((above > CONTRAST) | (below > SHADE)).astype(np.uint8) & inside
        contours, _ = cv2.findContours(candidates, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        free = np.asarray(cv2.erode(inside, NEAR, borderValue=0))
        found = []
        for contour in map(np.asarray, contours):
            if not MIN_AREA < cv2.contourArea(contour) < MAX_AREA:
                continue
            u, v = contour[:, 0, 0].astype(int), contour[:, 0, 1].astype(int)
            if not free[v, u].all():
                continue  # partly outside the window
            detection = self._measure(above, below, cv2.boundingRect(contour), (u0, v0))
            if detection is not None:
                found.append(detection)
        return tuple(found)

    def window(self, pose: Array) -> Array:
        """The part of the belt that is looked at, as a polygon in the image. Shape (k, 2)."""
        return belt_window(self._line, pose, self._P, self._size)

    def _measure(self, above, below, box, offset) -> Detection | None:
        """Outline, class and pose of one blob of the cropped picture."""
        left, top, width, height = box
        u0, v0 = max(0, left - MARGIN), max(0, top - MARGIN)
        area = np.s_[v0 : top + height + MARGIN, u0 : left + width + MARGIN]
        # The edge: half of the part's own brightness beside it, not of the brightest spot anywhere.
        bright = np.maximum(cv2.dilate(above[area], NEAR) * LEVEL, CONTRAST / 2)
        part = ((above[area] > bright) | (below[area] > SHADE)).astype(np.uint8)
        part = cv2.morphologyEx(part, cv2.MORPH_CLOSE, self._close)
        contours, _ = cv2.findContours(part, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        if not contours:
            return None
        contour = max(contours, key=len)
        seen = np.zeros(part.shape, np.uint8)
        cv2.drawContours(seen, [contour], -1, 1, cv2.FILLED)
        corner = (u0 + offset[0], v0 + offset[1])
        fit = self._classifier.classify(seen, corner, self._P)
        if fit is None or fit.iou < MIN_IOU:
            return None
        m = cv2.moments(seen, binaryImage=True)
        centroid = np.array([m["m10"], m["m01"]]) / m["m00"] + corner
        return Detection(
            part_class=fit.part_class,
            confidence=fit.confidence,
            p_base=np.array([fit.pose[0], fit.pose[1], self._line.height]),
            yaw=float(fit.pose[2]),
            contour_px=contour[:, 0, :].astype(float) + corner,
            centroid_px=centroid,
            symmetric=fit.symmetric,
        )

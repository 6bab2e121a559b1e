"""The outline of a part inside the box that the network gives.

Crop, Gaussian blur, edges, closing, contour chosen by its IoU with the box (Li & An 2025, section
3.1). The belt's colour is taken from around the box, so that belt and light may be any.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array

MARGIN = 8  # px about the box: enough of the belt to know its colour, and room for the closing
BLUR = 0.5  # px, 1 sigma
CLOSING = 5  # px: bridges threads, and the rim of a bore as dark as the belt
NEAR = np.ones((3, 3), np.uint8)
LEVEL = 0.42  # of the contrast one pixel about: the edge of a blurred step (see `contour`)
LEAST = 10  # grey values off the belt that may be a part
SPREADS = 3.5  # of the belt's own texture that may not
MIN_IOU = 0.5  # of the contour's box with the network's


def outline(
    image: NDArray[np.uint8], box: Array
) -> tuple[NDArray[np.uint8], NDArray[np.int32], tuple[int, int]] | None:
    """Silhouette and contour of what fills a box; None if nothing does.

    Args:
        image: RGB. Shape (h, w, 3).
        box: left, top, right, bottom, px.

    Returns:
        Filled mask of the crop, the contour in it (k, 2), and the crop's corner (u, v).
    """
    height, width = image.shape[:2]
    left, top = np.maximum(np.floor(box[:2]).astype(int) - MARGIN, 0)
    right, bottom = np.minimum(np.ceil(box[2:]).astype(int) + MARGIN, (width, height))
    if right - left < 2 * MARGIN or bottom - top < 2 * MARGIN:
        return None
    crop = cv2.GaussianBlur(image[top:bottom, left:right], (0, 0), BLUR).astype(np.float32)
    around = np.ones(crop.shape[:2], bool)
    inner = np.rint(box - (left, top, left, top)).astype(int)
    around[max(inner[1] - 2, 0) : inner[3] + 2, max(inner[0] - 2, 0) : inner[2] + 2] = False
    if around.sum() < 20:
        return None
    belt = np.median(crop[around], axis=0)
    off = np.abs(crop - belt).max(axis=2)
    floor = max(LEAST, SPREADS * float(np.median(off[around])) * 1.48)
    edge = np.maximum(np.asarray(cv2.dilate(off, NEAR)) * LEVEL, floor)
    part = (off > edge).astype(np.uint8)
    shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (CLOSING, CLOSING))
    part = cv2.morphologyEx(part, cv2.MORPH_CLOSE, shape)
    contours, _ = cv2.findContours(part, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return None
    wanted = box - (left, top, left, top)
    contour = max(map(np.asarray, contours), key=lambda c: _box_iou(cv2.boundingRect(c), wanted))
    if _box_iou(cv2.boundingRect(contour), wanted) < MIN_IOU:
        return None
    seen = np.zeros(part.shape, np.uint8)
    cv2.drawContours(seen, [contour], -1, 1, cv2.FILLED)
    return seen, contour[:, 0, :], (int(left), int(top))


def _box_iou(rectangle, box: Array) -> float:
    u, v, w, h = rectangle
    both = np.minimum((u + w, v + h), box[2:]) - np.maximum((u, v), box[:2])
    area = float(np.clip(both, 0, None).prod())
    return area / max(w * h + float((box[2:] - box[:2]).prod()) - area, 1e-9)

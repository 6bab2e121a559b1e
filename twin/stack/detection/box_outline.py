"""What is seen inside the box that the network gives: evidence of part or belt, and a contour.

Crop, Gaussian blur, edges, closing, contour chosen by its IoU with the box (Li & An 2025, section
3.1). The belt's colour is taken from around the box, so that belt and light may be any.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array

MARGIN = 8  # px about the box: enough of the belt to know its colour
ROOM = 3.0  # px about the box in which the part may still be
# px, 1 sigma; with LEVEL and the fit's BOX_WEIGHT the best of a dozen tried (model card)
BLUR = 0.3
CLOSING = 5  # px: bridges threads
LEVEL = 0.52  # of the contrast one pixel about: the edge of a blurred step (see `contour`)
LEAST, SHADE = 10.0, 7.0  # grey values above and below the belt that may be a part
SPREADS = 3.5  # of the belt's own texture that may not
BELT = -0.6  # what a pixel like the belt says; its likes may also be a bore
MIN_IOU = 0.4  # of the contour's box with the network's
FACTOR = 0.5  # px of the picture a px of the evidence: edges are found between pixels


@dataclass(frozen=True)
class Seen:
    """One box looked into."""

    evidence: Array  # (h, w) from -1 for the belt to 1 for the part, at twice the resolution
    corner: tuple[int, int]  # pixel (u, v) of the picture at its origin
    contour: Array  # (k, 2) u, v in the picture


def look_into(image: NDArray[np.uint8], box: Array) -> Seen | None:
    """Evidence and contour of what fills a box; None if nothing does.

    Args:
        image: RGB. Shape (h, w, 3).
        box: left, top, right, bottom, px.
    """
    height, width = image.shape[:2]
    left, top = np.maximum(np.floor(box[:2]).astype(int) - MARGIN, 0)
    right, bottom = np.minimum(np.ceil(box[2:]).astype(int) + MARGIN, (width, height))
    if right - left < 2 * MARGIN or bottom - top < 2 * MARGIN:
        return None
    crop = image[top:bottom, left:right].astype(np.float32)
    crop = cv2.resize(crop, None, fx=1 / FACTOR, fy=1 / FACTOR, interpolation=cv2.INTER_LINEAR)
    crop = cv2.GaussianBlur(crop, (0, 0), BLUR / FACTOR)
    wanted = (box - (left, top, left, top)) / FACTOR
    room = np.zeros(crop.shape[:2], bool)
    low = np.maximum(np.floor(wanted[:2] - ROOM / FACTOR).astype(int), 0)
    high = np.ceil(wanted[2:] + ROOM / FACTOR).astype(int)
    room[low[1] : high[1], low[0] : high[0]] = True
    if (~room).sum() < 40:
        return None
    belt = np.median(crop[~room], axis=0)
    above = (crop - belt).max(axis=2)
    below = (belt - crop).max(axis=2)
    spread = float(np.median(np.abs(crop[~room] - belt).max(axis=1))) * 1.48
    wide = cv2.getStructuringElement(cv2.MORPH_RECT, (5, 5))  # one pixel of the picture about
    edge = np.maximum(np.asarray(cv2.dilate(above, wide)) * LEVEL, max(LEAST, SPREADS * spread))
    bright = above / edge - 1.0
    dark = below / max(SHADE, SPREADS * spread) - 1.0
    evidence = np.clip(np.maximum(bright, dark * 0.5), BELT, 1.0)
    evidence[~room] = BELT
    part = ((evidence > 0) & room).astype(np.uint8)
    shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * CLOSING - 1,) * 2)
    part = cv2.morphologyEx(part, cv2.MORPH_CLOSE, shape)
    contours, _ = cv2.findContours(part, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return None
    contour = max(map(np.asarray, contours), key=lambda c: _box_iou(cv2.boundingRect(c), wanted))
    if _box_iou(cv2.boundingRect(contour), wanted) < MIN_IOU:
        return None
    # Between the part's own pixels what looks like the belt may be a bore: it says nothing.
    hull = np.zeros(part.shape, np.uint8)
    cv2.drawContours(hull, [cv2.convexHull(contour)], -1, 1, cv2.FILLED)
    filled = np.zeros(part.shape, np.uint8)
    cv2.drawContours(filled, [contour], -1, 1, cv2.FILLED)
    evidence[(hull > 0) & (evidence < 0) & (filled > 0)] = 0.0
    points = (contour[:, 0, :].astype(float) + 0.5) * FACTOR - 0.5 + (left, top)
    return Seen(evidence, (int(left), int(top)), points)


def _box_iou(rectangle, box: Array) -> float:
    u, v, w, h = rectangle
    both = np.minimum((u + w, v + h), box[2:]) - np.maximum((u, v), box[:2])
    area = float(np.clip(both, 0, None).prod())
    return area / max(w * h + float((box[2:] - box[:2]).prod()) - area, 1e-9)

"""A second look at each box: in the camera's full resolution, and to one scale of the belt.

The first look sees the belt at two thirds of the camera's resolution. What tells a male SMA end
from a female one is then two pixels wide, and a TNC adapter near by as large as an N adapter far
off. Here a square of the belt's millimetres about each box is cut from the camera's own picture;
a small network tells the similar classes apart, and from things that are no part.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array
from twin.stack.config import Camera
from twin.stack.detection.boxes import Boxes

SIDE = 64  # px of a patch
SPAN = 0.050  # m of the belt that it shows: the longest part in any direction, and a little more
FIRST_SAYS = 0.3  # weight of the first look's log-chances; the best of 0, 0.3, 0.6 in validation
FAINT = 1e-6  # chance that counts as none
DEPTH = (0.1, 5.0)  # m: a belt nearer or farther than this is none


def scale_at(camera: Camera, centre: Array, plane_z: float) -> float:
    """Pixels of the picture a metre, across the line of sight, where the belt is seen.

    Args:
        camera: as calibrated.
        centre: pixel u, v. Shape (2,).
        plane_z: height of the belt in base, m.
    """
    u, v = (np.asarray(centre) - camera.matrix[:2, 2]) / camera.focal
    T = camera.T_base_camera
    down = float(T[2, :3] @ (u, v, 1.0))
    depth = (plane_z - T[2, 3]) / down if down else np.inf
    return camera.focal / float(np.clip(depth, *DEPTH))


def patch(image: NDArray[np.uint8], to_patch: Array) -> NDArray[np.uint8]:
    """A patch of the picture. Shape (64, 64, 3).

    Args:
        image: shape (h, w, 3).
        to_patch: pixels of the picture to pixels of the patch. Shape (2, 3).
    """
    return np.asarray(
        cv2.warpAffine(
            image, to_patch, (SIDE, SIDE), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        ),
        np.uint8,
    )


def centred(centre: Array, A: Array) -> Array:
    """A linear map, (2, 2), with the shift that brings a pixel to the patch's middle. (2, 3)"""
    return np.column_stack([A, (SIDE - 1) / 2 - A @ centre])


def patches(
    image: NDArray[np.uint8], boxes: Array, camera: Camera, plane_z: float
) -> NDArray[np.uint8]:
    """One patch a box, all to the same scale. Shape (k, 64, 64, 3).

    Args:
        image: RGB of the camera. Shape (h, w, 3).
        boxes: left, top, right, bottom, px. Shape (k, 4).
        camera: as calibrated.
        plane_z: height of the belt in base, m.
    """
    out = np.empty((len(boxes), SIDE, SIDE, 3), np.uint8)
    for k, box in enumerate(boxes):
        centre = (box[:2] + box[2:] - 1) / 2
        zoom = SIDE / (SPAN * scale_at(camera, centre, plane_z))
        out[k] = patch(image, centred(centre, zoom * np.eye(2)))
    return out


def agreed(boxes: Boxes, chances: Array) -> Boxes:
    """What both looks say, surest first.

    Args:
        boxes: of the first look.
        chances: of the classes and, last, of nothing, by the second. Shape (k, c + 1).

    Returns:
        The same boxes. The classes' chances are the second look's, to which the first adds its own
        by `FIRST_SAYS`; the score is the likeliest one's, times the second look's chance of any
        part, times the root of the first's: unsure by glare or motion, the first is a hint only.
    """
    first = boxes.chances
    there = boxes.score / np.maximum(first.max(axis=1, initial=0.0), FAINT)
    second = np.maximum(chances[:, :-1].astype(float), FAINT)
    both = second * np.maximum(first, FAINT) ** FIRST_SAYS
    share = both / np.maximum(both.sum(axis=1, keepdims=True), FAINT)
    part = second.sum(axis=1)  # the second look's chance of any part
    score = np.sqrt(there) * part * share.max(axis=1, initial=0.0)
    return Boxes(boxes.box, score, share)[np.argsort(-score, kind="stable")]

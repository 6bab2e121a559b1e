"""Exact labels of a picture, from the masks of the studio."""

import cv2
import numpy as np

from evaluation.pictures import Label
from twin.geometry import Array
from twin.plant.feeder import class_of
from twin.plant.studio import Picture, Scene
from twin.stack.detection.silhouette import Outline, draw, shifted

MIN_PIXELS = 12  # fewer seen pixels are no label


def labels_of(
    picture: Picture, scene: Scene, names: tuple[str, ...], drawings, plane_z: float, P: Array
) -> list[Label]:
    """Labels of all parts that are seen.

    Args:
        picture: with its masks.
        scene: where the parts lie.
        names: of the parts, as `Picture.part` counts them.
        drawings: of the classes.
        plane_z: height of the belt in world, m.
        P: projection of world coordinates to the image, (3, 4).
    """
    found = []
    for name, pose in scene.parts.items():
        mask = (picture.part == names.index(name)).astype(np.uint8)
        seen = int(mask.sum())
        if seen < MIN_PIXELS:
            continue
        left, top, width, height = cv2.boundingRect(mask)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        hull = cv2.convexHull(np.concatenate(contours))[:, 0, :]
        part_class = class_of(name)
        whole = _outline_area(drawings[part_class], pose, plane_z, P)
        found.append(
            Label(
                part_class=part_class,
                box=(left, top, left + width, top + height),
                contour=[(int(u), int(v)) for u, v in hull],
                pose=(float(pose[0]), float(pose[1]), float(pose[2])),
                visible=min(1.0, seen / max(whole, 1.0)),
            )
        )
    return found


def _outline_area(drawing, pose: Array, plane_z: float, P: Array) -> float:
    """Area that the whole part would cover, also beyond the picture's edges, px."""
    x, y, w = P @ (pose[0], pose[1], plane_z, 1.0)
    margin = 100
    mask = np.zeros((2 * margin, 2 * margin), np.uint8)
    outline = Outline.of(drawing)
    patch = shifted(P, round(x / w) - margin, round(y / w) - margin)
    draw(outline.points, outline.starts, np.asarray(pose, float), plane_z, patch, mask)
    return float(mask.sum())

"""Runs networks over labelled pictures, as the stack would look at them."""

from collections.abc import Callable
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from evaluation.detection import Judged
from evaluation.pictures import PictureSet, Shot, region_of, window_of
from twin.geometry import Array
from twin.stack.config import Camera, StackConfig
from twin.stack.detection.boxes import Boxes
from twin.stack.detection.roi import Region

SEEN = 0.7  # share of a part that must be seen for it to be wanted
INSIDE = 4.0  # px within the window's edge, where a part is surely wanted


class Eyes(Protocol):
    """Whatever tells parts in a picture, such as `twin.stack.detection.network.Network`."""

    def see(
        self, image: NDArray[np.uint8], region: Region, camera: Camera, plane_z: float
    ) -> Boxes:
        """Boxes in px of the picture, surest first, however unsure."""
        ...


def judge_pictures(
    pictures: PictureSet,
    config: StackConfig,
    eyes: Eyes,
    limit: int | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Judged]:
    """What is told of each picture beside what is there, in px of its input.

    Args:
        pictures: labelled.
        config: the drawing.
        eyes: that look.
        limit: number of pictures, all without one.
        progress: called with how many are done, and of how many.
    """
    judged = []
    total = min(limit or len(pictures), len(pictures))
    for k in range(total):
        progress(k, total)
        shot = pictures.shots[k]
        region, window = region_of(shot, config), window_of(shot, config)
        boxes = eyes.see(pictures.image(k), region, shot.camera, config.site.line.height)
        boxes = Boxes(region.to_input(boxes.box), boxes.score, boxes.chances)
        polygon = region.points_to_input(window).astype(np.float32)
        boxes = boxes[_depth(boxes.box, polygon) >= 0]
        truth = region.to_input(np.array([x.box for x in shot.labels], float).reshape(-1, 4))
        seen = np.array([x.visible for x in shot.labels], float)
        wanted = (_depth(truth, polygon) >= INSIDE) & (seen >= SEEN)
        judged.append(
            Judged(
                truth=truth[wanted],
                truth_class=np.array([x.index for x in shot.labels], int)[wanted],
                ignored=truth[~wanted],
                box=boxes.box,
                score=boxes.score,
                box_class=boxes.part_class,
                tags=tags_of(shot),
            )
        )
    return judged


def tags_of(shot: Shot) -> frozenset[str]:
    """Conditions by which figures are told apart."""
    c = shot.condition
    return frozenset(
        {f"height {c.height}", f"angle {c.angle}", f"light {c.light}", f"content {c.content}"}
    )


def _depth(boxes: Array, polygon: NDArray[Any]) -> Array:
    """How far each box's centre lies within a polygon, px; negative outside. Shape (k,)."""
    centres = (boxes[:, :2] + boxes[:, 2:]) / 2
    depths = [cv2.pointPolygonTest(polygon, (float(u), float(v)), True) for u, v in centres]
    return np.array(depths, float)

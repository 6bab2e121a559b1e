"""Runs a network over labelled pictures, as the stack would look at them."""

from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from evaluation.detection import Judged
from evaluation.pictures import PictureSet, Shot, region_of, window_of
from twin.geometry import Array
from twin.stack.config import StackConfig
from twin.stack.detection.boxes import read_maps
from twin.stack.detection.roi import WIDTH

Maps = Callable[[NDArray[np.uint8]], Sequence[NDArray[Any]]]
FAINT = 0.02  # score from which boxes are kept, for the whole curve of precision over recall
SEEN = 0.7  # share of a part that must be seen for it to be wanted
INSIDE = 4.0  # px within the window's edge, where a part is surely wanted


def judge_pictures(
    pictures: PictureSet,
    config: StackConfig,
    maps: Maps,
    limit: int | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Judged]:
    """What the network says of each picture beside what is there, in px of its input.

    Args:
        pictures: labelled.
        config: the drawing.
        maps: the network.
        limit: number of pictures, all without one.
        progress: called with how many are done, and of how many.
    """
    judged = []
    total = min(limit or len(pictures), len(pictures))
    for k in range(total):
        progress(k, total)
        shot = pictures.shots[k]
        region, window = region_of(shot, config), window_of(shot, config)
        boxes = read_maps(maps(region.input(pictures.image(k))), WIDTH, FAINT)
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

"""From the network's raw maps to boxes: decoding and suppression of doubles."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array

MAX_LOG_SIZE = 6.0  # of exp(tw), as in training
NMS_IOU = 0.45  # of two boxes from which they show the same part
MAX_BOXES = 300  # best ones that are compared with each other


@dataclass(frozen=True)
class Boxes:
    """What the network sees, surest first."""

    box: Array  # (k, 4) left, top, right, bottom in px of the input
    score: Array  # (k,) that a part of this class is there
    chances: Array  # (k, c) of the classes, given that a part is there

    @property
    def part_class(self) -> NDArray[np.intp]:
        """Index of the likeliest class. Shape (k,)."""
        return self.chances.argmax(axis=1)

    def __getitem__(self, chosen) -> "Boxes":
        return Boxes(self.box[chosen], self.score[chosen], self.chances[chosen])


def read_maps(maps: Sequence[NDArray[Any]], width: int, threshold: float) -> Boxes:
    """All parts surer than a threshold, each once.

    Args:
        maps: (tx, ty, tw, th, object, classes) of each cell. Shapes (h, w, 5 + c).
        width: of the network's input, px.
        threshold: least score.
    """
    found = [_decode(raw, width // raw.shape[1], threshold) for raw in maps]
    boxes = Boxes(
        np.concatenate([b.box for b in found]),
        np.concatenate([b.score for b in found]),
        np.concatenate([b.chances for b in found]),
    )
    boxes = boxes[np.argsort(-boxes.score, kind="stable")[:MAX_BOXES]]
    return boxes[suppress(boxes.box, NMS_IOU)]


def _decode(raw: Array, stride: int, threshold: float) -> Boxes:
    """Cells of one map whose score passes; the loss trains `decode` to the same formulas."""
    # No class can lift a score above that of "object": most cells end here.
    logit = np.log(threshold / (1.0 - threshold))
    v, u = np.nonzero(raw[:, :, 4] > logit)
    cells = raw[v, u].astype(float)
    chances = np.exp(cells[:, 5:] - cells[:, 5:].max(axis=1, keepdims=True))
    chances /= chances.sum(axis=1, keepdims=True)
    score = chances.max(axis=1, initial=0.0) / (1.0 + np.exp(-cells[:, 4]))
    centre = (cells[:, :2] + np.column_stack([u, v]) + 0.5) * stride
    half = np.exp(np.minimum(cells[:, 2:4], MAX_LOG_SIZE)) * stride / 2
    sure = score > threshold
    return Boxes(np.hstack([centre - half, centre + half]), score, chances)[sure]


def suppress(box: Array, limit: float) -> NDArray[np.intp]:
    """Greedy suppression: boxes kept, best first, none overlapping a better one.

    Args:
        box: left, top, right, bottom, best first. Shape (k, 4).
        limit: intersection over union that two kept boxes must not reach.
    """
    kept: list[int] = []
    alive = np.ones(len(box), bool)
    for i in range(len(box)):
        if alive[i]:
            kept.append(i)
            alive[i + 1 :] &= iou(box[i], box[i + 1 :]) < limit
    return np.array(kept, dtype=np.intp)


def iou(box: Array, others: Array) -> Array:
    """Intersection over union of a box, (4,), with others, (k, 4). Shape (k,)."""
    both = np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2])
    both = np.clip(both, 0.0, None).prod(axis=1)
    sizes = (others[:, 2:] - others[:, :2]).prod(axis=1) + (box[2:] - box[:2]).prod()
    return both / np.maximum(sizes - both, 1e-9)

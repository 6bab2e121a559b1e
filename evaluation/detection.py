"""Detections against labels: right, missed, confused, false; average precision.

A label counts as found by a box of at least IoU 0.5. `accuracy` is right / total, as in table 2 of
Li & An 2025: whoever is missed or confused counts against it. `recall` is right / (right + missed).
`precision` is right / reported as this class.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array
from twin.messages import PART_CLASSES
from twin.stack.detection.boxes import iou

FOUND = 0.5  # IoU
SMALL = 32.0  # px at the input, longer side: a small part, as COCO's 32 x 32 px


@dataclass(frozen=True)
class Judged:
    """One picture: what was there and what was reported. Boxes in px of the network's input."""

    truth: Array  # (k, 4)
    truth_class: Array  # (k,)
    ignored: Array  # (j, 4) neither wanted nor wrong
    box: Array  # (n, 4) reported
    score: Array  # (n,)
    box_class: NDArray[np.integer]  # (n,)
    tags: frozenset[str] = frozenset()  # conditions


@dataclass
class ClassCount:
    """One row of the table."""

    total: int = 0
    right: int = 0
    confused: int = 0
    missed: int = 0
    reported: int = 0

    @property
    def accuracy(self) -> float:
        return self.right / self.total if self.total else float("nan")

    @property
    def recall(self) -> float:
        seen = self.right + self.missed
        return self.right / seen if seen else float("nan")

    @property
    def precision(self) -> float:
        return self.right / self.reported if self.reported else float("nan")


@dataclass
class Counts:
    """Counts at one threshold."""

    classes: list[ClassCount] = field(default_factory=lambda: [ClassCount() for _ in PART_CLASSES])
    false: int = 0  # reported where nothing is
    pictures: int = 0

    @property
    def accuracy_mean(self) -> float:
        return float(np.mean([c.accuracy for c in self.classes]))

    @property
    def accuracy_min(self) -> float:
        return float(np.nanmin([c.accuracy for c in self.classes]))

    @property
    def recall_min(self) -> float:
        return float(np.nanmin([c.recall for c in self.classes]))

    @property
    def precision_min(self) -> float:
        return float(np.nanmin([c.precision for c in self.classes]))


def count(pictures: Sequence[Judged], threshold: float, tag: str | None = None) -> Counts:
    """Count pictures that bear a tag, all without one."""
    counts = Counts()
    for picture in pictures:
        if tag is not None and tag not in picture.tags:
            continue
        counts.pictures += 1
        sure = picture.score >= threshold
        boxes, classes = picture.box[sure], picture.box_class[sure]
        owner = match(picture.truth, boxes, picture.score[sure])
        for k, c in enumerate(picture.truth_class):
            row = counts.classes[int(c)]
            row.total += 1
            found = np.flatnonzero(owner == k)
            if len(found) == 0:
                row.missed += 1
                continue
            said = int(classes[found[0]])
            row.right += said == c
            row.confused += said != c
        for n, box in enumerate(boxes):
            if owner[n] >= 0:
                counts.classes[int(classes[n])].reported += 1
            elif not _excused(box, picture.ignored):
                counts.classes[int(classes[n])].reported += 1
                counts.false += 1
    return counts


def average_precision(
    pictures: Sequence[Judged], limit: float = FOUND, small: bool = False
) -> float:
    """Mean over the classes of the area under precision over recall, all points (VOC 2010).

    Args:
        pictures: with everything reported, however unsure.
        limit: IoU from which a box finds a label.
        small: count small parts only; others are then ignored.
    """
    return float(np.nanmean([_ap(pictures, c, limit, small) for c in range(len(PART_CLASSES))]))


def map50_95(pictures: Sequence[Judged]) -> float:
    """COCO's mean over IoU 0.50, 0.55, ... 0.95."""
    return float(np.mean([average_precision(pictures, x) for x in np.arange(0.5, 0.96, 0.05)]))


def _ap(pictures: Sequence[Judged], part_class: int, limit: float, small: bool) -> float:
    scores: list[float] = []
    hits: list[bool] = []
    wanted = 0
    for p in pictures:
        mine = p.truth_class == part_class
        size = (p.truth[:, 2:] - p.truth[:, :2]).max(axis=1, initial=0.0)
        counted = mine & (size < SMALL) if small else mine
        wanted += int(counted.sum())
        truth, excused = p.truth[counted], np.vstack([p.ignored, p.truth[mine & ~counted]])
        chosen = p.box_class == part_class
        boxes, score = p.box[chosen], p.score[chosen]
        owner = match(truth, boxes, score, limit)
        for n, box in enumerate(boxes):
            if owner[n] < 0 and _excused(box, excused):
                continue
            scores.append(float(score[n]))
            hits.append(bool(owner[n] >= 0))
    if wanted == 0:
        return float("nan")
    order = np.argsort(-np.array(scores), kind="stable")
    hit = np.array(hits, float)[order]
    right = np.cumsum(hit)
    precision = right / np.arange(1, len(hit) + 1)
    best = np.maximum.accumulate(precision[::-1])[::-1]
    return float((best * hit).sum() / wanted)


def match(truth: Array, boxes: Array, score: Array, limit: float = FOUND) -> Array:
    """Label that each box finds, -1 for none; each label is found once, by the surest. (n,)"""
    owner = np.full(len(boxes), -1)
    taken = np.zeros(len(truth), bool)
    for n in np.argsort(-score, kind="stable"):
        if len(truth) == 0:
            break
        overlap = np.where(taken, 0.0, iou(boxes[n], truth))
        k = int(np.argmax(overlap))
        if overlap[k] >= limit:
            owner[n], taken[k] = k, True
    return owner


def _excused(box: Array, ignored: Array) -> bool:
    """Whether a box lies mostly on something that is neither wanted nor wrong."""
    if len(ignored) == 0:
        return False
    both = np.minimum(box[2:], ignored[:, 2:]) - np.maximum(box[:2], ignored[:, :2])
    share = np.clip(both, 0.0, None).prod(axis=1) / max(float((box[2:] - box[:2]).prod()), 1e-9)
    return bool((share > 0.5).any())

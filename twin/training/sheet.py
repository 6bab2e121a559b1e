"""Contact sheets: many pictures with their labels at a glance."""

import cv2
import numpy as np
from numpy.typing import NDArray

from evaluation.pictures import PictureSet
from twin.messages import PART_CLASSES

COLOURS = ((255, 80, 80), (80, 255, 80), (90, 160, 255), (255, 230, 60), (255, 90, 255))


def contact_sheet(
    pictures: PictureSet, rows: int = 4, columns: int = 4, first: int = 0
) -> NDArray[np.uint8]:
    """A grid of labelled pictures, each at half its size. RGB."""
    tiles = []
    for k in range(first, first + rows * columns):
        if k >= len(pictures):
            tiles.append(np.zeros((240, 320, 3), np.uint8))
            continue
        image, shot = pictures.image(k).copy(), pictures.shots[k]
        for label in shot.labels:
            left, top, right, bottom = map(int, label.box)
            cv2.rectangle(image, (left, top), (right, bottom), COLOURS[label.index], 1)
        tile = cv2.resize(image, (320, 240), interpolation=cv2.INTER_AREA)
        c = shot.condition
        text = f"{c.light} {c.height} {c.angle} {c.content} {shot.saturated:.2f}"
        cv2.putText(tile, text, (4, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.38, (255, 255, 255), 1)
        tiles.append(tile)
    grid = [np.hstack(tiles[r * columns : (r + 1) * columns]) for r in range(rows)]
    return np.ascontiguousarray(np.vstack(grid))


def legend() -> str:
    """Which colour is which class."""
    return ", ".join(f"{c} {rgb}" for c, rgb in zip(PART_CLASSES, COLOURS, strict=True))

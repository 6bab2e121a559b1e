"""Maps against the truth: precision, recall and intersection over union of occupied cells.

A cell that the map calls occupied is right if a true cell lies within the tolerance of it (one cell
to every side and corner); a true cell is found if an occupied one lies within the tolerance. So a
wall on the border of two cells counts as found by either.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from evaluation.map_truth import MapTruth
from twin.stack.estimation.occupancy_grid import FREE, OCCUPIED

Mask = NDArray[np.bool_]
DETECTED = 0.5  # share of an obstacle's cells from which it counts as detected
SCALE = 4  # pixels a cell in the pictures
# Colours of the pictures, RGB.
WHITE, GREY, BLACK = (255, 255, 255), (205, 205, 205), (0, 0, 0)
FOUND, MISSED, WRONG = (40, 40, 40), (220, 40, 40), (60, 90, 230)


@dataclass(frozen=True)
class MapScore:
    """Of one map; NaN where there was nothing to find or nothing was claimed."""

    precision: float
    recall: float
    iou: float


def widened(mask: Mask, cells: int = 1) -> Mask:
    """The mask and all within some cells of it, corners included. Shape (h, w)."""
    kernel = np.ones((2 * cells + 1, 2 * cells + 1), np.uint8)
    return cv2.dilate(mask.astype(np.uint8), kernel).astype(bool)


def score(occupied: Mask, truth: Mask, tolerance: int = 1) -> MapScore:
    """Score of a map's occupied cells against the true ones; shapes (h, w).

    Intersection over union: true cells found, over these, the true cells missed and the occupied
    cells that are wrong.

    Raises:
        ValueError: if the shapes differ.
    """
    if occupied.shape != truth.shape:
        raise ValueError(f"map of {occupied.shape} cells against a truth of {truth.shape}")
    right = int(np.sum(occupied & widened(truth, tolerance)))
    found = int(np.sum(truth & widened(occupied, tolerance)))
    claimed, there = int(np.sum(occupied)), int(np.sum(truth))
    union = there + claimed - right
    return MapScore(
        right / claimed if claimed else float("nan"),
        found / there if there else float("nan"),
        found / union if union else float("nan"),
    )


def detection(occupied: Mask, truth: MapTruth, tolerance: int = 1) -> dict[str, list[bool]]:
    """Whether each visible obstacle was detected, by kind: half of its visible cells were found."""
    near = widened(occupied, tolerance)
    found: dict[str, list[bool]] = {}
    for kind, cells in zip(truth.kinds, truth.obstacles, strict=True):
        if cells.any():
            found.setdefault(kind, []).append(bool(np.mean(near[cells]) >= DETECTED))
    return found


def missed_by_one(lidar: Mask, rgbd: Mask, truth: MapTruth) -> float:
    """Share of the visible obstacles that one of the two sensors' maps does not show."""
    both = [detection(occupied, truth) for occupied in (lidar, rgbd)]
    pairs = [pair for kind in both[0] for pair in zip(both[0][kind], both[1][kind], strict=True)]
    return float(np.mean([not all(pair) for pair in pairs])) if pairs else float("nan")


def map_metrics(states: Mapping[str, NDArray[np.int8]], truth: MapTruth) -> dict[str, float]:
    """Figures of the maps `lidar`, `rgbd` and `fused` for the report, by name of the metric."""
    figures: dict[str, float] = {}
    for name, cells in states.items():
        of = score(cells == OCCUPIED, truth.surface)
        figures[f"occupied_recall_{name}"] = of.recall
        figures[f"occupied_precision_{name}"] = of.precision
        figures[f"occupied_iou_{name}"] = of.iou
    figures["occupied_recall_gain"] = (
        figures["occupied_recall_fused"] - figures["occupied_recall_lidar"]
    )
    for name, cells in states.items():
        found = detection(cells == OCCUPIED, truth)
        every = [hit for hits in found.values() for hit in hits]
        figures[f"obstacles_detected_{name}"] = float(np.mean(every)) if every else float("nan")
        for kind in sorted(found):
            figures[f"detected_{kind}_{name}"] = float(np.mean(found[kind]))
    lidar, rgbd = (states[name] == OCCUPIED for name in ("lidar", "rgbd"))
    figures["obstacles_missed_by_one"] = missed_by_one(lidar, rgbd, truth)
    return figures


def map_picture(states: NDArray[np.int8]) -> NDArray[np.uint8]:
    """A map as a picture, north up: black occupied, white free, grey unknown. (h, w, 3) scaled."""
    picture = np.full((*states.shape, 3), GREY, dtype=np.uint8)
    picture[states == FREE], picture[states == OCCUPIED] = WHITE, BLACK
    return _scaled(picture)


def truth_picture(truth: MapTruth) -> NDArray[np.uint8]:
    """The true cells; those of obstacles in red."""
    picture = np.full((*truth.surface.shape, 3), WHITE, dtype=np.uint8)
    picture[truth.surface] = BLACK
    picture[truth.obstacles.any(axis=0)] = MISSED
    return _scaled(picture)


def error_picture(states: NDArray[np.int8], truth: MapTruth) -> NDArray[np.uint8]:
    """True cells found dark, missed red; occupied cells that are wrong blue."""
    occupied = states == OCCUPIED
    picture = np.full((*states.shape, 3), WHITE, dtype=np.uint8)
    picture[states != FREE] = GREY
    near = widened(occupied)
    picture[occupied & ~widened(truth.surface)] = WRONG
    picture[truth.surface & near] = FOUND
    picture[truth.surface & ~near] = MISSED
    return _scaled(picture)


def write_pictures(
    folder: Path, states: Mapping[str, NDArray[np.int8]], truth: MapTruth
) -> list[str]:
    """`map_<name>.png` and `map_<name>_errors.png` of each map, and `map_truth.png`."""
    pictures = {"map_truth": truth_picture(truth)}
    for name, cells in states.items():
        pictures[f"map_{name}"] = map_picture(cells)
        pictures[f"map_{name}_errors"] = error_picture(cells, truth)
    for name, picture in pictures.items():
        cv2.imwrite(str(Path(folder) / f"{name}.png"), picture[..., ::-1])
    return [f"{name}.png" for name in pictures]


def _scaled(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    north_up = np.ascontiguousarray(picture[::-1])
    return np.repeat(np.repeat(north_up, SCALE, axis=0), SCALE, axis=1)

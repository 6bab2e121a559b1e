"""Class and pose of one silhouette, by comparing it with the outlines of the drawings.

Every class is drawn at every yaw in steps of 15 degrees where the silhouette's centroid puts it,
and ranked by intersection over union (Li & An 2025, section 3.1, name IoU as the last step of their
contour detection). The best few are then fitted: Gauss-Newton on the moments of the silhouette up
to the third order, which takes parallax out, since the drawn outline has the same parallax.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.geometry import Array, wrap_angle
from twin.messages import PartClass
from twin.stack.config import PartDrawing
from twin.stack.detection.silhouette import Outline, fit, moments, scan, shifted

YAWS = np.arange(24) * (2 * np.pi / 24)
AREA_RATIO = (0.6, 1.5)  # seen over drawn area outside of which a class is not tried
KEPT = 0.06  # hypotheses this close to the best IoU are fitted
MAX_FITTED = 3
ITERATIONS = 3
STEP = np.array([1e-3, 1e-3, np.radians(3.0)])  # of the numerical derivative
SHARPNESS = 80.0  # log-likelihood per unit of IoU: from the spread over rendered frames


@dataclass(frozen=True)
class Fit:
    """One hypothesis after fitting."""

    part_class: PartClass
    pose: Array  # (3,) x, y, yaw of the part frame in base
    iou: float
    confidence: float  # of the class among all
    symmetric: bool  # the half-turned part fits as well


class Classifier:
    """Compares silhouettes with the drawings.

    Args:
        drawings: the classes to tell apart.
        plane_z: height of the belt in base, m.
    """

    def __init__(self, drawings: Mapping[PartClass, PartDrawing], plane_z: float):
        self._drawings: dict[PartClass, PartDrawing] = dict(drawings)
        self._outlines: dict[PartClass, Outline] = {
            name: Outline.of(d) for name, d in drawings.items()
        }
        self._plane_z = plane_z

    def classify(self, seen: NDArray[np.uint8], corner: tuple[int, int], P: Array) -> Fit | None:
        """Best class and pose.

        Args:
            seen: filled silhouette, ones inside, with a free margin. Shape (h, w).
            corner: pixel (u, v) of `seen[0, 0]` in the image.
            P: projection of base coordinates to the image, (3, 4).
        """
        P = shifted(P, *corner)
        ranked = self._rank(seen, P)
        target = moments(seen)
        if not ranked:
            return None
        best = ranked[0][0]
        fits: dict[PartClass, tuple[float, Array]] = {}
        flipped: dict[PartClass, float] = {}
        for iou, candidate, pose in ranked[: 2 * MAX_FITTED]:
            if iou < best - KEPT:
                break
            if candidate not in fits and len(fits) == MAX_FITTED:
                continue
            outline = self._outlines[candidate]
            fitted, score = fit(
                outline.points, outline.starts, pose, self._plane_z, P, seen, target, STEP,
                ITERATIONS,
            )  # fmt: skip
            fitted[2] = wrap_angle(fitted[2])
            known = fits.get(candidate)
            if known is None or score > known[0]:
                if known is not None and _half_turn(known[1], fitted):
                    flipped[candidate] = known[0]
                fits[candidate] = score, fitted
            elif _half_turn(known[1], fitted):
                flipped[candidate] = max(score, flipped.get(candidate, 0.0))
        name: PartClass = max(fits, key=lambda n: fits[n][0])
        iou, pose = fits[name]
        # Classes that were not fitted count with their IoU of the first look.
        scores = {n: fits[n][0] if n in fits else first for first, n, _ in reversed(ranked)}
        weight = np.exp(SHARPNESS * (np.array(list(scores.values())) - iou))
        alike = flipped.get(name, 0.0) > iou - 0.01
        symmetric = self._drawings[name].symmetric or alike
        return Fit(name, pose, iou, float(1.0 / weight.sum()), symmetric)

    def _rank(self, seen, P) -> list[tuple[float, PartClass, Array]]:
        """Local maxima over yaw of each class, best IoU first; at half the resolution."""
        half = cv2.resize(seen * np.uint8(255), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        half = (half > 127).astype(np.uint8)
        P = shifted(P, 0, 0, 2.0)
        target = moments(half)
        found: list[tuple[float, PartClass, Array]] = []
        for name, outline in self._outlines.items():
            z = self._plane_z + self._drawings[name].height / 2
            x, y = ground_point(P, target[1], target[2], z)
            scores = scan(
                outline.points, outline.starts, x, y, YAWS, self._plane_z, P, half, target,
                AREA_RATIO,
            )  # fmt: skip
            peak = (scores >= np.roll(scores, 1)) & (scores > np.roll(scores, -1))
            for i in np.flatnonzero(peak):
                found.append((float(scores[i]), name, np.array([x, y, YAWS[i]])))
        return sorted(found, key=lambda item: -item[0])


def _half_turn(first: Array, second: Array) -> bool:
    return abs(abs(float(wrap_angle(first[2] - second[2]))) - np.pi) < 0.5


@njit(cache=True)
def ground_point(P, u, v, z):
    """Where the ray through a pixel meets the horizontal plane at height z in base. x, y in m.

    Args:
        P: projection of base coordinates to the image, (3, 4).
        u, v: the pixel.
        z: m.
    """
    a = P[0, 0] - u * P[2, 0]
    b = P[0, 1] - u * P[2, 1]
    c = P[1, 0] - v * P[2, 0]
    d = P[1, 1] - v * P[2, 1]
    e = -((P[0, 2] - u * P[2, 2]) * z + P[0, 3] - u * P[2, 3])
    f = -((P[1, 2] - v * P[2, 2]) * z + P[1, 3] - v * P[2, 3])
    det = a * d - b * c
    return (e * d - b * f) / det, (a * f - e * c) / det

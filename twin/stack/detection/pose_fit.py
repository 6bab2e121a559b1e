"""Pose of one part of known class: the drawing laid where the picture speaks most for it.

Each pixel speaks for the part (brighter than the belt, or a dark bore) or for the belt. The drawn
outline is moved until what it covers says most for the part and its own box lies in the network's:
the box helps where a bore is as dark as the belt. Li & An 2025, section 3.1, end with the centroid
of a contour; that of a drawing does not move with a piece of contour that is lost.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from twin.geometry import Array, wrap_angle
from twin.stack.config import PartDrawing
from twin.stack.detection.classify import ground_point
from twin.stack.detection.silhouette import Outline, draw, shifted

YAWS = 24  # of the first look
STARTS = 3  # best of them that are refined
STEPS = (1.5e-3, 1.5e-3, np.radians(6.0))  # m, m, rad: first step of the search, halved
HALVINGS = 5  # down to 0.05 mm and 0.2 degrees
BOX_SIGMA = 1.5  # px, of a side of the network's box
BOX_WEIGHT = 0.15  # of the sides, in evidence a px of outline


@dataclass(frozen=True)
class PoseFit:
    """How a part lies."""

    pose: Array  # (3,) x, y, yaw of the part frame in base
    quality: float  # evidence covered over all there is: 1 for a perfect fit
    symmetric: bool  # turned by half a turn it would fit as well


class PoseFitter:
    """Fits one class.

    Args:
        drawing: of the class.
        plane_z: height of the belt in base, m.
    """

    def __init__(self, drawing: PartDrawing, plane_z: float):
        self._outline, self._drawing, self._plane_z = Outline.of(drawing), drawing, plane_z

    def fit(
        self, evidence: Array, corner: tuple[int, int], factor: float, box: Array, P: Array
    ) -> PoseFit | None:
        """Best pose; None where nothing speaks for a part.

        Args:
            evidence: from -1 for the belt to 1 for the part. Shape (h, w).
            corner: pixel (u, v) of the image at its origin.
            factor: px of the image a px of it.
            box: of the network, in px of the image.
            P: projection of base coordinates to the image, (3, 4).
        """
        there = float(np.maximum(evidence, 0.0).sum())
        if there < 20.0:
            return None
        points, starts, z = self._outline.points, self._outline.starts, self._plane_z
        centre = (box[:2] + box[2:]) / 2 - 0.5
        x, y = ground_point(P, centre[0], centre[1], z + self._drawing.height / 2)
        patch = shifted(P, *corner, factor)
        offset = 0.5 * (factor - 1.0)
        inside = (box - (*corner, *corner) - offset - np.array([0.0, 0, 1, 1])) / factor
        sigma = BOX_SIGMA / factor
        weight = BOX_WEIGHT * float(np.sqrt(there))
        mask = np.empty(evidence.shape, np.uint8)
        poses, scores = _around(
            points, starts, (x, y), z, patch, evidence, mask, inside, sigma, weight, factor, P
        )
        best = np.argsort(-scores, kind="stable")[:STARTS]
        steps = np.array(STEPS)
        fits = [
            _search(
                points, starts, pose, z, patch, evidence, mask, inside, sigma, weight, steps,
                HALVINGS,
            )
            for pose in poses[best]
        ]  # fmt: skip
        pose, score = max(fits, key=lambda f: f[1])
        turned = [s for p, s in fits if abs(abs(float(wrap_angle(p[2] - pose[2]))) - np.pi) < 0.5]
        alike = bool(turned) and max(turned) > score - 0.02 * there
        pose[2] = wrap_angle(pose[2])
        return PoseFit(pose, score / there, self._drawing.symmetric or alike)


@njit(cache=True)
def _around(
    points, starts, place, plane_z, patch, evidence, mask, inside, sigma, weight, factor, P
):
    """Poses all around, each moved so that its box is centred in the network's; their scores."""
    poses, scores = np.empty((YAWS, 3)), np.empty(YAWS)
    for i in range(YAWS):
        pose = poses[i]
        pose[0], pose[1], pose[2] = place[0], place[1], i * 2 * np.pi / YAWS
        left, top, right, bottom = draw(points, starts, pose, plane_z, patch, mask)
        if right >= left:
            du = (inside[0] + inside[2] - left - right) / 2 * factor
            dv = (inside[1] + inside[3] - top - bottom) / 2 * factor
            u, v, w = P[:, 0] * pose[0] + P[:, 1] * pose[1] + P[:, 2] * plane_z + P[:, 3]
            moved = ground_point(P, u / w + du, v / w + dv, plane_z)
            pose[0], pose[1] = moved
        scores[i] = _score(
            points, starts, pose, plane_z, patch, evidence, mask, inside, sigma, weight
        )
    return poses, scores


@njit(cache=True)
def _score(points, starts, pose, plane_z, P, evidence, mask, inside, sigma, weight):
    """Evidence under the outline, less a penalty for a box other than the network's."""
    left, top, right, bottom = draw(points, starts, pose, plane_z, P, mask)
    total = 0.0
    for v in range(top, bottom + 1):
        for u in range(left, right + 1):
            if mask[v, u]:
                total += evidence[v, u]
    off = (
        (left - inside[0]) ** 2
        + (top - inside[1]) ** 2
        + (right - inside[2]) ** 2
        + (bottom - inside[3]) ** 2
    )
    return total - weight * off / sigma**2


@njit(cache=True)
def _search(
    points, starts, pose, plane_z, P, evidence, mask, inside, sigma, weight, steps, halvings
):
    """Pattern search about a pose (Hooke & Jeeves 1961). Returns the pose, (3,), and its score."""
    best = pose.copy()
    score = _score(points, starts, best, plane_z, P, evidence, mask, inside, sigma, weight)
    step = steps.copy()
    for _ in range(halvings):
        for _ in range(6):
            moved = False
            for k in range(3):
                for sign in (-1.0, 1.0):
                    trial = best.copy()
                    trial[k] += sign * step[k]
                    value = _score(
                        points, starts, trial, plane_z, P, evidence, mask, inside, sigma, weight
                    )
                    if value > score:
                        best, score, moved = trial, value, True
                        break
            if not moved:
                break
        step = step / 2
    return best, score

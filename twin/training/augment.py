"""Crops for training: turned, mirrored, scaled, lit, noisy, covered, on another ground, four in
one (mosaic)."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from evaluation.pictures import PictureSet, region_of
from twin.geometry import Array
from twin.stack.config import StackConfig
from twin.stack.detection.roi import GREY
from twin.training.backdrop import Backdrop

CROP = 128  # px
ZOOM = (0.90, 1.11)  # about the scale at which the stack would look: size tells TNC from N
TURN_DEG = 12.0
BANK = 1 << 20  # stored standard normals
OFF_CENTRE = 0.25  # of the crop's side, of the part that it is taken about
MOSAIC = 0.6  # of the crops are four in one
SMEAR = 3.5  # px of motion at most
SEEN, HINTED = 0.45, 0.1  # share of a part from which it is a target; below the second, nothing


@dataclass(frozen=True)
class Sample:
    """One crop. Boxes are left, top, right, bottom in px."""

    image: NDArray[np.uint8]  # (128, 128, 3)
    boxes: NDArray[np.float32]  # (k, 4)
    classes: NDArray[np.int64]  # (k,)
    ignored: NDArray[np.float32]  # (j, 4)


class Augmenter:
    """Draws crops from a set of pictures.

    Args:
        pictures: of the training part.
        config: the drawing, for where the stack would look.
    """

    def __init__(self, pictures: PictureSet, config: StackConfig):
        self._pictures = pictures
        self._regions = [region_of(shot, config) for shot in pictures.shots]
        self._backdrop = Backdrop(BANK)
        self._bank = np.random.default_rng(BANK).standard_normal(BANK, dtype=np.float32)

    def draw(self, rng: np.random.Generator) -> Sample:
        """One crop, four in one now and then."""
        if rng.random() >= MOSAIC:
            image, found = self._crop(rng, CROP)
        else:
            image, found = np.empty((CROP, CROP, 3), np.uint8), []
            half = CROP // 2
            for v in (0, half):
                for u in (0, half):
                    tile, some = self._crop(rng, half)
                    image[v : v + half, u : u + half] = tile
                    found += [(np.add(box, (u, v, u, v)), c, seen) for box, c, seen in some]
        image = lit(image, self._bank, rng)
        if rng.random() < 0.3:
            found = _cover(image, found, rng)
        sure = [(box, c) for box, c, seen in found if seen >= SEEN]
        return Sample(
            image=image,
            boxes=np.array([box for box, _ in sure], np.float32).reshape(-1, 4),
            classes=np.array([c for _, c in sure], np.int64),
            ignored=np.array(
                [box for box, _, seen in found if HINTED <= seen < SEEN], np.float32
            ).reshape(-1, 4),
        )

    def _crop(self, rng: np.random.Generator, size: int):
        """A square about a part (or anywhere) and what is in it: box, class, share seen."""
        k = int(rng.integers(len(self._pictures)))
        shot, region = self._pictures.shots[k], self._regions[k]
        if shot.labels and rng.random() < 0.9:
            left, top, right, bottom = shot.labels[rng.integers(len(shot.labels))].box
            centre = np.array([(left + right) / 2, (top + bottom) / 2])
        else:
            centre = np.array([region.left, region.top]) + rng.random(2) * (
                region.width,
                region.height,
            )
        scale = region.scale * float(np.exp(rng.uniform(*np.log(ZOOM))))
        angle = np.radians(rng.uniform(-TURN_DEG, TURN_DEG))
        A = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        if rng.random() < 0.5:  # mirrored: the parts are their own mirror images, the lamps are not
            A[:, 0] = -A[:, 0]
        to = size / 2 + rng.uniform(-OFF_CENTRE, OFF_CENTRE, 2) * size
        M = np.column_stack([A, to - A @ centre])
        image = cv2.warpAffine(
            self._pictures.image(k), M, (size, size), flags=cv2.INTER_LINEAR,
            borderValue=(GREY,) * 3,
        )  # fmt: skip
        found, hulls = [], []
        for label in shot.labels:
            hull = np.array(label.contour, float) @ A.T + M[:, 2]
            low, high = hull.min(axis=0), hull.max(axis=0)
            if (high <= 1).any() or (low >= size - 1).any():
                continue
            hulls.append(hull)
            if (low < -0.5).any() or (high > size - 0.5).any():
                share, hull = _clip(hull, size)
            else:
                share = 1.0
            if share * label.visible < HINTED or len(hull) < 3:
                continue
            # The contour is of pixels' centres, the box of their edges, half a source pixel on.
            low, high = hull.min(axis=0) + 0.5 - scale / 2, hull.max(axis=0) + 0.5 + scale / 2
            box = np.concatenate([low, high])
            found.append((np.clip(box, 0, size), label.index, share * label.visible))
        return self._backdrop.lay(np.asarray(image, np.uint8), hulls, rng), found


def _clip(hull: Array, size: int) -> tuple[float, Array]:
    """Share of a convex polygon's area inside a crop, and that part of it."""
    square = np.array([(0, 0), (size, 0), (size, size), (0, size)], np.float32) - 0.5
    area, inside = cv2.intersectConvexConvex(hull.astype(np.float32), np.asarray(square))
    whole = cv2.contourArea(hull.astype(np.float32))
    if inside is None or whole <= 0:
        return 0.0, np.empty((0, 2))
    return area / whole, np.asarray(inside, float).reshape(-1, 2)


def lit(
    image: NDArray[np.uint8], bank: NDArray[np.float32], rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Brightness, contrast, colour and Gaussian noise from a bank of standard normals."""
    factor = np.exp(rng.normal(0, 0.18)) * np.exp(rng.normal(0, 0.06, 3))
    table = np.arange(256.0)[None, :, None] * factor + rng.normal(0, 6)
    out = cv2.LUT(image, np.clip(table, 0, 255).astype(np.uint8))
    if rng.random() < 0.5:
        start = rng.integers(len(bank) - image.size)
        noise = bank[start : start + image.size].reshape(image.shape) * np.float32(
            rng.uniform(0, 6)
        )
        out = cv2.add(out, noise, dtype=cv2.CV_8U)
    kind = rng.random()
    if kind < 0.12:
        out = cv2.GaussianBlur(out, (0, 0), rng.uniform(0.4, 1.0))
    elif kind < 0.45:
        out = cv2.filter2D(out, -1, _smear(rng.uniform(0.5, SMEAR), rng.uniform(0, np.pi)))
    return np.asarray(out, np.uint8)


def _smear(length: float, angle: float) -> Array:
    """Kernel of a motion by `length` px. Shape (7, 7)."""
    kernel = np.zeros((7, 7), np.float32)
    for t in np.linspace(-0.5, 0.5, 13) * length:
        u, v = 3 + t * np.cos(angle), 3 + t * np.sin(angle)
        i, j = int(v), int(u)
        kernel[i : i + 2, j : j + 2] += np.outer((1 - v + i, v - i), (1 - u + j, u - j))
    return kernel / kernel.sum()


def _cover(image: NDArray[np.uint8], found: list, rng: np.random.Generator) -> list:
    """Lay a rectangle of one colour over the crop; what it hides is seen less."""
    size = rng.integers(8, 32, 2)
    u, v = rng.integers(0, CROP - size)
    image[v : v + size[1], u : u + size[0]] = rng.integers(0, 256, 3)
    low, high = np.array([u, v]), np.array([u, v]) + size
    covered = []
    for box, c, seen in found:
        both = np.clip(np.minimum(box[2:], high) - np.maximum(box[:2], low), 0, None).prod()
        share = 1 - float(both / max(float((box[2:] - box[:2]).prod()), 1e-6))
        covered.append((box, c, seen * share))
    return covered

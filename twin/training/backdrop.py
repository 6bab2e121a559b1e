"""Random colours, gratings and shades behind the parts of a crop: belts are many, parts are few."""

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array

BANK, SIDE = 64, 256  # patterns kept, and their side, px
PERIOD = (3.0, 40.0)  # px of a wave
STRENGTH = 0.35  # of a pattern at most
SHARE = 0.6  # of the crops
BRIGHTNESS, HUE = 0.4, 0.25  # sigmas of the ground's brightness and colours, natural logarithm
SHADE = 0.35  # light falls off by up to this over a crop, on parts and belt alike


class Backdrop:
    """Patterns to lay over whatever is not a part.

    Args:
        seed: of the patterns.
    """

    def __init__(self, seed: int):
        rng = np.random.default_rng(seed)
        self._patterns = np.stack([_pattern(rng) for _ in range(BANK)])

    def lay(
        self, image: NDArray[np.uint8], hulls: list[Array], rng: np.random.Generator
    ) -> NDArray[np.uint8]:
        """The crop with another ground, now and then, and another fall of light.

        Args:
            image: shape (n, n, 3), n up to 256.
            hulls: outlines of the parts in it, each (k, 2).
            rng: of this crop.
        """
        if rng.random() > SHARE:
            return image
        n = len(image)
        u, v = rng.integers(0, SIDE - n + 1, 2)
        pattern = self._patterns[rng.integers(BANK), v : v + n, u : u + n]
        colour = np.exp(rng.normal(0, BRIGHTNESS) + rng.normal(0, HUE, 3)).astype(np.float32)
        factor = (1.0 + np.float32(rng.uniform(0, STRENGTH)) * pattern)[:, :, None] * colour
        for hull in hulls:
            cv2.fillConvexPoly(factor, hull.round().astype(np.int32), (1.0, 1.0, 1.0))
        corners = rng.uniform(1 - SHADE, 1 + SHADE, (2, 2)).astype(np.float32)
        shade = np.asarray(cv2.resize(corners, (n, n), interpolation=cv2.INTER_LINEAR))
        lit = image * (factor * shade[:, :, None])
        return np.asarray(np.clip(lit, 0, 255), np.uint8)


def _pattern(rng: np.random.Generator) -> NDArray[np.float32]:
    """One or two waves of any direction, soft or hard. Values from -1 to 1. Shape (256, 256)."""
    v, u = np.mgrid[0:SIDE, 0:SIDE].astype(np.float32)
    total = np.zeros((SIDE, SIDE), np.float32)
    for _ in range(int(rng.integers(1, 3))):
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        w = 2 * np.pi / np.exp(rng.uniform(*np.log(PERIOD)))
        total += np.sin(w * (np.cos(angle) * u + np.sin(angle) * v) + phase)
    return np.asarray(np.tanh(rng.uniform(0.5, 6.0) * total), np.float32)

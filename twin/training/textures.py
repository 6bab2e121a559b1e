"""What a belt's face looks like: factors on its colour, in its own coordinates."""

from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

Texture = Literal[
    "plain", "noise", "weave", "stripes", "scratches", "diamonds", "blotches", "chevrons"
]
PITCH = 0.001  # m a texel
SHAPE = (256, 1024)  # texels across and along the belt


def texture(kind: Texture, rng: np.random.Generator) -> NDArray[np.float32]:
    """Factors about 1. Shape (256, 1024), float32."""
    v, u = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]].astype(np.float32)
    period = rng.uniform(4.0, 24.0)  # mm
    strength = rng.uniform(0.05, 0.35)
    w = 2 * np.pi / period
    if kind == "plain":
        pattern = np.zeros(SHAPE, np.float32)
    elif kind == "noise":
        pattern = _noise(rng, 1.5) + _noise(rng, 12.0)
    elif kind == "weave":
        pattern = np.sin(w * u) * np.sin(w * v)
    elif kind == "stripes":
        pattern = np.sign(np.sin(w * u + rng.uniform(0, 6)))
    elif kind == "scratches":
        pattern = np.zeros(SHAPE, np.float32)
        for _ in range(int(rng.integers(10, 60))):
            start = rng.uniform((0, 0), (SHAPE[1], SHAPE[0]))
            end = start + rng.normal(0, (60, 6))
            (u0, v0), (u1, v1) = start.astype(int).tolist(), end.astype(int).tolist()
            cv2.line(
                pattern, (u0, v0), (u1, v1), float(rng.choice([-1.5, 1.5])), int(rng.integers(1, 3))
            )
    elif kind == "diamonds":
        pattern = np.sign(np.sin(w * (u + v)) * np.sin(w * (u - v)))
    elif kind == "blotches":
        pattern = np.tanh(2.0 * _noise(rng, period))
    else:
        pattern = np.sign(np.sin(w * (u + np.abs(v % (4 * period) - 2 * period))))
    factor = 1.0 + strength * pattern + 0.03 * _noise(rng, 60.0)
    return np.asarray(np.clip(factor, 0.3, 1.9), np.float32)


def stains(rng: np.random.Generator, share: float) -> NDArray[Any]:
    """Where oil lies, 0 to 1, over about a share of an area. Shape (256, 1024), float32."""
    level = np.quantile(field := _noise(rng, rng.uniform(8.0, 25.0)), 1.0 - share)
    return np.clip((field - level) * 6.0, 0.0, 1.0)


def _noise(rng: np.random.Generator, size: float) -> NDArray[Any]:
    """Gaussian noise of unit variance whose grains are about `size` texels. Shape as SHAPE."""
    shrink = max(1, int(size / 2))
    small = rng.standard_normal((SHAPE[0] // shrink + 2, SHAPE[1] // shrink + 2)).astype(np.float32)
    small = cv2.GaussianBlur(small, (0, 0), max(size / shrink / 2, 0.4))
    field = np.asarray(cv2.resize(small, SHAPE[::-1], interpolation=cv2.INTER_CUBIC))
    return field / max(float(field.std()), 1e-6)

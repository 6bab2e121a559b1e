"""From a clean rendering to what the camera sees: belt, oil, motion, exposure, glare, noise."""

import cv2
import numpy as np
from numpy.typing import NDArray

from evaluation.pictures import Condition
from twin.geometry import Array
from twin.plant.sensors.camera import Optics
from twin.plant.studio import BELT, Picture
from twin.training.domain import Domain
from twin.training.textures import PITCH, SHAPE, stains, texture

SATURATED = 250  # grey value from which a pixel counts as saturated, in its brightest channel
GLARE_SHARE = (0.28, 0.60)  # of the parts' pixels driven into saturation under glare
EXPOSURE = (0.002, 0.006)  # s
OIL = (0.45, 0.36, 0.22)  # what a thick film lets through


def develop(
    picture: Picture,
    belt_to_image: Array,
    domain: Domain,
    condition: Condition,
    optics: Optics,
    rng: np.random.Generator,
) -> NDArray[np.uint8]:
    """The picture as taken.

    Args:
        picture: clean rendering with its masks.
        belt_to_image: homography of metres along and across the visible belt to pixels, (3, 3).
        domain: which textures and speeds.
        condition: light and content.
        optics: lens and sensor.
        rng: of this picture.
    """
    light = picture.rgb.astype(np.float32)
    parts = picture.part >= 0
    kind = domain.textures[rng.integers(len(domain.textures))]
    light = _belt_face(light, picture.part == BELT, belt_to_image, texture(kind, rng))
    if rng.random() < 0.3:
        light = _oil(light, rng)
    light = _moved(light, belt_to_image, domain, rng)
    light *= rng.uniform(0.95, 1.05, 3).astype(np.float32)  # white balance
    if condition.light == "glare" and parts.any():
        light = _glare(light, parts, rng)
    else:
        light *= rng.uniform(0.8, 1.2)
    return optics.read_out(light, optics.draw(rng))


def saturated_share(image: NDArray[np.uint8], parts: NDArray[np.bool_]) -> float:
    """Share of the parts' pixels that are saturated."""
    return float((image.max(axis=2)[parts] >= SATURATED).mean()) if parts.any() else 0.0


def _belt_face(light, belt, H, factor) -> Array:
    to_image = H @ np.array([[PITCH, 0, 0], [0, PITCH, -SHAPE[0] * PITCH / 2], [0, 0, 1]])
    size = light.shape[1], light.shape[0]
    warped = cv2.warpPerspective(
        factor, to_image, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
    )
    return np.where(belt[:, :, None], light * warped[:, :, None], light)


def _oil(light, rng) -> Array:
    """Brown films over belt and parts alike, with a glossy edge."""
    size = light.shape[1], light.shape[0]
    film = cv2.resize(stains(rng, rng.uniform(0.03, 0.2)), size)[:, :, None]
    through = 1 - film * (1 - np.array(OIL, np.float32)) * rng.uniform(0.3, 0.9)
    rim = film * (1 - film) * rng.uniform(0, 120)
    return light * through.astype(np.float32) + rim.astype(np.float32)


def _moved(light, H, domain: Domain, rng) -> Array:
    """Blur along the belt's motion, as long as the belt travels within the exposure."""
    span = domain.speeds[rng.integers(len(domain.speeds))]
    travel = rng.uniform(*span) * rng.uniform(*EXPOSURE)
    middle = np.array([[0.25, 0.0, 1.0], [0.25 + travel, 0.0, 1.0]]) @ H.T
    du, dv = np.subtract(*(middle[:, :2] / middle[:, 2:])[::-1])
    length = float(np.hypot(du, dv))
    if length < 0.3:
        return light
    kernel = np.zeros((9, 9), np.float32)
    for t in np.linspace(-0.5, 0.5, 31):
        u, v = 4 + t * du, 4 + t * dv
        i, j = int(np.floor(v)), int(np.floor(u))
        if 0 <= i < 8 and 0 <= j < 8:
            fv, fu = v - i, u - j
            weight = np.outer((1 - fv, fv), (1 - fu, fu))
            kernel[i : i + 2, j : j + 2] += weight
    return cv2.filter2D(light, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REFLECT)


def _glare(light, parts, rng) -> Array:
    """Streaks on the metal, a veil over the picture, and light until enough of it saturates."""
    height, width = parts.shape
    v, u = np.nonzero(parts)
    shine = np.zeros((height, width), np.float32)
    for _ in range(int(rng.integers(4, 16))):
        i = rng.integers(len(v))
        axes = (int(rng.integers(2, 12)), int(rng.integers(1, 4)))
        centre = (int(u[i]), int(v[i]))
        cv2.ellipse(shine, centre, axes, rng.uniform(0, 180), 0, 360, 1.0, -1)
    shine = cv2.GaussianBlur(shine, (0, 0), 1.5) * np.float32(rng.uniform(60, 250))
    light = light + shine[:, :, None] * np.where(parts, 1.0, 0.25).astype(np.float32)[:, :, None]
    brightest = np.sort(light.max(axis=2)[parts])
    share = rng.uniform(*GLARE_SHARE)
    # Until the wanted share of the parts' pixels passes full scale, corners and noise included.
    gain = 262.0 / max(float(brightest[int((1 - share) * (len(brightest) - 1))]), 20.0)
    light = light * np.float32(max(gain, 0.8))
    excess = np.maximum(light - 255.0, 0.0)
    bloom = cv2.GaussianBlur(np.minimum(excess, 400.0), (0, 0), float(rng.uniform(2.0, 7.0)))
    light = light + bloom * np.float32(rng.uniform(0.1, 0.5))
    centre = rng.uniform((0, 0), (width, height))
    grid = np.mgrid[0:height, 0:width].astype(np.float32)
    away = (grid[1] - centre[0]) ** 2 + (grid[0] - centre[1]) ** 2
    veil = np.exp(-away / (2 * rng.uniform(80, 260) ** 2)) * rng.uniform(0, 70)
    return light + veil[:, :, None].astype(np.float32)

"""Centres of a QR code's three finder patterns to a fraction of a pixel.

The decoder gives the corners of the code to about a pixel. Its pattern is known, so the edges of
the three finder squares are measured where they must be: along each side, the place where the
brightness crosses the mean of dark and light. An edge that blur or glare moves outwards does so on
both sides; the centre stays.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array

SQUARE = 7  # modules along a finder pattern
RIM = 3.5  # modules from its centre to its outer edge
REACH = 0.9  # modules to each side of the edge that are sampled
SAMPLES = 19  # along that reach
LINES = np.linspace(-2.8, 2.8, 9)  # modules along the edge, where profiles are taken
CONTRAST = 25.0  # least step of brightness at an edge, of 255
PASSES = 3


def finder_centres(grey: NDArray[np.uint8], corners: Array, modules: int) -> Array | None:
    """Centres of the finder patterns at the upper left, upper right and lower left.

    Args:
        grey: picture. Shape (h, w).
        corners: of the code in pixels: upper left, upper right, lower right, lower left.
            Shape (4, 2).
        modules: along an edge of the code.

    Returns:
        Pixels u, v, shape (3, 2), the centre of a pixel at whole numbers; None if an edge is not
        where it should be.
    """
    drawn = drawn_centres(modules)
    outline = np.array([(0, 0), (modules, 0), (modules, modules), (0, modules)], dtype=np.float32)
    H = np.asarray(cv2.getPerspectiveTransform(outline, corners.astype(np.float32)), dtype=float)
    seen = _to_pixels(H, drawn)
    picture = grey.astype(np.float32)
    for _ in range(PASSES):
        shift = [_measure(picture, H, centre) for centre in drawn]
        if any(s is None for s in shift):
            return None
        seen = _to_pixels(H, drawn + np.array(shift))
        H = _through(H, drawn, seen)
    return seen


def drawn_centres(modules: int) -> Array:
    """Centres of the finder patterns in modules, x right and y down from the corner. (3, 2)."""
    near, far = 0.5 * SQUARE, modules - 0.5 * SQUARE
    return np.array([(near, near), (far, near), (near, far)])


def _measure(picture: NDArray[np.float32], H: Array, centre: Array) -> Array | None:
    """Shift of a finder pattern from where `H` puts it, in modules. Shape (2,)."""
    offsets = np.linspace(-REACH, REACH, SAMPLES)
    shift = np.zeros(2)
    for axis in range(2):
        edges = []
        for side in (-1.0, 1.0):
            points = np.empty((len(LINES), SAMPLES, 2))
            points[..., axis] = centre[axis] + side * (RIM + offsets)  # from dark to light
            points[..., 1 - axis] = centre[1 - axis] + LINES[:, None]
            pixels = _to_pixels(H, points.reshape(-1, 2)).astype(np.float32)
            # Bilinear: wider kernels ring at the edge.
            profile = cv2.remap(
                picture,
                pixels[:, 0].reshape(points.shape[:2]),
                pixels[:, 1].reshape(points.shape[:2]),
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            )
            crossing = _crossing(np.asarray(profile, dtype=np.float32), offsets)
            if crossing is None:
                return None
            edges.append(side * crossing)
        shift[axis] = 0.5 * (edges[0] + edges[1])
    return shift


def _crossing(profiles: NDArray[np.float32], offsets: Array) -> float | None:
    """Median place nearest to 0 at which profiles (k, n) rise through the middle.

    None if half of them show no such edge. The ring inside the edge and the gap outside it are only
    one module wide: what lies beyond them may be at the ends of a profile.
    """
    dark, light = profiles.min(axis=1), profiles.max(axis=1)
    middle = (0.5 * (dark + light))[:, None]
    rising = (profiles[:, :-1] <= middle) & (profiles[:, 1:] > middle)
    clear = (light - dark >= CONTRAST) & rising.any(axis=1)
    if np.sum(clear) <= len(profiles) // 2:
        return None
    k = np.nonzero(clear)[0]
    i = np.argmin(np.where(rising[k], np.abs(offsets[:-1]), np.inf), axis=1)
    a, b = profiles[k, i], profiles[k, i + 1]
    part = (middle[k, 0] - a) / (b - a)
    return float(np.median(offsets[i] + part * (offsets[i + 1] - offsets[i])))


def _through(H: Array, drawn: Array, seen: Array) -> Array:
    """`H` corrected by the affine map, in modules, that takes it through the seen centres."""
    source = _to_modules(H, seen).astype(np.float32)
    A = cv2.getAffineTransform(drawn.astype(np.float32), source)
    return H @ np.vstack([A, [0.0, 0.0, 1.0]])


def _to_pixels(H: Array, points: Array) -> Array:
    p = np.column_stack([points, np.ones(len(points))]) @ H.T
    return p[:, :2] / p[:, 2:]


def _to_modules(H: Array, pixels: Array) -> Array:
    return _to_pixels(np.asarray(np.linalg.inv(H), dtype=float), pixels)

"""Whether a picture is one to look at."""

import numpy as np

DARK, BRIGHT = 3.0, 252.0  # mean grey value beyond which nothing can be seen
FLAT = 1.0  # grey values of spread, below which there is no picture


def fault_of(image, height: int, width: int) -> str | None:
    """Why a picture cannot be used; None if it can.

    Args:
        image: what came; anything.
        height: that it must have, px.
        width: that it must have, px.
    """
    if not isinstance(image, np.ndarray) or image.size == 0:
        return "empty picture"
    if image.shape != (height, width, 3):
        return f"picture of shape {image.shape}, not {(height, width, 3)}"
    if np.issubdtype(image.dtype, np.floating) and not np.isfinite(image).all():
        return "picture with values that are not numbers"
    if image.dtype != np.uint8:
        return f"picture of type {image.dtype}, not uint8"
    samples = image[::4, ::4]
    mean = float(samples.mean())
    if mean < DARK:
        return "black picture"
    if mean > BRIGHT:
        return "white picture"
    if float(samples.std()) < FLAT:
        return "picture of one colour"
    rows = image.reshape(height, -1)
    if not rows[-height // 8 :].any():
        return "truncated picture: its last rows are missing"
    return None

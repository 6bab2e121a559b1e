"""Whether a picture is one to look at."""

import numpy as np

from twin.geometry import Array

DARK = 3.0  # mean grey value below which nothing can be seen
WHITE, LEAST = 240, 0.01  # grey value below which at least this share of a picture must lie
SATURATED = 255
FLAT = 1.0  # grey values of spread, below which there is no picture
# Rows or columns at an edge of which each is its neighbour's very copy, as where a transfer broke
# off and the rest was filled. Not two are so even in pictures without any noise, for the lens
# shades them towards their corners; nor were two in 1000 pictures of glare, half of them without
# noise, up to 75 % saturated. Eight, a camera's smallest block, leave room.
COPIES = 8
GLARE = 96  # likewise where all is saturated, which glare may do: a fifth of the picture's height
OUT_OF_VIEW = "belt not in view"


def hindrance(image, size: tuple[int, int], polygon: Array) -> str | None:
    """Why parts cannot be looked for in a picture; None if they can.

    Args:
        image: what came; anything.
        size: height and width that it must have, px.
        polygon: the window on the belt in the image. Shape (k, 2).
    """
    fault = fault_of(image, *size)
    if fault is None and len(polygon) < 3:
        return OUT_OF_VIEW
    return fault


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
    samples = image[::8, ::8].ravel()
    if float(samples.mean()) < DARK:
        return "black picture"
    if np.count_nonzero(samples < WHITE) < LEAST * samples.size:
        return "white picture"
    if float(samples.std()) < FLAT:
        return "picture of one colour"
    columns = image.swapaxes(0, 1)
    edges = {"top": image, "bottom": image[::-1], "left": columns, "right": columns[::-1]}
    for name, lines in edges.items():
        copies = GLARE if lines[0].min() == SATURATED else COPIES
        if np.array_equal(lines[:copies], lines[1 : copies + 1]):
            return f"truncated picture: its {name} is filled up"
    return None

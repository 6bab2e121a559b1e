"""The part of the belt that the detectors look at."""

import cv2
import numpy as np

from twin.geometry import Array, between2, rot2
from twin.site import Line

X_WINDOW = (0.33, 0.80)  # m in base: beyond, a part is too near to an arm or too small
Y_WINDOW = (0.20, 0.80)
EDGE_MARGIN = 0.004  # m, kept from the belt's edges


def belt_window(line: Line, pose: Array, P: Array, size: tuple[int, int]) -> Array:
    """The belt inside the window, as a polygon in the image; empty where it is not in view.

    Args:
        line: the drawing of the belt.
        pose: of the base in world, (3,).
        P: projection of base coordinates to the image, (3, 4).
        size: height and width of the image, px.

    Returns:
        Corners u, v. Shape (k, 2).
    """
    x, y, yaw = between2(pose, (*line.origin, line.direction))
    half = line.width / 2 - EDGE_MARGIN
    belt = [(0.0, -half), (line.length, -half), (line.length, half), (0.0, half)]
    belt = np.array(belt) @ rot2(float(yaw)).T + np.array([x, y])
    (x0, x1), (y0, y1) = X_WINDOW, Y_WINDOW
    view = np.array([(x0, y0), (x0, y1), (x1, y1), (x1, y0)])
    shape = _intersection(belt, view)
    if len(shape) < 3:
        return shape
    ones = np.ones(len(shape))
    p_base = np.column_stack([shape, line.height * ones, ones])
    uvw = p_base @ P.T
    if (uvw[:, 2] < 0.05).any():
        return np.empty((0, 2))
    height, width = size
    image = np.array([(0, 0), (width - 1, 0), (width - 1, height - 1), (0, height - 1)])
    return _intersection(uvw[:, :2] / uvw[:, 2:], image)


def _intersection(first: Array, second: Array) -> Array:
    """Common part of two convex polygons; empty where they do not meet. Shape (k, 2)."""
    _, shape = cv2.intersectConvexConvex(first.astype(np.float32), second.astype(np.float32))
    return np.empty((0, 2)) if shape is None else np.asarray(shape, float).reshape(-1, 2)

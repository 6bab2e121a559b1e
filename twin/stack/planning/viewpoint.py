"""Where to stand to see ground that was never looked at, before driving over it: some way off,
facing it, on ground that is known."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array
from twin.stack.planning.clearance import Footprint
from twin.stack.planning.costmap import INSCRIBED, LETHAL, Costmap

NARROW = 0.20  # m about the vehicle's middle that must be known: half its width and less


@dataclass(frozen=True)
class ViewOptions:
    """Not tuned, but where a reason is given."""

    # m from the vehicle's middle to what is looked at: the camera, 0.34 m ahead of it, sees the
    # floor from 1.05 m on, and marks it to 2.5 m.
    distances: tuple[float, ...] = (1.6, 1.9, 2.2)
    bearings: int = 24  # tried at each distance
    farthest: float = 3.0  # m from the vehicle: farther off it is not worth the time


def viewpoint(
    costs: Costmap,
    known: NDArray[np.bool_],
    start: Array,
    point: Array,
    footprint: Footprint,
    options: ViewOptions,
) -> Array | None:
    """Nearest pose on known ground, with room to turn, from which the camera sees a point.

    Args:
        costs: of the floor, inflated.
        known: cells that were looked at, or hold what is drawn or seen. Shape (h, w).
        start: x, y (yaw) in world of the vehicle; over known ground it must get there.
        point: to be seen, x, y in world.
        footprint: of the vehicle.
        options: from how far it is looked at.

    Returns:
        x, y, yaw in world; None if there is none near by.
    """
    dark = _grown(~known, footprint.circumscribed / costs.resolution)
    within = _reached(costs, known, start)
    turned = Footprint(2 * footprint.circumscribed, 2 * footprint.circumscribed)
    best, least = None, options.farthest
    for distance in options.distances:
        for bearing in np.linspace(-np.pi, np.pi, options.bearings, endpoint=False):
            ahead = np.array([np.cos(bearing), np.sin(bearing)])
            middle = point - distance * ahead
            away = float(np.hypot(*(middle - start[:2])))
            cell = costs.cell(middle)
            if away >= least or cell is None or dark[cell] or not within[cell]:
                continue
            pose = np.array([*middle, bearing])
            if _in_sight(costs, middle, point) and costs.fits(pose, turned):
                best, least = pose, away
    return best


def over_known(costs: Costmap, known: NDArray[np.bool_], start: Array) -> Costmap:
    """The same floor where what the vehicle does not know is closed, but for where it stands."""
    cells = costs.cells.copy()
    cells[~_reached(costs, known, start) & (cells < INSCRIBED)] = INSCRIBED
    return Costmap(cells, costs.resolution, costs.origin)


def _reached(costs: Costmap, known: NDArray[np.bool_], start: Array) -> NDArray[np.bool_]:
    """Cells that the vehicle's middle can come to over known ground."""
    free = ~_grown(~known, NARROW / costs.resolution) & (costs.cells < INSCRIBED)
    here = costs.cell(start)
    if here is None:
        return np.zeros_like(free)
    size = round(NARROW / costs.resolution)
    i, j = here
    free[max(i - size, 0) : i + size + 1, max(j - size, 0) : j + size + 1] = True  # it stands there
    _, labels = cv2.connectedComponents(free.astype(np.uint8))
    return np.asarray(labels) == labels[here]


def _grown(cells: NDArray[np.bool_], by: float) -> NDArray[np.bool_]:
    """Cells within `by` cells of one that is set."""
    size = 2 * round(by) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return cv2.dilate(cells.astype(np.uint8), disc) > 0


def _in_sight(costs: Costmap, a: Array, b: Array) -> bool:
    steps = max(int(np.hypot(*(b - a)) / (0.5 * costs.resolution)), 1)
    return all(costs.cost(a + t * (b - a)) != LETHAL for t in np.linspace(0.0, 1.0, steps))

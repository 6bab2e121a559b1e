"""Where to stand to see ground that was never looked at, before driving over it.

The lidar misses what is low, and the camera sees the floor only some way ahead. A vehicle that is
to set out over ground beside or behind it, which it never had before it, may run into a low box.
There is a place from which that ground can be seen: some way off, facing it.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array
from twin.stack.planning.clearance import Footprint
from twin.stack.planning.costmap import INSCRIBED, LETHAL, Costmap

NARROW = 0.20  # m about the vehicle's middle that must have been looked at: half its width and less
DEAR = 240  # cost of ground never looked at on the way there: nearly closed


@dataclass(frozen=True)
class ViewOptions:
    """Not tuned, but where a reason is given."""

    begins: float = 0.15  # m of the way in which the vehicle still stands on its own ground
    ends: float = 1.2  # m of the way to be looked at before it sets out
    # m from the vehicle's middle to what is looked at: the camera, 0.34 m ahead of it, sees the
    # floor from 1.05 m on, and marks it to 2.5 m.
    distances: tuple[float, ...] = (1.5, 1.8, 2.2)
    bearings: int = 24  # tried at each distance
    farthest: float = 3.0  # m from the vehicle: farther off it is not worth the time


def unknown_on_way(
    costs: Costmap, known: NDArray[np.bool_], way: Array, options: ViewOptions
) -> Array | None:
    """First point near the beginning of a way about which the ground was never looked at.

    Args:
        costs: of the floor, for its grid.
        known: cells that were looked at, or hold what is drawn or seen. Shape (h, w).
        way: points in world from where the vehicle stands. Shape (n, 2).
        options: how much of it counts.
    """
    if len(way) == 0:
        return None
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way, axis=0).T))])
    dark = _grown(~known, NARROW / costs.resolution)
    for point in way[(s >= options.begins) & (s <= options.ends)]:
        cell = costs.cell(point)
        if cell is not None and dark[cell]:
            return point
    return None


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
        known: as in `unknown_on_way`.
        start: x, y (yaw) in world of the vehicle.
        point: to be seen, x, y in world.
        footprint: of the vehicle.
        options: from how far it is looked at.

    Returns:
        x, y, yaw in world; None if there is none near by.
    """
    dark = _grown(~known, footprint.circumscribed / costs.resolution)
    best, least = None, options.farthest
    for distance in options.distances:
        for bearing in np.linspace(-np.pi, np.pi, options.bearings, endpoint=False):
            ahead = np.array([np.cos(bearing), np.sin(bearing)])
            middle = point - distance * ahead
            away = float(np.hypot(*(middle - start[:2])))
            cell = costs.cell(middle)
            if away >= least or cell is None or costs.cells[cell] >= INSCRIBED or dark[cell]:
                continue
            pose = np.array([*middle, bearing])
            turned = Footprint(2 * footprint.circumscribed, 2 * footprint.circumscribed)
            if _in_sight(costs, middle, point) and costs.fits(pose, turned):
                best, least = pose, away
    return best


def over_known(costs: Costmap, known: NDArray[np.bool_]) -> Costmap:
    """The same floor with what was never looked at next to closed."""
    cells = costs.cells.copy()
    cells[_grown(~known, NARROW / costs.resolution) & (cells < DEAR)] = DEAR
    return Costmap(cells, costs.resolution, costs.origin)


def _grown(cells: NDArray[np.bool_], by: float) -> NDArray[np.bool_]:
    """Cells within `by` cells of one that is set."""
    size = 2 * round(by) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return cv2.dilate(cells.astype(np.uint8), disc) > 0


def _in_sight(costs: Costmap, a: Array, b: Array) -> bool:
    steps = max(int(np.hypot(*(b - a)) / (0.5 * costs.resolution)), 1)
    return all(costs.cost(a + t * (b - a)) != LETHAL for t in np.linspace(0.0, 1.0, steps))

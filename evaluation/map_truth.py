"""True cells of a map: every surface visible from the driven path inside the vehicle's height band.

Definition: from points of the true path, 0.4 m apart, level rays go out at heights
of 0.05 to 1.05 m, 25 mm apart (the band that the vehicle's body takes up, with its margin); the
cells of their first hits, over all heights, are the true occupied cells. Glass and black panels
are surfaces. Level faces (a table's top seen from above) are not met by level rays; their edges
are.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array, rot2
from twin.layout import Layout
from twin.plant.surfaces import visible_cells
from twin.plant.world import World

# m; beside round figures, since a ray along a level face meets it or not by rounding
HEIGHTS = np.arange(0.0525, 1.05, 0.025)
SPACING = 0.40  # m between eyes on the path
AHEAD = 0.30  # m from the base's middle to lidar and depth camera, from where the vehicle looks


@dataclass(frozen=True)
class MapTruth:
    """True cells.

    Attributes:
        surface: cells of visible surfaces. Shape (h, w).
        obstacles: those of each obstacle of the layout. Shape (n, h, w).
        kinds: of the obstacles.
    """

    surface: NDArray[np.bool_]
    obstacles: NDArray[np.bool_]
    kinds: tuple[str, ...]


def map_truth(
    world: World,
    layout: Layout,
    path: Array,
    origin: Array,
    resolution: float,
    shape: tuple[int, int],
) -> MapTruth:
    """True cells of what was visible from a path.

    Args:
        world: the plant's, at the end of the run.
        layout: which obstacles there are.
        path: true x, y, yaw of the base. Shape (n, 3).
        origin, resolution, shape: of the map.
    """
    obstacles = layout.world.faults.obstacles
    surface, own = visible_cells(
        world, eyes(path), HEIGHTS.tolist(), origin, resolution, shape, len(obstacles)
    )
    return MapTruth(surface, own, tuple(o.kind for o in obstacles))


def eyes(path: Array) -> Array:
    """Where the vehicle looked from: points ahead of the base, thinned out. Shape (n, 2)."""
    path = np.asarray(path, dtype=float).reshape(-1, 3)
    ahead = np.array([p[:2] + rot2(p[2]) @ (AHEAD, 0.0) for p in path]).reshape(-1, 2)
    kept: list[NDArray] = []
    for p in ahead:
        if not kept or np.hypot(*(p - kept[-1])) >= SPACING:
            kept.append(p)
    return np.array(kept).reshape(-1, 2)

"""What can be seen of the plant from a path: the truth that maps are scored against.

Level rays go out from eyes on the path at many heights. Their first hits in each layer, seen from
above, are the surface cells: whatever a vehicle of that height could run into, and could have seen.
Glass and black panels are surfaces like any other.
"""

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array
from twin.plant.obstacles import obstacle_name
from twin.plant.sensors.lidar import GROUPS
from twin.plant.world import World

BEAMS = 1080  # rays in a turn: 58 mm apart at 10 m
LONGEST = 30.0  # m


def visible_cells(
    world: World,
    eyes: Array,
    heights: Sequence[float],
    origin: Array,
    resolution: float,
    shape: tuple[int, int],
    obstacles: int = 0,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Cells in which a ray ends.

    Args:
        world: as it stands now; the vehicle is left out, as its geoms are of another group.
        eyes: x, y in world, m. Shape (n, 2).
        heights: of the layers above the floor, m.
        origin: x, y in world of the outer corner of cell [0, 0], m.
        resolution: edge of a cell, m.
        shape: rows and columns.
        obstacles: number of obstacles of the layout, for their own cells.

    Returns:
        All cells, shape (h, w), and those of each obstacle, shape (obstacles, h, w).
    """
    model, data = world.model, world.data
    angles = 2 * np.pi * np.arange(BEAMS) / BEAMS
    directions = np.stack([np.cos(angles), np.sin(angles), np.zeros(BEAMS)], axis=1)
    owner = _owners(model, obstacles)
    seen = np.zeros(shape, dtype=bool)
    own = np.zeros((obstacles, *shape), dtype=bool)
    hit, distance = np.full(BEAMS, -1, dtype=np.int32), np.full(BEAMS, -1.0)
    for x, y in np.asarray(eyes, dtype=float):
        for height in heights:
            eye = np.array([x, y, height])
            mujoco.mj_multiRay(
                model, data, eye, directions.ravel(), GROUPS, True, -1,
                hit, distance, None, BEAMS, LONGEST,
            )  # fmt: skip
            # A hair beyond the face: it belongs to the cell that the thing fills, not to the one
            # before it, where a face lies on the border of two.
            there = hit >= 0
            ends = eye[:2] + (distance[there, None] + 1e-6) * directions[there, :2]
            cells = np.floor((ends - origin) / resolution).astype(int)
            inside = np.all((cells >= 0) & (cells < shape[::-1]), axis=1)
            columns, rows = cells[inside].T
            seen[rows, columns] = True
            of = owner[hit[there][inside]]
            known = of >= 0
            own[of[known], rows[known], columns[known]] = True
    return seen, own


def _owners(model: mujoco.MjModel, obstacles: int) -> NDArray[np.int64]:
    """Number of the obstacle that a geom belongs to, -1 for none. Shape (ngeom,)."""
    owner = np.full(model.ngeom, -1)
    for i in range(obstacles):
        for g in range(model.ngeom):
            if model.geom(g).name.startswith(obstacle_name(i)):
                owner[g] = i
    return owner

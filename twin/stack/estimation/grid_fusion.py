"""One map out of the grids of lidar and depth camera.

Each sensor misses what the other sees: the lidar all that is above or below its plane, the camera
all beside and far ahead of it. The table decides what a cell is, Bayes' rule how sure that is.
"""

import numpy as np
from numpy.typing import NDArray

from twin.stack.estimation.occupancy_grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

EDGE = 1e-3  # log-odds by which a cell's value is kept on the table's side of a threshold


def fuse_states(rgbd: NDArray[np.int8], lidar: NDArray[np.int8]) -> NDArray[np.int8]:
    """Li & An 2025, Table 1: occupied if either says so, else free if either says so.

    Args:
        rgbd: `OCCUPIED`, `FREE` or `UNKNOWN` of each cell, any shape.
        lidar: likewise, same shape.
    """
    free = (rgbd == FREE) | (lidar == FREE)
    occupied = (rgbd == OCCUPIED) | (lidar == OCCUPIED)
    return np.where(occupied, OCCUPIED, np.where(free, FREE, UNKNOWN)).astype(np.int8)


def fuse_probability(rgbd: NDArray[np.floating], lidar: NDArray[np.floating]) -> NDArray:
    """Li & An 2025, Eq. 5: probability of being occupied from two independent ones.

    Certainties that contradict each other (0 and 1) cancel to 0.5.
    """
    both, neither = rgbd * lidar, (1 - rgbd) * (1 - lidar)
    whole = both + neither
    return np.divide(both, whole, out=np.full_like(whole, 0.5), where=whole > 0)


def fuse(rgbd: OccupancyGrid, lidar: OccupancyGrid) -> OccupancyGrid:
    """Fused grid: states by Table 1, probabilities by Eq. 5 as far as the state allows.

    Where the sensors contradict each other, Eq. 5 may fall on the wrong side of a threshold; it is
    then moved to it.

    Raises:
        ValueError: if the grids do not lie on each other.
    """
    same_place = np.allclose(rgbd.origin, lidar.origin, atol=1e-9)
    if rgbd.shape != lidar.shape or not same_place or rgbd.resolution != lidar.resolution:
        raise ValueError(
            f"grids to be fused differ: {rgbd.shape} cells of {rgbd.resolution} m at "
            f"{rgbd.origin} and {lidar.shape} of {lidar.resolution} m at {lidar.origin}"
        )
    states = fuse_states(rgbd.states(), lidar.states())
    each = (grid.probability.astype(float) for grid in (rgbd, lidar))
    p = fuse_probability(*each)
    total = np.log(p / (1 - p))
    high = np.log(lidar.occupied_above / (1 - lidar.occupied_above))
    low = np.log(lidar.free_below / (1 - lidar.free_below))
    total = np.where(states == OCCUPIED, np.maximum(total, high + EDGE), total)
    total = np.where(states == FREE, np.minimum(total, low - EDGE), total)
    total = np.where(states == UNKNOWN, np.clip(total, low + EDGE, high - EDGE), total)
    return OccupancyGrid(
        lidar.origin,
        lidar.resolution,
        total.astype(np.float32),
        lidar.occupied_above,
        lidar.free_below,
    )

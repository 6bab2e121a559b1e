"""The hall and its machines as built: how far each stands off the drawing, drawn by seed.

The stack never sees these; its walls, belt and stations are the drawing's. Finished walls may
depart from a plane by 5 mm over 1 m and 20 mm over 10 m (DIN 18202, Table 3, line 6), so that no
survey says better than some 5 mm where the face of one is. Machines are set on lines marked on the
floor: 3 mm and a milliradian, 1 mm over their length, are class figures, chosen, not measured.
"""

import zlib

import numpy as np

from twin.geometry import Array, compose2
from twin.layout import Tolerances

WALL_YAW = 0.0003  # rad, 1 sigma: 5 mm over the 16 m of the longest wall
MACHINE_YAW = 0.001  # rad, 1 sigma
STREAM = 3  # of the floor's seed that is the hall's


class SiteAsBuilt:
    """Where walls and machines of one hall really stand.

    Each has a stream of its own, so that none moves when another is added to the drawing.

    Args:
        tolerances: the layout's `world.tolerances`.
        floor_seed: of this hall.
    """

    def __init__(self, tolerances: Tolerances, floor_seed: int):
        self._tolerances, self._seed = tolerances, floor_seed

    def wall(self, name: str) -> Array:
        """What is added to the middle x, y and the yaw of a wall or partition. Shape (3,)."""
        return self._off(name, self._tolerances.wall_xy, WALL_YAW)

    def machine(self, name: str, drawn) -> Array:
        """Pose x, y, yaw in world of a machine drawn at `drawn`. Shape (3,)."""
        return compose2(drawn, self._off(name, self._tolerances.machine_xy, MACHINE_YAW))

    def _off(self, name: str, most: float, sigma: float) -> Array:
        rng = np.random.default_rng((self._seed, STREAM, zlib.crc32(name.encode())))
        k = self._tolerances.scale
        return np.array([*(k * rng.uniform(-most, most, 2)), k * sigma * rng.standard_normal()])

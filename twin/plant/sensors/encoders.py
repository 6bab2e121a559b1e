"""Quadrature encoders on the four motor shafts, read by 16-bit hardware counters.

500 lines, all four edges counted (Li & An 2025, section 1.2): 2000 counts a motor turn, 40000 a
wheel turn behind the 20:1 gearbox. The counters are read without delay or noise: they sit in the
control unit's own microcontroller; what they lose is the fraction of a count.
"""

import mujoco
import numpy as np
from numpy.typing import NDArray

COUNTS_PER_WHEEL_TURN = 4 * 500 * 20
WHEELS = ("agv/wheel_fl", "agv/wheel_fr", "agv/wheel_rl", "agv/wheel_rr")


class WheelEncoders:
    """Counters that start at an arbitrary state, as hardware does.

    Args:
        model: the compiled cell.
        rng: draws where within a turn each disc stands at switch-on.
    """

    def __init__(self, model: mujoco.MjModel, rng: np.random.Generator):
        self._qpos = np.array([model.joint(name).qposadr[0] for name in WHEELS])
        self._start = rng.uniform(0, 2**16, 4)

    def counts(self, data: mujoco.MjData) -> NDArray[np.uint16]:
        """State of the four counters now. Shape (4,)."""
        turns = data.qpos[self._qpos] / (2 * np.pi)
        edges = np.floor(self._start + turns * COUNTS_PER_WHEEL_TURN).astype(np.int64)
        return edges.astype(np.uint16)  # wraps

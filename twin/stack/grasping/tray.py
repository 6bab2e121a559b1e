"""Bookkeeping of the tray: which slot each arm fills next."""

import numpy as np

from twin.geometry import Array
from twin.stack.config import StackConfig


class TrayBook:
    """Free slots of the tray, shared out so that working arms keep to their own side.

    With two arms working each fills the slots on its own side of the midplane; an arm that works
    alone may fill all of them.
    """

    def __init__(self, config: StackConfig, arms: int):
        self._slots = config.tray.slots()
        self._free: dict[int, list[int]] = {}
        for arm in range(arms):
            mount = config.T_base_arm[arm][:3, 3]
            side = np.sign(mount[0] - config.midplane)
            own = [
                i
                for i, slot in enumerate(self._slots)
                if arms == 1 or np.sign(slot[0] - config.midplane) == side
            ]
            # Outer column first, from the belt on; then the inner one, one arm from the belt on
            # and the other from the far side, so that two hands are never next to each other.
            rows = -side if arms > 1 else -1.0
            out = {i: abs(self._slots[i][0] - config.midplane) for i in own}
            outer = max(out.values())
            own.sort(
                key=lambda i: (
                    -round(out[i], 3),
                    self._slots[i][1] * (-1.0 if out[i] > outer - 1e-3 else rows),
                )
            )
            self._free[arm] = own

    def free(self, arm: int) -> int:
        """Number of slots that this arm can still fill."""
        return len(self._free[arm])

    def take(self, arm: int) -> Array:
        """Reserve the next slot of an arm; centre of its floor in base, shape (3,).

        Raises:
            IndexError: no slot is left.
        """
        return self._slots[self._free[arm].pop(0)].copy()

    def give_back(self, arm: int, slot: Array) -> None:
        """The part never reached the slot: it is free again, and next in line."""
        self._free[arm].insert(0, int(np.argmin(np.linalg.norm(self._slots - slot, axis=1))))

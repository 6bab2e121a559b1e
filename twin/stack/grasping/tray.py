"""Bookkeeping of the tray: which slot each arm fills next."""

import numpy as np

from twin.geometry import Array, apply
from twin.stack.config import StackConfig

HAND_ROOM = 0.12  # m between the axes of a working and of a parked hand: two palms and 45 mm air


class TrayBook:
    """Free slots of the tray, shared out so that working arms keep to their own side.

    Each arm fills its own side of the midplane: the outer column first, from the belt on; then the
    inner one, the front arm from the belt on and the rear arm from the far side, so that two hands
    are never next to each other. An arm that works alone goes on with the other side, but for the
    slots over which the other hand is parked.
    """

    def __init__(self, config: StackConfig, arms: int):
        self._slots = config.tray.slots()
        centre = config.midplane
        self._free: dict[int, list[int]] = {}
        for arm in range(arms):
            side = np.sign(config.T_base_arm[arm][0, 3] - centre)
            own = [i for i, slot in enumerate(self._slots) if np.sign(slot[0] - centre) == side]
            outer = max(abs(self._slots[i][0] - centre) for i in own)

            def preference(i: int, arm: int = arm, outer: float = outer) -> tuple[float, float]:
                x, y, _ = self._slots[i]
                column = abs(x - centre)
                from_far = arm == 1 and column < outer - 1e-6
                return -round(column, 6), y if from_far else -y

            order = sorted(own, key=preference)
            if arms == 1:
                parked = apply(config.T_base_arm[1 - arm], np.array(config.stow[1 - arm]))
                away = np.hypot(*(self._slots - parked)[:, :2].T) > HAND_ROOM
                others = [i for i in range(len(self._slots)) if i not in own and away[i]]
                order += sorted(others, key=lambda i: tuple(-self._slots[i][:2] * (side, 1.0)))
            self._free[arm] = order

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

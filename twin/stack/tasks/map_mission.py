"""The map order: out of the dock, calibrate the depth camera, then from goal to goal while mapping.

There is no map to drive by: the navigator drives by what the mapper has drawn so far, and may cross
what nobody has seen yet.
"""

from typing import TYPE_CHECKING

import numpy as np

from twin.geometry import compose2
from twin.messages import Goal, MapOrder
from twin.stack.estimation.mapper import Mapper
from twin.stack.tasks.mission import Act, Behaviour, sequence

if TYPE_CHECKING:
    from twin.stack.stack import Stack

CLEAR_OF_DOCK = 1.2  # m ahead of the dock: room to turn on the spot
QUARTERS = 4  # of a turn while calibrating: walls on all sides are seen
MAP_PERIOD = 1.0  # s between maps that are handed to the navigator


def map_mission(stack: "Stack") -> Behaviour:
    """Calibrate, then drive all goals of `stack.order`; one that cannot be reached is left out."""
    assert isinstance(stack.order, MapOrder)
    dock = np.asarray(stack.config.site.dock, dtype=float)
    clear = compose2(dock, (CLEAR_OF_DOCK, 0.0, 0.0))
    turns = [clear + np.array([0.0, 0.0, k * 2 * np.pi / QUARTERS]) for k in range(1, QUARTERS + 1)]
    tour = Tour(stack)
    return sequence(
        "map order",
        stack.straight("leave dock", clear),
        stack.straight("turn to calibrate", *turns),
        Act("calibrate", tour.calibrated, tour.calibrate),
        *[tour.leg(goal) for goal in stack.order.goals],
    )


class Tour:
    """Mapper and navigator while mapping."""

    def __init__(self, stack: "Stack"):
        self._stack = stack
        self.mapper = stack.mapper = Mapper(stack.config)
        self._handed = -np.inf

    def calibrate(self) -> None:
        """Take the camera's pose from the turn, for mapper and obstacle layer."""
        stack, mapper = self._stack, self.mapper
        why = mapper.calibrate()
        stack.navigator.events.append(why or _in_words(mapper))
        stack.navigator.surroundings.set_belief(mapper.belief)
        self._hand_over()

    def calibrated(self) -> bool:
        return True

    def leg(self, goal: Goal) -> Act:
        """To a goal; done however it ends."""
        navigator = self._stack.navigator

        def start() -> None:
            self._hand_over()
            navigator.go(self._stack.now, goal)

        def done() -> bool:
            if self._stack.now >= self._handed + MAP_PERIOD:
                self._hand_over()
            return not navigator.active

        return Act(f"map on the way to {goal.name}", done, start)

    def _hand_over(self) -> None:
        self._handed = self._stack.now
        self._stack.navigator.surroundings.set_map(self.mapper.site_map(), unknown_ok=True)


def _in_words(mapper: Mapper) -> str:
    assert mapper.calibration is not None
    x, y, z = (1e3 * v for v in mapper.calibration.position)
    return (
        f"depth camera found at {x:.0f}, {y:.0f}, {z:.0f} mm in the lidar's frame by "
        f"{mapper.calibration.pairs} pairs"
    )

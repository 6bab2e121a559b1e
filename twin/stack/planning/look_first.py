"""Looks at the ground before it sets out over it.

The lidar misses what is low, and the camera sees the floor only some way ahead: a vehicle that sets
out backwards, sideways or round a corner may run into a low box that it never had before it. It
stops before such ground, drives to where the camera sees it, and goes on. Where there is no such
place, as when it has just been switched on, it goes without, for a short way.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from twin.geometry import Array
from twin.stack.planning.clearance import Footprint
from twin.stack.planning.costmap import INSCRIBED
from twin.stack.planning.surroundings import Surroundings
from twin.stack.planning.teb_trajectory import Trajectory
from twin.stack.planning.viewpoint import ViewOptions, viewpoint


@dataclass(frozen=True)
class LookOptions:
    """Not tuned."""

    soon: float = 2.0  # s of a band within which a vehicle that stands looks at the ground first
    inset: float = 0.04  # m of the vehicle's rim that do not count: cells are coarse
    inset_to_look: float = 0.12  # m on the way to where it looks from
    looks: int = 3  # tries in one place
    most: int = 8  # for one goal
    without: float = 1.5  # m that it goes without having looked
    view: ViewOptions = field(default_factory=ViewOptions)


class LookFirst:
    """For one goal.

    Args:
        surroundings: of the vehicle.
        footprint: of the vehicle.
        say: takes a line about what it does.
        options: how often.
    """

    def __init__(
        self,
        surroundings: Surroundings,
        footprint: Footprint,
        say: Callable[[str], None],
        options: LookOptions | None = None,
    ):
        self.options = options or LookOptions()
        self.views: list[Array] = []  # poses to go to before the goal
        self._surroundings, self._footprint, self._say = surroundings, footprint, say
        self._here = self._total = 0  # looks
        self._without: Array | None = None  # where it began to go without

    def time_left(self, trajectory: Trajectory, phase: float, here: Array, within: float) -> float:
        """Seconds from `phase` on until unknown ground is covered, inf if not within so many."""
        if self._goes_without(here):
            return math.inf
        return self._unknown(trajectory, phase, within)[0]

    def before(self, now: float, trajectory: Trajectory, start: Array) -> bool:
        """Whether a vehicle that stands must not set out by a band, but plan anew.

        It has then either got `views` to look from first, or must do without.
        """
        o = self.options
        if self._goes_without(start):
            return False
        _, point = self._unknown(trajectory, 0.0, o.soon)
        if point is None:
            return False
        at, had = f"({point[0]:.2f}, {point[1]:.2f})", bool(self.views)
        self.views = []
        if not had and self._here < o.looks and self._total < o.most:
            self._here, self._total = self._here + 1, self._total + 1
            around = self._surroundings
            # Not where a cart goes to and fro: it drives there as it is headed, perhaps backwards,
            # where the lidar is blind.
            costs = around.costs_with_lanes(now, INSCRIBED)
            view = viewpoint(costs, around.known, start, point, self._footprint, o.view)
            if view is not None:
                # First there as it is headed now, then turned: there is room to turn.
                self.views = [np.array([*view[:2], start[2]]), view]
                self._say(f"looks at the floor at {at} first")
                return True
        self.give_up(start, at)
        return True

    def give_up(self, start: Array, at: str = "here") -> None:
        """Do without a look for a short way."""
        self.views, self._without, self._here = [], start[:2].copy(), 0
        self._say(f"cannot look at the floor at {at} first")

    def _unknown(
        self, trajectory: Trajectory, phase: float, within: float
    ) -> tuple[float, Array | None]:
        # What lies close beside it where it stands must not keep it from going to look.
        inset = self.options.inset_to_look if self.views else self.options.inset
        return self._surroundings.unknown_ahead(trajectory, phase, within, inset)

    def _goes_without(self, here: Array) -> bool:
        if self._without is None:
            return False
        if np.hypot(*(here[:2] - self._without)) > self.options.without:
            self._without = None
        return self._without is not None

"""The way over the floor to a goal: kept until it is blocked or another is clearly cheaper."""

import math
from dataclasses import dataclass

import numpy as np

from twin.geometry import Array
from twin.stack.planning import astar
from twin.stack.planning.costmap import INSCRIBED, Costmap


@dataclass(frozen=True)
class RouteOptions:
    """Not tuned."""

    period: float = 0.8  # s between looks for a better way
    better: float = 0.85  # of the old way's cost at which a new one is taken
    off: float = 0.6  # m from it at which the vehicle is no longer on it


class Route:
    """One way to one goal.

    Args:
        options: when it is changed.
    """

    def __init__(self, options: RouteOptions | None = None):
        self.options = options or RouteOptions()
        self.xy: Array = np.zeros((0, 2))  # in world, m
        self._due = -math.inf

    def left(self, start: Array) -> Array:
        """The way from the point nearest to the start on; empty off it. Shape (n, 2)."""
        if len(self.xy) == 0:
            return self.xy
        far = np.hypot(*(self.xy - start[:2]).T)
        k = int(np.argmin(far))
        return self.xy[k:] if far[k] < self.options.off else self.xy[:0]

    def length_left(self, start: Array) -> float:
        """Metres of it that lie ahead."""
        return float(np.hypot(*np.diff(self.left(start), axis=0).T).sum())

    def renew(
        self,
        now: float,
        start: Array,
        goal: Array,
        costs: Costmap,
        unknown_ok: bool,
        approach: float = 0.0,
    ) -> tuple[bool, str]:
        """Keep the way or find a new one.

        Args:
            now: s.
            start, goal: x, y (yaw) in world.
            costs: of the floor as it is now.
            unknown_ok: whether unknown cells may be crossed.
            approach: m around the goal within which the map's margin is not asked for.

        Returns:
            Whether the way that there was is blocked; and why there is none now, in one line.
        """
        left = self.left(start)
        blocked = len(left) == 0 or astar.blocked(costs, left, approach=approach)
        if not blocked and now < self._due:
            return False, ""
        self._due = now + self.options.period
        had = len(self.xy) > 0
        try:
            found = astar.plan(costs, start, goal, unknown=unknown_ok, approach=approach).xy
        except astar.NoPath as error:
            if not blocked:
                return False, ""
            self.xy = np.zeros((0, 2))
            return False, str(error)
        if blocked or _cost(costs, found) < self.options.better * _cost(costs, left):
            self.xy = found
        return blocked and had, ""


def _cost(costs: Costmap, xy: Array) -> float:
    """Weighted length of a way, m, as A* counts it."""
    step = np.hypot(*np.diff(xy, axis=0).T)
    most = INSCRIBED - 1
    weight = np.array([1.0 + 3.0 * min(costs.cost(p), most) / most for p in xy[1:]])
    return float(step @ weight)

"""Shortest way over the inflated grid by A* (Li & An 2025, section 2.2 names it).

Eight neighbours; a step costs its length times the weight of the cell that it enters. A diagonal
step needs both cells beside it free, so no corner is cut. The octile distance at the least weight
never overestimates and is consistent: the first time a cell leaves the heap its cost is final.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.geometry import Array
from twin.stack.planning.costmap import INSCRIBED, LETHAL, UNKNOWN, Costmap

DIAGONAL = math.sqrt(2.0)
ESCAPE = 100.0  # weight of an inscribed cell near the start: only ever a way out


class NoPath(ValueError):
    """There is no way. The message is one line."""


@dataclass(frozen=True)
class GridPath:
    """A way from cell to cell.

    Args:
        cells: row and column, start first. Shape (n, 2).
        xy: their centres in world, m; the two ends are the points asked for. Shape (n, 2).
        cost: weighted length in cells.
    """

    cells: NDArray[np.int64]
    xy: Array
    cost: float

    @property
    def length(self) -> float:
        """Metres."""
        return float(np.hypot(*np.diff(self.xy, axis=0).T).sum())


def weights(
    costmap: Costmap, start: tuple[int, int], factor: float, unknown: bool, escape: float
) -> NDArray[np.float64]:
    """Weight of each cell, at least 1; inf where the vehicle's centre must not go. Shape (h, w)."""
    table = 1.0 + factor * np.arange(256) / (INSCRIBED - 1)
    table[INSCRIBED:] = np.inf
    if unknown:
        table[UNKNOWN] = 1.0 + factor
    out = table[costmap.cells]
    # A vehicle that stands nearer to an obstacle than it should must still find its way out.
    k = round(escape / costmap.resolution)
    rows = slice(max(start[0] - k, 0), start[0] + k + 1)
    columns = slice(max(start[1] - k, 0), start[1] + k + 1)
    out[rows, columns][costmap.cells[rows, columns] == INSCRIBED] = ESCAPE
    return out


def plan(
    costmap: Costmap,
    start,
    goal,
    factor: float = 3.0,
    unknown: bool = False,
    escape: float = 0.3,
) -> GridPath:
    """Cheapest way between two points in world.

    Args:
        costmap: inflated grid.
        start: x, y, m.
        goal: x, y, m.
        factor: how much dearer than free ground the costliest passable cell is.
        unknown: whether unknown cells may be crossed.
        escape: m around the start within which inscribed cells may be left.

    Raises:
        NoPath: one line naming what is wrong.
    """
    ends = []
    for name, point in (("start", start), ("goal", goal)):
        at = f"{name} ({point[0]:.2f}, {point[1]:.2f})"
        cell = costmap.cell(point[:2])
        if cell is None:
            raise NoPath(f"{at} lies off the map")
        cost = int(costmap.cells[cell])
        if cost == LETHAL:
            raise NoPath(f"{at} lies inside an obstacle")
        if name == "goal" and cost == INSCRIBED:
            raise NoPath(f"{at} lies too near to an obstacle for the vehicle")
        if name == "goal" and cost == UNKNOWN and not unknown:
            raise NoPath(f"{at} lies on unknown ground")
        ends.append(cell)
    begin, end = ends
    table = weights(costmap, begin, factor, unknown, escape)
    cost, parents = search(table, begin[0], begin[1], end[0], end[1], DIAGONAL)
    if not np.isfinite(cost):
        raise NoPath(
            f"no free way from ({start[0]:.2f}, {start[1]:.2f}) to ({goal[0]:.2f}, {goal[1]:.2f})"
        )
    cells = trace(parents, begin, end, costmap.cells.shape[1])
    xy = costmap.centres(cells)
    xy[0], xy[-1] = start[:2], goal[:2]
    return GridPath(cells, xy, float(cost))


def blocked(costmap: Costmap, xy: Array) -> bool:
    """Whether a way (n, 2) planned earlier now leads through an obstacle, so must be replanned."""
    costs = np.array([costmap.cost(p) for p in xy])
    return bool(np.any((costs == INSCRIBED) | (costs == LETHAL)))


@njit(cache=True)
def search(weight, i0, j0, i1, j1, diagonal):
    """Cost of the cheapest way and each cell's parent (-1: none).

    Parents are flat indices into the map with a border of one cell, as `trace` reads them.

    Args:
        weight: of entering a cell, at least 1; inf is closed. Shape (h, w).
        i0, j0: start.
        i1, j1: goal.
        diagonal: length of a diagonal step in cells.
    """
    # A closed border spares the test for the map's edge; unsigned indices spare numba's for < 0.
    rows, width = weight.shape[0] + 2, weight.shape[1] + 2
    table = np.full(rows * width, np.inf)
    for i in range(1, rows - 1):
        for j in range(1, width - 1):
            table[i * width + j] = weight[i - 1, j - 1]
    start, goal = np.uint32((i0 + 1) * width + j0 + 1), np.uint32((i1 + 1) * width + j1 + 1)
    down = np.array([-1, 1, 0, 0, -1, -1, 1, 1])
    right = np.array([0, 0, -1, 1, -1, 1, -1, 1])
    moves = down * width + right
    # The two cells that a diagonal step passes between, as the numbers of their own moves.
    first, second = np.array([0, 0, 1, 1]), np.array([2, 3, 2, 3])
    closed = np.zeros(4, dtype=np.bool_)
    g = np.full(rows * width, np.inf)
    parent = np.full(rows * width, -1, dtype=np.int32)
    keys, items = np.empty(8192), np.empty(8192, dtype=np.uint32)
    size = _push(keys, items, 0, 0.0, start)
    g[start] = 0.0
    shorter = diagonal - 1.0
    while size > 0:
        here = items[0]
        size = _pop(keys, items, size)
        so_far = g[here]
        if so_far < 0.0:  # settled earlier
            continue
        if here == goal:
            break
        g[here] = -1.0
        if size + 8 > keys.shape[0]:
            keys = np.concatenate((keys, np.empty(keys.shape[0])))
            items = np.concatenate((items, np.empty(items.shape[0], dtype=np.uint32)))
        i = np.int64(here) // width - (i1 + 1)
        j = np.int64(here) % width - (j1 + 1)
        for m in range(8):
            there = np.uint32(here + moves[m])
            cost = table[there]
            if m < 4:
                closed[m] = cost == np.inf
            else:
                if closed[first[m - 4]] or closed[second[m - 4]]:
                    continue
                cost *= diagonal
            total = so_far + cost
            if total < g[there]:
                g[there], parent[there] = total, here
                a, b = abs(i + down[m]), abs(j + right[m])
                guess = max(a, b) + shorter * min(a, b)
                size = _push(keys, items, size, total + guess, there)
    return g[goal], parent


def trace(parents: NDArray[np.int32], start: tuple[int, int], goal: tuple[int, int], width: int):
    """Cells (row, column) from start to goal along the parents. Shape (n, 2)."""
    first, here = ((i + 1) * (width + 2) + j + 1 for i, j in (start, goal))
    flat = [here]
    while here != first:
        here = int(parents[here])
        flat.append(here)
    return np.stack(np.divmod(np.array(flat[::-1], dtype=np.int64), width + 2), axis=1) - 1


@njit(cache=True)
def _push(keys, items, size, key, item):
    """Into a heap of four children a node; returns its new size."""
    k = size
    while k > 0:
        up = (k - 1) >> 2
        if keys[up] < key:  # of equal keys the newest comes first: it is the farthest on
            break
        keys[k], items[k] = keys[up], items[up]
        k = up
    keys[k], items[k] = key, item
    return size + 1


@njit(cache=True)
def _pop(keys, items, size):
    """Drop the least; returns the heap's new size."""
    size -= 1
    key, item = keys[size], items[size]
    k = 0
    while True:
        child = 4 * k + 1
        if child >= size:
            break
        least = child
        for other in range(child + 1, min(child + 4, size)):
            if keys[other] < keys[least]:
                least = other
        if keys[least] >= key:
            break
        keys[k], items[k] = keys[least], items[least]
        k = least
    keys[k], items[k] = key, item
    return size

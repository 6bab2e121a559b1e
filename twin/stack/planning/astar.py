"""Shortest way over the inflated grid by A* (Li & An 2025, section 2.2 names it).

Eight neighbours; a step costs its length times the weight of the cell that it enters. A diagonal
step needs both cells beside it free, so no corner is cut. The octile distance at the least weight
never overestimates and is consistent: from start to goal the estimate of the whole way only grows.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.geometry import Array
from twin.stack.planning.costmap import INSCRIBED, LETHAL, UNKNOWN, Costmap

DIAGONAL = math.sqrt(2.0)
BUCKET = (
    0.02  # cells of estimated cost that share a bucket of the queue: wider ones sort too little
)
DOWN, RIGHT = (-1, 1, 0, 0, -1, -1, 1, 1), (0, 0, -1, 1, -1, 1, -1, 1)  # diagonal steps last
ESCAPE = 100.0  # weight of an inscribed cell near the start: only ever a way out
ESCAPE_REACH = 0.3  # m around the start within which there are any


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
    _open(out, costmap, start, escape)
    return out


def _open(table: NDArray[np.float64], costmap: Costmap, cell: tuple[int, int], by: float) -> None:
    """Let inscribed cells within `by` m of a cell be entered, at a price."""
    k = round(by / costmap.resolution)
    rows = slice(max(cell[0] - k, 0), cell[0] + k + 1)
    columns = slice(max(cell[1] - k, 0), cell[1] + k + 1)
    table[rows, columns][costmap.cells[rows, columns] == INSCRIBED] = ESCAPE


def plan(
    costmap: Costmap,
    start,
    goal,
    factor: float = 3.0,
    unknown: bool = False,
    escape: float = ESCAPE_REACH,
    approach: float = 0.0,
) -> GridPath:
    """Cheapest way between two points in world.

    Args:
        costmap: inflated grid.
        start: x, y, m.
        goal: x, y, m.
        factor: how much dearer than free ground the costliest passable cell is.
        unknown: whether unknown cells may be crossed.
        escape: m around the start within which inscribed cells may be left.
        approach: m around the goal within which they may be entered, where the inflation is wider
            than the vehicle.

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
        if name == "goal" and cost == INSCRIBED and not approach:
            raise NoPath(f"{at} lies too near to an obstacle for the vehicle")
        if name == "goal" and cost == UNKNOWN and not unknown:
            raise NoPath(f"{at} lies on unknown ground")
        ends.append(cell)
    begin, end = ends
    table = weights(costmap, begin, factor, unknown, escape)
    if approach:
        _open(table, costmap, end, approach)
    cost, parents = search(table, begin[0], begin[1], end[0], end[1], DIAGONAL)
    if not np.isfinite(cost):
        raise NoPath(
            f"no free way from ({start[0]:.2f}, {start[1]:.2f}) to ({goal[0]:.2f}, {goal[1]:.2f})"
        )
    cells = trace(parents, begin, end, costmap.cells.shape[1])
    xy = costmap.centres(cells)
    xy[0], xy[-1] = start[:2], goal[:2]
    return GridPath(cells, xy, float(cost))


def blocked(
    costmap: Costmap, xy: Array, escape: float = ESCAPE_REACH, approach: float = 0.0
) -> bool:
    """Whether a way (n, 2) planned earlier now leads through an obstacle, so must be replanned.

    Inscribed cells within `escape` m of its beginning are a way out, and within `approach` m of its
    end a way in, as in `plan`.
    """
    costs = np.array([costmap.cost(p) for p in xy])
    out = np.abs(xy - xy[0]).max(axis=1) <= escape
    into = np.abs(xy - xy[-1]).max(axis=1) < approach
    return bool(np.any(((costs == INSCRIBED) & ~(out | into)) | (costs == LETHAL)))


@njit(cache=True)
def search(weight, i0, j0, i1, j1, diagonal):
    """Cost of the cheapest way and each cell's parent (-1: none).

    The queue is one of buckets (Dial 1969): cells whose estimated cost of the whole way lies within
    `BUCKET` share one, the last in goes out first, and neither takes a comparison. A cell taken out
    of order is put in again when a cheaper way to it is found, and nothing ends before the buckets
    below the goal's cost are empty; so the cost found is the least, to the last bit.

    Parents are flat indices into the map with a border of one cell, as `trace` reads them.

    Args:
        weight: of entering a cell, at least 1; inf is closed. Shape (h, w), below 65535 a side.
        i0, j0: start.
        i1, j1: goal.
        diagonal: length of a diagonal step in cells.
    """
    # A closed border spares the test for the map's edge.
    rows, width = weight.shape[0] + 2, weight.shape[1] + 2
    table, dearest = np.full(rows * width, np.inf), 1.0
    for i in range(1, rows - 1):
        for j in range(1, width - 1):
            entering = weight[i - 1, j - 1]
            table[i * width + j] = entering
            if dearest < entering < np.inf:
                dearest = entering
    g = np.full(rows * width, np.inf)  # cost from the start; negative while settled
    parent = np.full(rows * width, -1, dtype=np.int32)

    # Buckets are used in turn: no step raises the estimate by more than all of them span.
    most = diagonal * (dearest + 2.0)
    bucket = max(BUCKET, most / 2**16)
    turn = 1
    while turn * bucket < most + 2.0 * bucket:
        turn *= 2
    first = np.full(turn, -1, dtype=np.int32)  # entry in each bucket; they are chained by `after`
    after, cells = np.empty(1024, dtype=np.int32), np.empty(1024, dtype=np.uint32)
    unused, size, waiting = -1, 1, 1  # chain of entries to be used again; entries; in buckets

    shorter, goal = diagonal - 1.0, (i1 + 1) * width + j1 + 1
    a, b = abs(i0 - i1), abs(j0 - j1)
    level = np.int64((max(a, b) + shorter * min(a, b)) / bucket)  # the bucket under way
    first[level & (turn - 1)], after[0], cells[0] = 0, -1, (i0 + 1) << 16 | (j0 + 1)
    g[(i0 + 1) * width + j0 + 1] = 0.0
    found = np.inf
    while waiting > 0:
        entry = first[level & (turn - 1)]
        if entry < 0:
            level += 1
            if level * bucket >= found:
                break
            continue
        first[level & (turn - 1)] = after[entry]
        after[entry], unused = unused, entry
        waiting -= 1
        i, j = np.int64(cells[entry] >> 16), np.int64(cells[entry] & 0xFFFF)
        here = i * width + j
        so_far = g[here]
        if so_far < 0.0 or here == goal:
            continue
        g[here] = -so_far
        if size + 8 > len(cells):
            after = np.concatenate((after, np.empty_like(after)))
            cells = np.concatenate((cells, np.empty_like(cells)))
        for m in range(8):
            di, dj = DOWN[m], RIGHT[m]
            there = here + di * width + dj
            cost = table[there]
            if m >= 4:
                if table[here + di * width] == np.inf or table[here + dj] == np.inf:
                    continue
                cost *= diagonal
            total = so_far + cost
            if total >= abs(g[there]):
                continue
            a, b = abs(i + di - i1 - 1), abs(j + dj - j1 - 1)
            estimate = total + max(a, b) + shorter * min(a, b)
            if estimate >= found:
                continue
            g[there], parent[there] = total, here
            if there == goal:
                found = total
                continue
            if unused < 0:
                entry, size = size, size + 1
            else:
                entry, unused = unused, after[unused]
            # rounding must not put it into a bucket that is through
            k = max(np.int64(estimate / bucket), level) & (turn - 1)
            cells[entry] = (i + di) << 16 | (j + dj)
            after[entry], first[k] = first[k], entry
            waiting += 1
    return abs(g[goal]), parent


def trace(parents: NDArray[np.int32], start: tuple[int, int], goal: tuple[int, int], width: int):
    """Cells (row, column) from start to goal along the parents. Shape (n, 2)."""
    first, here = ((i + 1) * (width + 2) + j + 1 for i, j in (start, goal))
    flat = [here]
    while here != first:
        here = int(parents[here])
        flat.append(here)
    return np.stack(np.divmod(np.array(flat[::-1], dtype=np.int64), width + 2), axis=1) - 1

"""Planning: A* on 512 x 512 cells against a peer, and a cycle of the timed elastic band.

    python -m evaluation.benchmarks.planning [--repeats 9] [--worlds 100]

The peer is pyastar2d where it is installed, else the textbook A* in plain Python on a heap; both
must find ways of the same cost. pyastar2d charges a diagonal step like a straight one and cuts
corners, so it is met on its own terms: no closed cells, diagonal length 1.
"""

import argparse
import heapq
import statistics
import time
from typing import Any

import numpy as np

from twin.stack.config import DriveLimits
from twin.stack.planning import astar
from twin.stack.planning.clearance import Footprint, points
from twin.stack.planning.costmap import INSCRIBED, Costmap, inflate
from twin.stack.planning.teb import Teb
from twin.stack.planning.teb_trajectory import least_room

SIZE = 512


def cluttered_map(rng: np.random.Generator) -> Costmap:
    """Inflated grid of 512 x 512 cells of 5 cm with some sixty boxes."""
    states = np.zeros((SIZE, SIZE), dtype=np.int8)
    for _ in range(60):
        (i, j), (h, w) = rng.integers(0, SIZE - 40, 2), rng.integers(3, 40, 2)
        states[i : i + h, j : j + w] = 100
    states[:30, :30] = states[-30:, -30:] = 0
    return inflate(states, 0.05, (0.0, 0.0), Footprint())


def heap_search(weight, start, goal, diagonal: float) -> float:
    """Cost of the cheapest way: A* in plain Python, the same rules as `astar.search`."""
    best, done = {start: 0.0}, set()
    heap = [(0.0, start)]
    h, w, closed = len(weight), len(weight[0]), float("inf")
    while heap:
        _, here = heapq.heappop(heap)
        if here == goal:
            return best[here]
        if here in done:
            continue
        done.add(here)
        i, j = here
        for di in (-1, 0, 1):
            for dj in (-1, 0, 1):
                p, q = i + di, j + dj
                if (di, dj) == (0, 0) or not (0 <= p < h and 0 <= q < w):
                    continue
                cost = weight[p][q]
                if di and dj:
                    if weight[i][q] == closed or weight[p][j] == closed:
                        continue
                    cost *= diagonal
                if cost == closed:
                    continue
                total = best[here] + cost
                if total < best.get((p, q), closed):
                    best[p, q] = total
                    a, b = abs(p - goal[0]), abs(q - goal[1])
                    guess = max(a, b) + (diagonal - 1) * min(a, b)
                    heapq.heappush(heap, (total + guess, (p, q)))
    return closed


def _median(call, repeats: int) -> tuple[float, Any]:
    """Median wall time of a call, s, and its result; the first call is not counted."""
    result, times = call(), []
    for _ in range(repeats):
        start = time.perf_counter()
        result = call()
        times.append(time.perf_counter() - start)
    return statistics.median(times), result


def search_benchmark(repeats: int) -> None:
    """Print the time of A* and its ratio to the peer's, at equal cost."""
    costmap = cluttered_map(np.random.default_rng(0))
    ends = (3, 3), (SIZE - 4, SIZE - 4)
    weight = astar.weights(costmap, ends[0], 3.0, False, 0.0)
    ours, found = _median(lambda: astar.search(weight, *ends[0], *ends[1], astar.DIAGONAL), repeats)
    print(f"A*, {SIZE} x {SIZE}: {1e3 * ours:.1f} ms, cost {found[0]:.3f} cells")
    try:
        import pyastar2d  # pyright: ignore[reportMissingImports]
    except ImportError:
        rows = weight.tolist()
        start = time.perf_counter()
        cost = heap_search(rows, *ends, astar.DIAGONAL)
        theirs = time.perf_counter() - start
        name, ours_again = "plain Python", ours
        equal = abs(cost - found[0]) < 1e-6 * cost
    else:
        open_map = np.where(np.isinf(weight), 50.0, weight).astype(np.float32)
        table = open_map.astype(np.float64)
        ours_again, found = _median(lambda: astar.search(table, *ends[0], *ends[1], 1.0), repeats)
        theirs, way = _median(
            lambda: pyastar2d.astar_path(open_map, *ends, allow_diagonal=True), repeats
        )
        cost = float(table[tuple(np.asarray(way)[1:].T)].sum())
        name, equal = "pyastar2d", abs(cost - found[0]) < 1e-4 * cost
    print(
        f"  {name}: {1e3 * theirs:.1f} ms against {1e3 * ours_again:.1f} ms,"
        f" ratio {theirs / ours_again:.1f}, {'equal' if equal else 'UNEQUAL'} cost"
    )


def band_worlds(rng: np.random.Generator, count: int):
    """Worlds of ten posts over 5 m in which the grid has a way: obstacles and the path."""
    while count:
        posts = points(np.column_stack([rng.uniform(0.9, 4.1, 10), rng.uniform(-2, 2, 10)]), 0.12)
        states = np.zeros((120, 160), dtype=np.int8)
        y, x = np.mgrid[0:120, 0:160] * 0.05 + 0.025 + np.array([-3.0, -1.5])[:, None, None]
        for post in posts:
            states[np.hypot(x - post[0], y - post[1]) < 0.12] = 100
        costmap = inflate(states, 0.05, (-1.5, -3.0), Footprint())
        path = astar.plan(costmap, (0.0, 0.0), (5.0, 0.0))
        if np.all([costmap.cost(p) < INSCRIBED for p in path.xy]):
            count -= 1
            yield posts, path.xy


def band_benchmark(worlds: int) -> None:
    """Print the time of first and following cycles of the band, and how often there is one."""
    footprint = Footprint()
    first, later, reached, rooms, why = [], [], 0, [], {}
    for k, (posts, path) in enumerate(band_worlds(np.random.default_rng(1), worlds + 1)):
        teb = Teb(DriveLimits(), footprint)
        start = time.perf_counter()
        plan = teb.plan(0.0, np.zeros(3), np.zeros(3), path, 0.0, posts)
        spent = time.perf_counter() - start
        if k == 0:
            continue  # compiles
        first.append(spent)
        if plan.trajectory is None:
            word = plan.reason.split(" at ")[0].lstrip("-0123456789. ")
            why[word] = why.get(word, 0) + 1
            continue
        reached += 1
        rooms.append(
            least_room(plan.trajectory.nodes, np.zeros(3), footprint.half, posts, 0.01, 0.02)[0]
        )
        for now in np.arange(0.1, 2.0, 0.1):
            if teb.last is None:
                break
            pose, velocity = teb.last.at(now)
            start = time.perf_counter()
            teb.plan(now, pose, velocity, path, 0.0, posts)
            later.append(time.perf_counter() - start)
    for name, times in (("first", first), ("following", later)):
        ms = 1e3 * np.array(times)
        print(
            f"TEB, 5 m, ten obstacles, {name} cycles: median {np.median(ms):.1f} ms,"
            f" 95 % {np.quantile(ms, 0.95):.1f} ms, n {len(ms)}"
        )
    print(f"  bands found {reached}/{worlds}, least room {min(rooms):.3f} m; none because: {why}")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--worlds", type=int, default=100)
    asked = parser.parse_args()
    search_benchmark(asked.repeats)
    band_benchmark(asked.worlds)


if __name__ == "__main__":
    main()

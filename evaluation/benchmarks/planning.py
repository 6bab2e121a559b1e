"""Planning: A* on 512 x 512 cells against a peer, and a cycle of the timed elastic band.

    python -m evaluation.benchmarks.planning [--repeats 21] [--worlds 100]

The peer is pyastar2d where it is installed, else the textbook A* in plain Python on a heap; both
must find ways of the same cost. pyastar2d charges a diagonal step like a straight one and cuts
corners, so it is met on its own terms: no closed cells, diagonal length 1.
"""

import argparse
import heapq
import statistics
import time
from functools import partial
from typing import Any

import numpy as np

from twin.stack.config import DriveLimits
from twin.stack.planning import astar
from twin.stack.planning.clearance import Footprint, points
from twin.stack.planning.costmap import INSCRIBED, Costmap, inflate
from twin.stack.planning.teb import Teb
from twin.stack.planning.teb_check import least_room

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


def _medians(calls, repeats: int) -> tuple[list[float], list[Any]]:
    """Median wall time of each call, s, and its result.

    The calls take turns, so that whatever else the machine does meets all of them. The first round
    is not counted.
    """
    results, times = [call() for call in calls], [[] for _ in calls]
    for _ in range(repeats):
        for call, spent in zip(calls, times, strict=True):
            start = time.perf_counter()
            call()
            spent.append(time.perf_counter() - start)
    return [statistics.median(t) for t in times], results


def search_benchmark(repeats: int, maps: int = 5) -> dict[str, float]:
    """Print the time of A* and its ratio to a peer's, at equal cost.

    Returns:
        `astar_ms` with our rules, and `astar_ratio`: the peer's time over ours, the median over
        maps of the median over runs.
    """
    peer = _peer()
    plain, own, theirs, ratios = [], [], [], []
    for seed in range(maps):
        costmap = cluttered_map(np.random.default_rng(seed))
        ends = (3, 3), (SIZE - 4, SIZE - 4)
        weight = astar.weights(costmap, ends[0], 3.0, False, 0.0)

        def ours(table, diagonal: float, ends=ends):
            start, goal = ends
            cost, parents = astar.search(table, start[0], start[1], goal[0], goal[1], diagonal)
            astar.trace(parents, start, goal, SIZE)
            return cost

        if peer is None:
            rows = weight.tolist()
            (fast,), (cost,) = _medians([partial(ours, weight, astar.DIAGONAL)], repeats)
            start = time.perf_counter()
            check = heap_search(rows, *ends, astar.DIAGONAL)
            slow, on_its_terms = time.perf_counter() - start, fast
        else:
            opened = np.where(np.isinf(weight), 50.0, weight)
            (fast, on_its_terms, slow), (_, cost, way) = _medians(
                [
                    partial(ours, weight, astar.DIAGONAL),
                    partial(ours, opened, 1.0),
                    partial(peer, opened.astype(np.float32), *ends, allow_diagonal=True),
                ],
                repeats,
            )
            check = float(opened[tuple(np.asarray(way)[1:].T)].sum())
        if abs(check - cost) > 1e-4 * cost:  # the peer reckons in single precision
            raise SystemExit(f"map {seed}: costs differ, {cost:.3f} against the peer's {check:.3f}")
        plain.append(fast)
        own.append(on_its_terms)
        theirs.append(slow)
        ratios.append(slow / on_its_terms)
    ms = [1e3 * statistics.median(t) for t in (plain, own, theirs)]
    print(f"A*, {SIZE} x {SIZE}, {maps} maps, {repeats} runs: {ms[0]:.1f} ms")
    name = "plain Python" if peer is None else "pyastar2d"
    print(
        f"  {name}: {ms[2]:.1f} ms against {ms[1]:.1f} ms"
        f" at equal cost, ratio {statistics.median(ratios):.1f}"
        f" ({min(ratios):.1f} to {max(ratios):.1f})"
    )
    return {"astar_ms": ms[0], "astar_ratio": statistics.median(ratios)}


def _peer():
    """pyastar2d's search where it is installed, else None."""
    try:
        import pyastar2d  # pyright: ignore[reportMissingImports]
    except ImportError:
        return None
    return pyastar2d.astar_path


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
    parser.add_argument("--repeats", type=int, default=21)
    parser.add_argument("--worlds", type=int, default=100)
    asked = parser.parse_args()
    search_benchmark(asked.repeats)
    band_benchmark(asked.worlds)


if __name__ == "__main__":
    main()

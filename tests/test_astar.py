"""A* on the inflated grid, against a search that knows no shortcuts."""

import heapq

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from twin.stack.planning import astar
from twin.stack.planning.clearance import Footprint
from twin.stack.planning.costmap import INSCRIBED, Costmap, inflate

SMALL = Footprint(0.1, 0.1)


def random_map(seed: int, share: float = 0.25, size=(26, 31)) -> Costmap:
    rng = np.random.default_rng(seed)
    cells = rng.integers(0, INSCRIBED, size).astype(np.uint8)
    cells[rng.random(size) < share] = 254
    return Costmap(cells, 0.5, np.array([-3.0, 1.0]))


def dijkstra(weight, start, goal, diagonal=astar.DIAGONAL) -> float:
    """Cheapest way by exhaustive relaxation: every cell, no heuristic."""
    best = np.full(weight.shape, np.inf)
    best[start] = 0.0
    heap = [(0.0, start)]
    while heap:
        cost, (i, j) = heapq.heappop(heap)
        if cost > best[i, j]:
            continue
        for di in (-1, 0, 1):
            for dj in (-1, 0, 1):
                p, q = i + di, j + dj
                if not (0 <= p < weight.shape[0] and 0 <= q < weight.shape[1]):
                    continue
                if np.isinf(weight[i, q]) or np.isinf(weight[p, j]):
                    continue
                total = cost + (diagonal if di and dj else 1.0) * weight[p, q]
                if total < best[p, q]:
                    best[p, q] = total
                    heapq.heappush(heap, (total, (p, q)))
    return best[goal]


def open_ends(costmap, seed):
    free = np.argwhere(costmap.cells < INSCRIBED)
    a, b = np.random.default_rng(seed).choice(len(free), 2, replace=False)
    return tuple(free[a]), tuple(free[b])


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.0, 0.45))
def test_cost_is_the_least_there_is_and_the_path_has_it(seed, share):
    costmap = random_map(seed, share)
    start, goal = open_ends(costmap, seed)
    weight = astar.weights(costmap, start, 3.0, False, 0.0)
    least = dijkstra(weight, start, goal)
    ends = costmap.centres(np.array([start, goal]))
    if np.isinf(least):
        with pytest.raises(astar.NoPath, match="no free way"):
            astar.plan(costmap, *ends, escape=0.0)
        return
    path = astar.plan(costmap, *ends, escape=0.0)
    assert path.cost == pytest.approx(least, rel=1e-9)
    steps = np.diff(path.cells, axis=0)
    assert np.abs(steps).max() == 1 and tuple(path.cells[0]) == start
    entered = weight[tuple(path.cells[1:].T)]
    assert path.cost == pytest.approx(float((np.hypot(*steps.T) * entered).sum()), rel=1e-9)
    for (i, j), (di, dj) in zip(path.cells[:-1], steps, strict=True):  # no corner is cut
        assert weight[i, j + dj] < np.inf and weight[i + di, j] < np.inf


def test_a_diagonal_gap_between_two_corners_is_closed():
    cells = np.zeros((6, 6), dtype=np.uint8)
    cells[2, :3], cells[3, 3:] = 254, 254
    costmap = Costmap(cells, 1.0, np.zeros(2))
    with pytest.raises(astar.NoPath, match="no free way"):
        astar.plan(costmap, (0.5, 0.5), (0.5, 5.5))
    cells[2, 2] = 0  # hand-worked: the gap is now one cell wide and needs a straight step
    path = astar.plan(costmap, (0.5, 0.5), (0.5, 5.5))
    assert path.cost == pytest.approx(3 + 3 * np.sqrt(2))
    assert [2, 2] in path.cells.tolist()


def test_keeps_away_from_walls_where_that_is_cheap():
    states = np.zeros((80, 80), dtype=np.int8)
    states[:40, 38:42] = 100
    costmap = inflate(states, 0.05, (0, 0), Footprint())
    path = astar.plan(costmap, (1.0, 1.0), (3.0, 1.0))
    assert max(costmap.cost(p) for p in path.xy) < 120
    np.testing.assert_allclose(path.xy[[0, -1]], [[1.0, 1.0], [3.0, 1.0]])
    assert path.length > 3.0


@pytest.mark.parametrize(
    ("goal", "words"),
    [
        ((99.0, 1.0), "goal .* lies off the map"),
        ((np.nan, 1.0), "goal .* lies off the map"),
        ((2.0, 1.0), "goal .* lies inside an obstacle"),
        ((2.2, 1.0), "goal .* too near"),
        ((3.9, 3.9), "goal .* unknown ground"),
    ],
)
def test_goals_that_cannot_be_reached_are_refused_in_one_line(goal, words):
    states = np.zeros((80, 80), dtype=np.int8)
    states[:40, 38:42] = 100
    states[75:, 75:] = -1
    costmap = inflate(states, 0.05, (0, 0), Footprint())
    with pytest.raises(astar.NoPath, match=words) as error:
        astar.plan(costmap, (1.0, 1.0), goal)
    assert "\n" not in str(error.value)


def test_unknown_ground_is_crossed_only_when_allowed():
    states = np.zeros((20, 40), dtype=np.int8)
    states[:, 15:20] = -1
    costmap = inflate(states, 0.1, (0, 0), SMALL)
    with pytest.raises(astar.NoPath):
        astar.plan(costmap, (0.5, 1.0), (3.5, 1.0))
    assert astar.plan(costmap, (0.5, 1.0), (3.5, 1.0), unknown=True).length == pytest.approx(
        3.0, 0.1
    )


def test_a_vehicle_too_near_to_a_wall_finds_its_way_out():
    states = np.zeros((80, 80), dtype=np.int8)
    states[:, 0] = 100
    costmap = inflate(states, 0.05, (0, 0), Footprint())
    assert costmap.cost((0.15, 2.0)) == INSCRIBED
    path = astar.plan(costmap, (0.15, 2.0), (3.0, 2.0))
    near = [costmap.cost(p) == INSCRIBED for p in path.xy]
    assert near[0] and sum(near) <= 4


def test_a_way_that_becomes_blocked_is_noticed():
    states = np.zeros((40, 80), dtype=np.int8)
    path = astar.plan(inflate(states, 0.05, (0, 0), Footprint()), (0.5, 1.0), (3.5, 1.0))
    states[20, 40] = 100
    costmap = inflate(states, 0.05, (0, 0), Footprint())
    assert astar.blocked(costmap, path.xy) and not astar.blocked(costmap, path.xy[:20])


def test_a_way_out_of_a_tight_start_is_not_blocked():
    states = np.zeros((60, 80), dtype=np.int8)
    states[:, 0] = 100
    costmap = inflate(states, 0.05, (0, 0), Footprint())
    path = astar.plan(costmap, (0.15, 2.0), (3.0, 2.0))
    assert not astar.blocked(costmap, path.xy)
    assert astar.blocked(costmap, path.xy[::-1])  # but not a way in
    assert not astar.blocked(costmap, path.xy[::-1], approach=0.3)
    back = astar.plan(costmap, (3.0, 2.0), (0.15, 2.0), approach=0.3)
    np.testing.assert_allclose(back.xy[-1], (0.15, 2.0))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.0, 6.0), st.sampled_from([1.0, astar.DIAGONAL]))
def test_cost_is_the_least_however_far_apart_the_weights_lie(seed, decades, diagonal):
    """Weights from 1 to a million: buckets grow with them, the cost stays the least."""
    rng = np.random.default_rng(seed)
    weight = 10.0 ** rng.uniform(0, decades, (23, 19))
    weight[rng.random(weight.shape) < 0.2] = np.inf
    free = np.argwhere(np.isfinite(weight))
    start, goal = (tuple(free[k]) for k in rng.integers(0, len(free), 2))
    cost, parents = astar.search(weight, *start, *goal, diagonal)
    assert cost == pytest.approx(dijkstra(weight, start, goal, diagonal), rel=1e-9)
    if np.isfinite(cost):
        cells = astar.trace(parents, start, goal, weight.shape[1])
        steps = np.where(np.all(np.diff(cells, axis=0), axis=1), diagonal, 1.0)
        assert cost == pytest.approx((weight[tuple(cells[1:].T)] * steps).sum(), rel=1e-9)


def test_a_wide_map_outgrows_the_queue_and_is_searched_all_the_same():
    """Hand-worked: 400 diagonal steps at a weight of 5, of which the estimate knows a fifth."""
    weight = np.full((900, 900), 5.0)
    weight[0, 0] = 1.0
    cost, _ = astar.search(weight, 450, 450, 850, 850, astar.DIAGONAL)
    assert cost == pytest.approx(400 * 5 * np.sqrt(2))

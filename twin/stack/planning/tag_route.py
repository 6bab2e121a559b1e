"""Way from tag to tag over the drawn graph: shortest by length (Dijkstra 1959)."""

import heapq
from collections.abc import Sequence

import numpy as np

from twin.site import Tag


def nearest_tag(tags: Sequence[Tag], position) -> Tag:
    """The tag nearest to x, y in world.

    Raises:
        ValueError: there are no tags.
    """
    if not tags:
        raise ValueError("the drawing has no floor tags")
    return min(tags, key=lambda tag: np.hypot(*np.subtract(tag.pose[:2], position[:2])))


def tag_route(tags: Sequence[Tag], start: str, goal: str) -> list[Tag]:
    """Tags from `start` to `goal`, both included, along `next` (one way, as drawn).

    Raises:
        ValueError: a name is unknown, or no way leads there.
    """
    by_name = {tag.name: tag for tag in tags}
    for name in (start, goal):
        if name not in by_name:
            raise ValueError(f"no tag '{name}' in the drawing")
    before: dict[str, str] = {}
    done: set[str] = set()
    queue = [(0.0, start, "")]
    while queue:
        length, name, via = heapq.heappop(queue)
        if name in done:
            continue
        done.add(name)
        before[name] = via
        if name == goal:
            break
        here = by_name[name]
        for following in here.next:
            if following not in done:
                way = np.hypot(*np.subtract(by_name[following].pose[:2], here.pose[:2]))
                heapq.heappush(queue, (length + float(way), following, name))
    if goal not in before:
        raise ValueError(f"no way leads from tag {start} to tag {goal}")
    names = [goal]
    while names[-1] != start:
        names.append(before[names[-1]])
    return [by_name[name] for name in reversed(names)]

"""Whether the machines of a site fit beside each other, and the vehicle between them.

Sizes are those of models/line and models/station, seen from above; a test holds them together.
"""

import math
from itertools import combinations
from typing import Any

from twin.geometry import compose2, rectangle, rectangles_overlap, swept_rectangles

FOOTPRINT = (0.70, 0.50)  # vehicle, m
# Each part of a machine: centre and size along x and y of its own frame, m.
RAIL = 0.04  # beside the belt: rails, and the hood's walls
HOOD_BEHIND = 0.08  # of the upstream end
BIN = (0.01, 0.37, 0.32)  # from, to past the downstream end; width
MOTOR = (-0.25, -0.07, -0.21, -0.10)  # of the belt, from its downstream end: x, then y on the right
TABLE = (0.0, -0.65, 0.80, 0.50)  # from the receiving pose
POST = (-0.536, 0.0, 0.20, 0.36)  # from the dock
STAND = (0.0, 0.56, 0.60, 0.40)  # from the goods-in pose
RACK = (2.40, 0.60)  # length along x of its own frame, depth
RACK_GAP = 0.36  # m from the vehicle's centre to the front of the rack that it serves
PANEL = 0.04  # thickness of a partition
BELT_LEFT = 0.45  # m from the vehicle's centre to the belt's: what the arms reach best
BELT_AHEAD, BELT_BEHIND = 1.2, 0.7  # m of belt that camera and hood, and the rear arm need

Box = list[tuple[float, float]]


def check_floor_plan(site: Any) -> None:
    """Refuse a `twin.layout.Site` that cannot be built or worked in.

    Raises:
        ValueError: one line naming what is in the way of what.
    """
    (x0, x1), (y0, y1) = site.hall.x, site.hall.y
    if x0 >= x1 or y0 >= y1:
        raise ValueError("hall: each interval must go from low to high")

    def inside(box: Box, over: float = 0.0) -> bool:
        return all(x0 - over < x < x1 + over and y0 - over < y < y1 + over for x, y in box)

    built = machines(site)
    for name, boxes in built.items():
        # partitions end in the outer walls
        over = PANEL if name.startswith("partition") else 0.0
        if not all(inside(box, over) for box in boxes):
            raise ValueError(f"{name}: reaches outside the hall")
    _check_names(site)
    for (first, a), (second, b) in combinations(built.items(), 2):
        if first.startswith("partition") and second.startswith(("partition", "rack")):
            continue  # they may meet
        if second.startswith("partition") and first.startswith("rack"):
            continue
        if _touch(a, b):
            raise ValueError(f"{first} and {second} overlap")
    for name, pose in stops(site).items():
        box = rectangle(*pose, *FOOTPRINT)
        if not inside(box):
            raise ValueError(f"{name}: the vehicle would stand outside the hall")
        for machine, boxes in built.items():
            if _touch([box], boxes):
                raise ValueError(f"{name}: the vehicle would stand in the {machine}")
    for first, second in LEGS:
        a, b = stops(site)[first], stops(site)[second]
        way = list(swept_rectangles(a, b, *FOOTPRINT))
        for machine, boxes in built.items():
            if _touch(way, boxes):
                raise ValueError(
                    f"from {first} to {second} the vehicle would run into the {machine}"
                )
    _check_reach(site)


def machines(site: Any) -> dict[str, list[Box]]:
    """Outlines of everything that stands on the floor, by name."""
    line = site.line
    start, end = (*line.origin, line.direction), line.length
    half = line.width / 2 + RAIL
    dx0, dx1, dy0, dy1 = MOTOR
    belt = [
        placed(start, -HOOD_BEHIND, end, -half, half),
        placed(start, end + BIN[0], end + BIN[1], -BIN[2] / 2, BIN[2] / 2),
        placed(start, end + dx0, end + dx1, dy0 + 0.10 - line.width / 2, dy1),
    ]
    built = {"belt": belt}
    for name, pose, shape in (
        ("receiving table", site.receiving, TABLE),
        ("dock post", site.dock, POST),
        ("goods-in stand", site.goods_in, STAND),
    ):
        if pose is not None:
            built[name] = [centred(pose, *shape)]
    for rack in site.racks:
        built[f"rack {rack.number}"] = [centred(rack.pose, 0.0, 0.0, *RACK)]
    for i, (x0, y0, x1, y1) in enumerate(site.hall.partitions):
        length, yaw = math.hypot(x1 - x0, y1 - y0), math.atan2(y1 - y0, x1 - x0)
        built[f"partition {i}"] = [placed((x0, y0, yaw), 0.0, length, -PANEL / 2, PANEL / 2)]
    return built


def stops(site: Any) -> dict[str, tuple[float, float, float]]:
    """Poses at which the vehicle stops, by name."""
    return _drawn_stops(site) | {place.name: place.pose for place in site.places}


def _drawn_stops(site: Any) -> dict[str, tuple[float, float, float]]:
    """Stations and racks, without the named places."""
    named = {
        "dock": site.dock,
        "pick_approach": site.pick_approach,
        "pick": site.pick,
        "pick_leave": site.pick_leave,
        "receiving": site.receiving,
    }
    if site.goods_in is not None:
        named["goods_in"] = site.goods_in
    return named | {f"rack {r.number}": rack_stop(r.pose) for r in site.racks}


def rack_stop(pose) -> tuple[float, float, float]:
    """Where the vehicle stands to serve a rack: alongside, the rack on its left."""
    x, y, yaw = compose2(pose, (0.0, -(RACK[1] / 2 + RACK_GAP), 0.0))
    return float(x), float(y), float(yaw)


LEGS = (("pick_approach", "pick"), ("pick", "pick_leave"))  # driven straight, without the map


def _check_names(site: Any) -> None:
    """Names are given once, and lead somewhere."""
    numbers = [rack.number for rack in site.racks]
    names = [tag.name for tag in site.tags]
    places = [place.name for place in site.places]
    drawn = _drawn_stops(site)
    for place in places:
        if place in drawn or places.count(place) > 1:
            raise ValueError(f"place '{place}': there is another stop of that name")
    for what, given in (("rack", numbers), ("tag", names)):
        twice = {n for n in given if given.count(n) > 1}
        if twice:
            raise ValueError(f"{what} {min(twice)}: stands there twice")
    for tag in site.tags:
        missing = [n for n in tag.next if n not in names]
        if missing:
            raise ValueError(f"tag {tag.name}: its next tag {missing[0]} does not exist")
        x, y = tag.pose[:2]
        (x0, x1), (y0, y1) = site.hall.x, site.hall.y
        if not (x0 < x < x1 and y0 < y < y1):
            raise ValueError(f"tag {tag.name}: lies outside the hall")


def _check_reach(site: Any) -> None:
    """The vehicle picks off a belt on its left that comes towards it."""
    line, pick = site.line, site.pick
    dx, dy = line.origin[0] - pick[0], line.origin[1] - pick[1]
    c, s = math.cos(pick[2]), math.sin(pick[2])
    ahead, left = c * dx + s * dy, -s * dx + c * dy
    turn = math.remainder(line.direction - pick[2] - math.pi, 2 * math.pi)
    if abs(turn) > math.radians(1.0):
        raise ValueError("pick: the belt must run against the vehicle's heading (yaw + pi)")
    if abs(left - BELT_LEFT) > 0.02:
        raise ValueError(
            f"pick: the belt's centre line must run {BELT_LEFT} m to the left of the vehicle,"
            f" give or take 0.02 (it runs {left:.2f} m to the left)"
        )
    if ahead < BELT_AHEAD or line.length - ahead < BELT_BEHIND:
        raise ValueError(
            f"pick: the belt must reach {BELT_AHEAD} m ahead of the vehicle and {BELT_BEHIND} m"
            f" behind (it reaches {ahead:.2f} and {line.length - ahead:.2f} m)"
        )


def centred(pose, x: float, y: float, length: float, width: float) -> Box:
    """A box by the middle and size along x and y that it has in the frame at `pose`, in world."""
    return placed(pose, x - length / 2, x + length / 2, y - width / 2, y + width / 2)


def placed(pose, x0: float, x1: float, y0: float, y1: float) -> Box:
    """A box given in the frame at `pose`, in world."""
    x, y, yaw = compose2(pose, ((x0 + x1) / 2, (y0 + y1) / 2, 0.0))
    return rectangle(x, y, yaw, x1 - x0, y1 - y0)


def _touch(first: list[Box], second: list[Box]) -> bool:
    return any(rectangles_overlap(a, b) for a in first for b in second)

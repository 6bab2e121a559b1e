"""Whether what is to go wrong can be built: refuses faults inside machines or outside the hall."""

from itertools import pairwise

from twin.floor_plan import FOOTPRINT, machines
from twin.geometry import rectangle, rectangles_overlap, swept_rectangles
from twin.layout import Layout, LayoutError
from twin.plant.obstacles import MOVER_OUTLINE, OUTLINE, is_late, mover_start


def check_faults(layout: Layout) -> None:
    """Refuse faults that cannot come about.

    An obstacle from the start may stand against a machine, but not in the vehicle at its dock.
    Late obstacles, movers and a carried vehicle need a free place.

    Raises:
        LayoutError: one line naming what is in the way of what.
    """
    site, faults = layout.site, layout.world.faults
    built = machines(site)
    dock = {"vehicle at its dock": [rectangle(*site.dock, *FOOTPRINT)]}
    for i, obstacle in enumerate(faults.obstacles):
        box = rectangle(*obstacle.pose, *OUTLINE[obstacle.kind])
        _check(layout, f"obstacles.{i}", [box], built if is_late(obstacle) else dock)
    for i, mover in enumerate(faults.movers):
        yaw = mover_start(mover)[2]
        for a, b in pairwise(mover.path):
            if a == b:
                raise LayoutError(f"world.faults.movers.{i}: path: a point stands there twice")
            way = swept_rectangles((*a, yaw), (*b, yaw), *MOVER_OUTLINE)
            _check(layout, f"movers.{i}", list(way), built)
    for i, kidnap in enumerate(faults.kidnaps):
        _check(layout, f"kidnaps.{i}", [rectangle(*kidnap.pose, *FOOTPRINT)], built)


def _check(layout: Layout, name: str, boxes, taken) -> None:
    (x0, x1), (y0, y1) = layout.site.hall.x, layout.site.hall.y
    if not all(x0 < x < x1 and y0 < y < y1 for box in boxes for x, y in box):
        raise LayoutError(f"world.faults.{name}: reaches outside the hall")
    for what, others in taken.items():
        if any(rectangles_overlap(a, b) for a in boxes for b in others):
            raise LayoutError(f"world.faults.{name}: overlaps the {what}")

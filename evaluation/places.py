"""Whether a scenario that is drawn for one hall can take place in another; refused if not.

A pose is x, y, yaw in world.
"""

from collections.abc import Iterable
from itertools import pairwise

from twin.floor_plan import FOOTPRINT, Box, machines
from twin.geometry import rectangle, rectangles_overlap, swept_rectangles
from twin.layout import LayoutError
from twin.site import Pose2, Site


def check_places(scenario: str, site: Site, places: Iterable[tuple[str, Pose2]]) -> None:
    """Refuse a drawing in which the vehicle cannot stand at all named poses.

    Raises:
        LayoutError: one line naming the place and what is in its way.
    """
    for name, pose in places:
        if why := _in_the_way(site, [rectangle(*pose, *FOOTPRINT)]):
            x, y, _ = pose
            raise LayoutError(
                f"{scenario}: its route is drawn for another hall: at {name} ({x:.2f}, {y:.2f})"
                f" the vehicle would {why}"
            )


def check_way(scenario: str, site: Site, route: Iterable[Pose2]) -> None:
    """Refuse a drawing in which something stands on the straight legs between poses.

    Raises:
        LayoutError: one line naming the leg and what is in its way.
    """
    for a, b in pairwise(route):
        if why := _in_the_way(site, list(swept_rectangles(a, b, *FOOTPRINT))):
            raise LayoutError(
                f"{scenario}: its course is drawn for another hall: from ({a[0]:.2f}, {a[1]:.2f})"
                f" to ({b[0]:.2f}, {b[1]:.2f}) the vehicle would {why}"
            )


def _in_the_way(site: Site, boxes: list[Box]) -> str:
    """What the vehicle would do in these boxes; empty if they are free."""
    (x0, x1), (y0, y1) = site.hall.x, site.hall.y
    if not all(x0 < x < x1 and y0 < y < y1 for box in boxes for x, y in box):
        return "stand outside the hall"
    for machine, others in machines(site).items():
        if any(rectangles_overlap(a, b) for a in boxes for b in others):
            return f"stand in the {machine}"
    return ""

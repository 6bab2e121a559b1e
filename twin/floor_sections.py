"""What a horizontal cut finds of the machines: the legs, posts and boxes that a lidar meets.

Beside the outlines of `twin.floor_plan`, which hold for the whole height of a vehicle. Sizes are
those of models/line, models/station and models/warehouse; a test casts rays in the compiled model
against them.
"""

from typing import Any

from twin.floor_plan import BIN, POST, RACK, TABLE, Box, centred, machines, placed

LEG = 0.04  # edge of a leg of belt, table and stand, m
# Where the legs stand: from the ends of the belt along it, from the edges of table and stand.
BELT_LEG, BELT_LEG_OUT = 0.25, 0.005
BIN_STAND = (0.02, 0.36, 0.30)  # under the bin: as BIN
TABLE_LEG = 0.04  # middle of a leg from the table's edge
RACK_POST = 0.06  # edge of a post of a rack, m; at both ends and the middle, front and back
# Below these heights a machine stands on legs or posts, m.
BELT_LEGS, BIN_STANDS, TABLE_LEGS, RACK_POSTS = 0.60, 0.20, 0.52, 0.30
POST_SOLID = (-0.54, 0.0, 0.16, 0.36)  # the dock's post without its contacts, as POST
POST_CONTACTS = (0.07, 0.13)  # heights between which the contacts stand out, m


def sections(site: Any, height: float) -> dict[str, list[Box]]:
    """Boxes in world that a cut at `height` above the floor finds, by name of the machine.

    Above the heights up to which legs are known a machine is its whole outline.
    """
    cut = machines(site)
    line = site.line
    if height < BELT_LEGS:
        start, end = (*line.origin, line.direction), line.length
        side = line.width / 2 + BELT_LEG_OUT
        x0, x1, width = BIN_STAND if height < BIN_STANDS else BIN
        cut["belt"] = [
            *_grid(start, (BELT_LEG, end - BELT_LEG), (-side, side), LEG),
            placed(start, end + x0, end + x1, -width / 2, width / 2),
        ]
    if height < TABLE_LEGS:
        cut["receiving table"] = _legs(site.receiving, TABLE)
    if not POST_CONTACTS[0] <= height <= POST_CONTACTS[1]:
        cut["dock post"] = [centred(site.dock, *POST_SOLID)]
    else:
        cut["dock post"] = [centred(site.dock, *POST)]
    if height < RACK_POSTS:
        x, y = (RACK[0] - RACK_POST) / 2, (RACK[1] - RACK_POST) / 2
        for rack in site.racks:
            cut[f"rack {rack.number}"] = _grid(rack.pose, (-x, 0.0, x), (-y, y), RACK_POST)
    return cut


def _legs(pose, shape) -> list[Box]:
    """Legs at the corners of a table: centre and size along x and y in the frame at `pose`."""
    x, y, length, width = shape
    dx, dy = length / 2 - TABLE_LEG, width / 2 - TABLE_LEG
    return _grid(pose, (x - dx, x + dx), (y - dy, y + dy), LEG)


def _grid(pose, xs, ys, side: float) -> list[Box]:
    return [centred(pose, x, y, side, side) for x in xs for y in ys]

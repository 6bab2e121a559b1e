"""The surveyed drawing of the plant: what stands where. Plant and stack both know it.

Poses are x, y, yaw in world (x east, y north), metres and radians. Sizes of machines stand in
`twin.floor_plan`.
"""

import math
from itertools import combinations
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, model_validator

from twin.floor_plan import check_floor_plan

Coordinate = Annotated[float, Field(ge=-1000, le=1000, allow_inf_nan=False)]  # m
Angle = Annotated[float, Field(ge=-7, le=7, allow_inf_nan=False)]  # rad
Position2 = tuple[Coordinate, Coordinate]
Position3 = tuple[Coordinate, Coordinate, Coordinate]
Pose2 = tuple[Coordinate, Coordinate, Angle]  # x, y, yaw
Segment = tuple[Coordinate, Coordinate, Coordinate, Coordinate]  # x0, y0, x1, y1
Interval = tuple[Coordinate, Coordinate]
Name = Annotated[str, Field(pattern="^[A-Z0-9]{1,8}$")]


class Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Line(Strict):
    """The belt as drawn."""

    origin: Position2
    direction: Angle
    length: Annotated[float, Field(ge=1.5, le=4.0)]
    width: Annotated[float, Field(ge=0.12, le=0.30)]
    height: Annotated[float, Field(ge=0.66, le=0.74)]


class Hall(Strict):
    """Inner faces of the outer walls, and partitions inside."""

    x: Interval
    y: Interval
    partitions: tuple[Segment, ...] = ()


class Rack(Strict):
    """A rack of the warehouse: a number on its goods' codes, and the pose of its middle."""

    number: Annotated[int, Field(ge=1, le=999)]
    pose: Pose2


class Tag(Strict):
    """A floor tag: the name in its code, its pose, and the tags that can be driven to from it."""

    name: Name
    pose: Pose2
    next: tuple[Name, ...] = ()


class Place(Strict):
    """A pose that the vehicle may be sent to by name."""

    name: Annotated[str, Field(pattern="^[a-z][a-z0-9_ ]{0,30}$")]
    pose: Pose2


# Of the photoelectric network: nodes that the head's calibration wants (Liu et al. 2022, Eq. 32), a
# node's housing (m), and how far off the line of the outermost two one must be, of its length.
LEAST_NODES, NODE_SIZE, LEAST_WIDTH = 5, 0.05, 0.02


class BeaconNode(Strict):
    """A photodiode of the photoelectric network: where it was measured, and where it looks."""

    name: Name
    position: Position3
    facing: Angle  # yaw of its axis, which is level


class BeaconNetwork(Strict):
    """The photoelectric network (Liu et al. 2022): nodes on a truss, as a laser tracker saw them.

    The tracker's error along each axis is 18 um + 3 um/m of the distance from it (FARO, by Liu et
    al. 2022, section 3.1); taken as one standard deviation.
    """

    nodes: Annotated[tuple[BeaconNode, ...], Field(max_length=32)]
    tracker: Position3
    spin_rate: Annotated[float, Field(ge=20.0, le=50.0)] = 30.0  # turns of the head a second

    def survey_sigma(self, node: BeaconNode) -> float:
        """Standard deviation of a node's surveyed position along each axis, m."""
        return 18e-6 + 3e-6 * math.dist(node.position, self.tracker)

    @model_validator(mode="after")
    def _names_are_given_once(self):
        names = [node.name for node in self.nodes]
        twice = {n for n in names if names.count(n) > 1}
        if twice:
            raise ValueError(f"node {min(twice)}: stands there twice")
        return self

    @model_validator(mode="after")
    def _places_can_tell_a_pose(self):
        if len(self.nodes) < LEAST_NODES:
            raise ValueError(f"{len(self.nodes)} nodes; the head's calibration wants {LEAST_NODES}")
        pairs = [(math.dist(a.position, b.position), a, b) for a, b in combinations(self.nodes, 2)]
        nearest, a, b = min(pairs, key=lambda pair: pair[0])
        if nearest < NODE_SIZE:
            raise ValueError(f"nodes {a.name} and {b.name}: closer than {NODE_SIZE} m")
        longest, a, b = max(pairs, key=lambda pair: pair[0])
        off = [_twice_area(a.position, b.position, n.position) / longest for n in self.nodes]
        if max(off) < LEAST_WIDTH * longest:
            raise ValueError("the nodes stand on a line; at least one must stand well off it")
        return self


def _twice_area(a: Position3, b: Position3, c: Position3) -> float:
    """Of a triangle, m^2."""
    ab, ac, bc = math.dist(a, b), math.dist(a, c), math.dist(b, c)
    s = 0.5 * (ab + ac + bc)  # Heron
    return 2.0 * math.sqrt(max(s * (s - ab) * (s - ac) * (s - bc), 0.0))


class Site(Strict):
    """The surveyed drawing, known to plant and stack."""

    dock: Pose2
    pick: Pose2
    pick_approach: Pose2  # from here straight in to `pick`
    pick_leave: Pose2  # and straight out to here
    receiving: Pose2
    goods_in: Pose2 | None = None  # where the vehicle stands at the goods-in stand, on its left
    line: Line
    hall: Hall
    racks: tuple[Rack, ...] = ()
    tags: tuple[Tag, ...] = ()
    places: tuple[Place, ...] = ()  # besides stations and racks
    beacons: BeaconNetwork | None = None

    @model_validator(mode="after")
    def _can_be_built(self):
        check_floor_plan(self)
        return self

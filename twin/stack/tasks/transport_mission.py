"""Transport order: fetch the parcel at goods-in and bring it to the rack that its code names.

By map to goods-in, a little short of it, where the mast camera sees the stand, to read the goods
code; then straight in, and the front arm loads the parcel into the tray. From floor tag to floor
tag to the rack, each tag a goal of the navigator, which finds its own way round what stands
between; there it is unloaded.
"""

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from py_trees.common import Status

from twin.floor_plan import FOOTPRINT, rack_stop
from twin.geometry import Array, between2, compose2, wrap_angle
from twin.messages import CameraFrame, Goal
from twin.site import Tag
from twin.stack.detection.goods import GoodsReader, GoodsSight
from twin.stack.grasping.tray import TrayBook
from twin.stack.planning.tag_route import nearest_tag, tag_route
from twin.stack.tasks.mission import Act, Behaviour, sequence
from twin.stack.tasks.porter import Place, Porter

if TYPE_CHECKING:
    from twin.stack.stack import Stack

LOOK_BACK = 0.28  # m behind goods-in: there the camera sees the parcel's place best
SIGHTS = 5  # readings of the goods code that are averaged
AGREE = 0.003  # m within which they must lie of each other
PATIENCE = 5.0  # s for them, standing
ARM = 0  # the front arm carries
BEND = 0.35  # rad by which the way may bend without a turn on the spot before it
ARRIVED = 0.5  # m: a route starts at the tag that the vehicle stands on, if it stands on one


def transport_mission(stack: "Stack") -> Behaviour:
    """The whole order as a tree; it fails with the first thing that cannot be done."""
    goods_in = stack.config.site.goods_in
    job = Transport(stack)
    if goods_in is None:
        return Act("no goods-in", lambda: False, failed=job.no_goods_in)
    x, y, yaw = (float(v) for v in compose2(goods_in, (-LOOK_BACK, 0.0, 0.0)))
    return sequence(
        "transport",
        stack.go(Goal("goods in", (x, y, yaw))),
        Act("read goods code", job.read, job.look, job.unread),
        stack.straight("to the parcel", goods_in),
        Act("load", job.carried, job.load, job.dropped),
        TagDrive("drive tag to tag", job),
        stack.leg("dock at rack", lambda: (job.rack_stop(),)),
        Act("unload", job.carried, job.unload, job.dropped),
    )


class Transport:
    """What is known of the parcel, and what the arm is told."""

    def __init__(self, stack: "Stack"):
        self.stack, self.config = stack, stack.config
        self._reader = GoodsReader(stack.config)
        self._porter = Porter(stack.arms[ARM])
        self._sights: list[GoodsSight] = []
        self._p_odom: list[Array] = []  # of the parcel in the fused odometry, by each of them
        self._since = 0.0
        self._slot = Place((0.0, 0.0, 0.0), 0.0)
        self.rack = 0
        self._hints: dict[str, tuple[str, ...]] = {}  # of tags that were read

    def say(self, text: str) -> None:
        self.stack.arms[ARM].events.append(text)

    def no_goods_in(self) -> bool:
        self.say("transport: the drawing has no goods-in")
        return True

    # --- the goods code --------------------------------------------------------------------------

    def look(self) -> None:
        self._since = self.stack.now
        self.stack.on_picture = self._hear

    def _hear(self, frame: CameraFrame) -> None:
        x, y, _ = self.config.parcel_place
        sight = self._reader.read(frame, np.array([x + LOOK_BACK, y]))
        at = self.stack.localiser.fused.history.at(frame.stamp)
        if sight is None or at is None:
            return
        if self._sights and sight.rack != self._sights[-1].rack:
            self._sights.clear()
            self._p_odom.clear()
        self._sights.append(sight)
        self._p_odom.append(compose2(at, sight.pose))

    def read(self) -> bool:
        """Enough sights that agree, of a rack that there is."""
        last = np.array(self._p_odom[-SIGHTS:])
        if len(last) < SIGHTS or np.any(np.ptp(last[:, :2], axis=0) > AGREE):
            return False
        self.rack = self._sights[-1].rack
        if self.rack not in [rack.number for rack in self.config.site.racks]:
            return False
        self.stack.on_picture = None
        self.say(f"goods code read: rack {self.rack}")
        return True

    def unread(self) -> bool:
        if self.stack.now - self._since < PATIENCE:
            return False
        self.stack.on_picture = None
        if self.rack:
            self.say(f"transport: the goods code names rack {self.rack}, which is not there")
        else:
            self.say(f"transport: no goods code read ({self._reader.refused or 'no picture'})")
        return True

    # --- the parcel ------------------------------------------------------------------------------

    def load(self) -> None:
        """From where it was seen, carried along by dead reckoning, into a free tray slot."""
        seen = np.array(self._p_odom[-SIGHTS:])
        yaw = seen[-1, 2] + np.mean(wrap_angle(seen[:, 2] - seen[-1, 2]))
        p_odom = np.array([*seen[:, :2].mean(axis=0), yaw])
        x, y, yaw = between2(self.stack.localiser.fused.pose(self.stack.now), p_odom)
        slot = TrayBook(self.config, 2).take(ARM)
        self._slot = Place((float(slot[0]), float(slot[1]), float(slot[2])), np.pi / 2)
        source = Place((float(x), float(y), self.config.stand_height), float(yaw))
        self._porter.start(self.stack.now, source, self._slot)

    def unload(self) -> None:
        """From the tray to its place on the rack, as the vehicle believes to stand."""
        place = compose2(self.rack_stop(), self.config.parcel_place)
        x, y, yaw = between2(self.stack.pose, place)
        goal = Place((float(x), float(y), self.config.stand_height), float(yaw) + np.pi / 2)
        self._porter.start(self.stack.now, self._slot, goal)

    def carried(self) -> bool:
        self._porter.step(self.stack.now)
        return self._porter.idle and not self._porter.failure

    def dropped(self) -> bool:
        return self._porter.idle and bool(self._porter.failure)

    # --- the way ---------------------------------------------------------------------------------

    def rack_stop(self) -> tuple[float, float, float]:
        """Pose of the vehicle at the rack that the code names."""
        rack = next(r for r in self.config.site.racks if r.number == self.rack)
        return rack_stop(rack.pose)

    def read_tags(self) -> None:
        """Note the route hints of the tags that were just read and believed."""
        known = {tag.name for tag in self.config.site.tags}
        for sight in self.stack.localiser.sights:
            if sight.action != "refused" and sight.tag in known:
                self._hints[sight.tag] = tuple(n for n in sight.next_nodes if n in known)

    def tags(self) -> tuple[Tag, ...]:
        """Those of the drawing; where one was read, ways lead on from it as it says itself."""
        hints = self._hints
        return tuple(
            tag.model_copy(update={"next": hints.get(tag.name, tag.next)})
            for tag in self.config.site.tags
        )

    def route(self) -> list[Tag]:
        """Tags from here to the one at the rack."""
        tags = self.tags()
        start, goal = (nearest_tag(tags, p) for p in (self.stack.pose, self.rack_stop()))
        way = tag_route(tags, start.name, goal.name)
        here = np.hypot(*np.subtract(start.pose[:2], self.stack.pose[:2])) < ARRIVED
        return way[1:] if here and len(way) > 1 else way


def goals_along(pose: Array, route: list[Tag]) -> list[Goal]:
    """A goal at each tag, and a turn on the spot where the way bends.

    The depth camera looks ahead alone, and what is low the lidar does not see: so the vehicle faces
    the way that it drives. Only a step shorter than itself is made sideways, in the tag's heading.

    Args:
        pose: x, y, yaw in world where it stands.
        route: tags to drive to, in order.
    """
    goals: list[Goal] = []
    x, y, yaw, name = *(float(v) for v in pose), "start"
    for tag in route:
        dx, dy = tag.pose[0] - x, tag.pose[1] - y
        if np.hypot(dx, dy) < FOOTPRINT[0]:
            heading = tag.pose[2]
        else:
            heading = float(np.arctan2(dy, dx))
            if abs(wrap_angle(heading - yaw)) > BEND:
                goals.append(Goal(f"turn at {name}", (x, y, heading)))
        x, y, yaw, name = tag.pose[0], tag.pose[1], heading, f"tag {tag.name}"
        goals.append(Goal(name, (x, y, yaw)))
    return goals


class TagDrive(Behaviour):
    """Drives from tag to tag; one on the way that cannot be reached is left out.

    The way is that of the drawing until a tag that is driven over says that none leads on there.
    """

    def __init__(self, name: str, job: Transport):
        super().__init__(name)
        self._job = job
        self._left: list[Goal] = []
        self._route: list[Tag] = []
        self._last = True  # whether the tag under way is the route's last
        self._lost_way = False

    def initialise(self) -> None:
        self._plan()

    def _plan(self) -> None:
        self._last = self._lost_way = False
        try:
            self._route = self._job.route()
            self._job.say(f"from tag to tag: {' '.join(tag.name for tag in self._route)}")
            self._left = goals_along(self._job.stack.pose, self._route)
        except ValueError as error:
            self._job.say(f"transport: {error}")
            self._lost_way = True

    def _leads_on(self) -> bool:
        """Whether the way from tag to tag is one by all that has been read."""
        leads = {tag.name: tag.next for tag in self._job.tags()}
        return all(b.name in leads[a.name] for a, b in pairwise(self._route))

    def update(self) -> Status:
        stack = self._job.stack
        self._job.read_tags()
        if self._lost_way:
            return Status.FAILURE
        if stack.navigator.active:
            return Status.RUNNING
        if not self._last and not self._leads_on():
            self._job.say("a tag says that no way leads on as drawn")
            self._plan()
            return Status.FAILURE if self._lost_way else Status.RUNNING
        if self._last:
            reached = stack.navigator.outcome == "reached"
            return Status.SUCCESS if reached else Status.FAILURE
        goal = self._left.pop(0)
        self._last = not self._left
        stack.navigator.go(stack.now, goal)
        return Status.RUNNING

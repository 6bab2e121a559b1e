"""Puts parts on the belt under the hood, upstream and out of sight, and recycles the bin.

A bowl feeder presents each part in one resting pose (models/connectors/README.md) with any yaw.
This and the faults are the only places of the plant that write the state of a part. The feeder
writes a part only while it waits in the store or lies in the bin, and logs each write.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from twin.geometry import rot2
from twin.layout import Layout
from twin.messages import PART_CLASSES, PartClass
from twin.plant.world import World

DROP_POINT = 0.10  # m from the upstream end of the belt: inside the hood
BIN_DEPTH = 0.05  # m below the belt's face: a part lower than this, past the end, is in the bin
BIN_LENGTH = 0.45  # m past the end of the belt
AT_REST = 0.05  # m/s
CHECK_PERIOD = 0.05  # s between looks at the bin

Source = Literal["store", "bin", "belt"]


@dataclass(frozen=True)
class FeedEvent:
    """One entry of the feeder's log. `fed` is a write of the state; `passed` is an observation."""

    stamp: float
    kind: Literal["fed", "passed"]
    part: str  # name of the body
    part_class: PartClass
    source: Source
    yaw: float = float("nan")  # in world, rad
    lateral: float = float("nan")  # m left of the centre line, looking downstream


def class_of(part: str) -> PartClass:
    """Class of a part from its body's name, `part_<class>_<k>`."""
    name = part.removeprefix("part_").rpartition("_")[0]
    return next(c for c in PART_CLASSES if c == name)


class Feeder:
    """Feeds parts at a mean rate, at least `min_spacing` of belt travel apart.

    Args:
        world: the compiled cell.
        layout: gives rate, spacing, lateral spread and the size of the line.
        rng: draws times, classes, yaws and offsets.
    """

    def __init__(self, world: World, layout: Layout, rng: np.random.Generator):
        self._world, self._rng = world, rng
        self._line, self._settings = layout.site.line, layout.world.feeder
        self._frame = world.belt_frame()  # it hangs on the belt, wherever that was set up
        m = world.model
        self._belt = m.geom("line/belt").id
        self._parts: dict[str, tuple[int, int]] = {}  # name -> address of qpos, of qvel
        for name in world.part_names:
            joint = m.joint(name)
            self._parts[name] = int(joint.qposadr[0]), int(joint.dofadr[0])
        self._stored = set(self._parts)
        self._on_belt: set[str] = set()
        self._travel = np.inf  # of the belt since the last part, m
        self._next = world.time + self._draw_gap(self._belt_speed())
        self._last_step = world.time
        self._next_check = world.time
        self.log: list[FeedEvent] = []

    @property
    def passed(self) -> tuple[FeedEvent, ...]:
        """Parts that went over the end of the belt into the bin, in order of time."""
        return tuple(event for event in self.log if event.kind == "passed")

    def step(self) -> None:
        """Feed if a part is due. Call at each physics or control step."""
        now = self._world.time
        speed = self._belt_speed()
        self._travel += speed * (now - self._last_step)
        self._last_step = now
        if now >= self._next_check:
            self._watch_bin(now)
            self._next_check = now + CHECK_PERIOD
        if now >= self._next and self._travel >= self._settings.min_spacing and speed > 0:
            self._feed(now, speed)
            self._next = now + self._draw_gap(speed)

    def _belt_speed(self) -> float:
        return float(self._world.model.geom_surfacevel[self._belt, 0])

    def _draw_gap(self, speed: float) -> float:
        """Time to the next part, s: a fixed least gap and an exponential rest."""
        least = self._settings.min_spacing / max(speed, 1e-3)
        mean = 1.0 / self._settings.rate
        return least + self._rng.exponential(max(mean - least, 0.0))

    def _feed(self, now: float, speed: float) -> None:
        free: dict[PartClass, list[str]] = {c: [] for c in PART_CLASSES}
        for name in self._parts:
            if name in self._stored or self._in_bin(name):
                free[class_of(name)].append(name)
        classes: list[PartClass] = [c for c in PART_CLASSES if free[c]]
        if not classes:
            return
        part_class = classes[self._rng.integers(len(classes))]
        # From the bin first: it stays nearly empty, and a pile costs time.
        part = min(free[part_class], key=lambda name: name in self._stored)
        source: Source = "store" if part in self._stored else "bin"
        yaw = self._rng.uniform(-np.pi, np.pi)
        lateral = self._rng.uniform(-self._settings.lateral, self._settings.lateral)
        along = rot2(self._frame[2])
        xy = self._frame[:2] + along @ (DROP_POINT, lateral)
        velocity = along @ (speed, 0.0)
        self._world.place_part(
            part,
            (*xy, self._line.height),
            (np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)),
            (*velocity, 0.0),
        )
        self._stored.discard(part)
        self._on_belt.add(part)
        self._travel = 0.0
        self.log.append(FeedEvent(now, "fed", part, part_class, source, yaw, lateral))

    def _watch_bin(self, now: float) -> None:
        for part in sorted(self._on_belt):
            if self._past_end(part):
                self._on_belt.discard(part)
                self.log.append(FeedEvent(now, "passed", part, class_of(part), "belt"))

    def _past_end(self, part: str) -> bool:
        q, _ = self._parts[part]
        x, y, z = self._world.data.qpos[q : q + 3]
        u, v = rot2(self._frame[2]).T @ ((x, y) - self._frame[:2])
        beyond = self._line.length < u < self._line.length + BIN_LENGTH
        return bool(
            beyond and abs(v) < self._line.width and 0.1 < z < self._line.height - BIN_DEPTH
        )

    def _in_bin(self, part: str) -> bool:
        _, v = self._parts[part]
        speed = np.linalg.norm(self._world.data.qvel[v : v + 3])
        return part not in self._on_belt and self._past_end(part) and bool(speed < AT_REST)

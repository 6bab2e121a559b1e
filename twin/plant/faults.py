"""Makes things go wrong while the plant runs: wet floor, late obstacles, movers, kidnappings.

Beside the feeder this is the only place that writes the state: it puts a late obstacle on the floor
and carries the vehicle to another place. Each write is logged. Neither is done where it would touch
something: a person would not, and MuJoCo would throw the bodies apart.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from twin.floor_plan import FOOTPRINT
from twin.geometry import pose2_to_transform, quat_wxyz, rectangle, rectangles_overlap
from twin.layout import Kidnap, Layout, Obstacle
from twin.plant.mover import MoverDriver
from twin.plant.obstacles import OUTLINE, is_late, obstacle_name
from twin.plant.wet_floor import WetFloor
from twin.plant.world import World
from twin.site import Pose2

STEPS = 5  # physics steps between looks at the floor and the movers
RETRY = 0.1  # s after which a place that was not free is looked at again
CLEAR = 0.3  # m around the vehicle into which nobody puts an obstacle; guess
BRAKING = 0.8  # m/s^2 with which the vehicle stops: and nobody puts it where it could not
LIFT = 0.002  # m above the floor at which an obstacle is let go


@dataclass(frozen=True)
class FaultEvent:
    """One entry of the faults' log.

    `placed` (an obstacle) and `kidnapped` (the vehicle) are writes of the state; `waits` says that
    one of them is due but that its place is not free.
    """

    stamp: float
    kind: Literal["placed", "kidnapped", "waits"]
    name: str  # of the obstacle, or agv
    pose: Pose2  # where it is put, or was to be
    because: str = ""  # what is in the way


class FaultDriver:
    """All faults of a layout that need to be driven. Call `step` at each physics step.

    Args:
        world: the compiled plant.
        layout: gives `world.faults`.
    """

    def __init__(self, world: World, layout: Layout):
        faults = layout.world.faults
        self._world = world
        self._wet = WetFloor(world.model, faults.wet) if faults.wet else None
        self._movers = [MoverDriver(world.model, i, m) for i, m in enumerate(faults.movers)]
        self._late = {i: o for i, o in enumerate(faults.obstacles) if is_late(o)}
        self._triggered: set[int] = set()
        self._kidnaps = sorted(faults.kidnaps, key=lambda kidnap: kidnap.at)
        self._again: dict[str, float] = {}  # when to look again at a place that was not free
        self._steps = 0
        self.log: list[FaultEvent] = []

    def step(self) -> None:
        """What is due now."""
        self._steps += 1
        if self._steps % STEPS != 1:
            return
        world = self._world
        if self._wet:
            self._wet.step(world.model, world.data)
        if not (self._movers or self._late or self._kidnaps):
            return
        pose, velocity = world.base_motion()
        for mover in self._movers:
            mover.step(world.data, pose, STEPS * world.model.opt.timestep)
        for i, obstacle in list(self._late.items()):
            if self._is_due(i, obstacle, pose) and self._place(i, obstacle, pose, velocity):
                del self._late[i]
        due = self._kidnaps and world.time >= self._kidnaps[0].at - 1e-9
        if due and self._carry(self._kidnaps[0]):
            del self._kidnaps[0]

    def carry_off(self, pose: Pose2) -> None:
        """Carry the vehicle to a pose as soon as that is free: a kidnapping decided in the run."""
        self._kidnaps.insert(0, Kidnap(at=max(self._world.time, 1e-3), pose=pose))

    def _is_due(self, index: int, obstacle: Obstacle, pose) -> bool:
        """From `appears` on, and once the vehicle has come near."""
        if index in self._triggered:
            return True
        if self._world.time < obstacle.appears - 1e-9:
            return False
        distance = np.hypot(pose[0] - obstacle.pose[0], pose[1] - obstacle.pose[1])
        if obstacle.near and distance > obstacle.near:
            return False
        self._triggered.add(index)
        return True

    def _place(self, index: int, obstacle: Obstacle, pose, velocity) -> bool:
        """Put a late obstacle on the floor, if its place is free."""
        name = obstacle_name(index)
        if not self._may_look(name):
            return False
        x, y, yaw = pose
        grown = 2 * (CLEAR + float(velocity[:2] @ velocity[:2]) / (2 * BRAKING))
        vehicle = rectangle(x, y, yaw, FOOTPRINT[0] + grown, FOOTPRINT[1] + grown)
        outline = rectangle(*obstacle.pose, *OUTLINE[obstacle.kind])
        joint, place = f"{name}free", (*obstacle.pose[:2], LIFT)
        quat = quat_wxyz(pose2_to_transform(obstacle.pose)[:3, :3])
        if rectangles_overlap(vehicle, outline):
            return self._wait(name, obstacle.pose, "the vehicle is too near")
        if touched := self._world.would_touch(joint, place, quat):
            return self._wait(name, obstacle.pose, touched[0])
        self._world.place(joint, place, quat, (0.0, 0.0, -0.01))
        self._note("placed", name, obstacle.pose)
        return True

    def _carry(self, kidnap: Kidnap) -> bool:
        """Carry the vehicle to another place, if that is free.

        Its joints stay as they are and come to rest; what lies on it stays behind.
        """
        if not self._may_look("agv"):
            return False
        world, joint = self._world, "agv/base"
        place = (*kidnap.pose[:2], world.base_height())
        quat = quat_wxyz(pose2_to_transform(kidnap.pose)[:3, :3])
        if touched := world.would_touch(joint, place, quat):
            return self._wait("agv", kidnap.pose, touched[0])
        world.place(joint, place, quat)
        self._note("kidnapped", "agv", kidnap.pose)
        return True

    def _may_look(self, name: str) -> bool:
        return self._world.time >= self._again.get(name, 0.0) - 1e-9

    def _wait(self, name: str, pose: Pose2, because: str) -> bool:
        if name not in self._again:
            self._note("waits", name, pose, because)
        self._again[name] = self._world.time + RETRY
        return False

    def _note(self, kind, name: str, pose: Pose2, because: str = "") -> None:
        if kind != "waits":
            self._again.pop(name, None)
        self.log.append(FaultEvent(self._world.time, kind, name.rstrip("/"), pose, because))

"""What stands and moves about the vehicle: the map, with what its sensors see now on top of it."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array
from twin.messages import Goal, LidarScan, RgbdFrame
from twin.stack.config import StackConfig
from twin.stack.estimation.obstacle_layer import ObstacleLayer
from twin.stack.estimation.occupancy_grid import OCCUPIED
from twin.stack.estimation.site_map import SiteMap
from twin.stack.planning.clearance import RADIUS, Footprint, no_obstacles, room
from twin.stack.planning.costmap import LETHAL, UNKNOWN, Costmap, inflate
from twin.stack.planning.sight import SightOptions, first_unknown
from twin.stack.planning.teb_trajectory import Trajectory

LANE = 240  # cost of a cell that something that moves will pass: nearly closed
APART = 0.01  # m that the vehicle surely is away from anything: it stands where it stands


@dataclass(frozen=True)
class SurroundingsOptions:
    """Not tuned, but where a reason is given."""

    # m about the vehicle on the inflated map. The band keeps 0.04 m to cells of half-width 0.025 m:
    # with less, ways are found on which no band is.
    margin: float = 0.07
    approach: float = 0.3  # m about a goal at which there is less, but room to stand
    beside: float = 1.0  # m beside the way within which obstacles count
    about: float = 2.0  # m about a vehicle that stands, likewise
    unseen: float = 0.8  # m about the vehicle within which ground never looked at is avoided
    sight: SightOptions = field(default_factory=SightOptions)


class Surroundings:
    """Costs of the floor and obstacles near the vehicle.

    Args:
        config: the stack's belief of the sensors.
        floor_map: what stands in the way of the vehicle.
        footprint: of the vehicle.
        options: what counts.
    """

    def __init__(
        self,
        config: StackConfig,
        floor_map: SiteMap,
        footprint: Footprint,
        options: SurroundingsOptions | None = None,
    ):
        self.options = options or SurroundingsOptions()
        self._footprint, by = footprint, 2 * self.options.margin
        self._wide = Footprint(footprint.length + by, footprint.width + by)
        self.layer = ObstacleLayer(config)
        self.set_map(floor_map, unknown_ok=False)

    def set_map(self, site_map: SiteMap, unknown_ok: bool) -> None:
        """Another map from now on; unknown cells may be crossed or not."""
        self._map, self.unknown_ok = site_map, unknown_ok
        self.layer.set_map(site_map.states, site_map.resolution, site_map.origin)
        self._changed()

    def set_belief(self, config: StackConfig) -> None:
        """Other places of the sensors from now on; what was seen by the old ones is forgotten."""
        self.layer = ObstacleLayer(config)
        self.set_map(self._map, self.unknown_ok)

    def refusal(self, goal: Goal) -> str:
        """Why the vehicle cannot stand at a goal, in one line, or nothing."""
        pose = np.asarray(goal.pose, dtype=float)
        if pose.shape != (3,) or not np.all(np.isfinite(pose)):
            return f"refused: goal {goal.pose} is not a finite x, y, yaw"
        drawn = inflate(self._map.states, self._map.resolution, self._map.origin, self._footprint)
        at = f"goal ({pose[0]:.2f}, {pose[1]:.2f})"
        if drawn.cell(pose) is None:
            return f"refused: {at} lies off the map"
        if drawn.cost(pose) == LETHAL or not drawn.fits(pose, self._footprint):
            return f"refused: at {at} the vehicle would stand in an obstacle"
        if drawn.cost(pose) == UNKNOWN and not self.unknown_ok:
            return f"refused: {at} lies on unknown ground"
        return ""

    def hear(self, reading: LidarScan | RgbdFrame, pose_at_exposure: Array | None) -> bool:
        """Take a scan or a depth picture; whether it was of use."""
        if self.layer.hear(reading, pose_at_exposure) is not None:
            return False
        self._changed()
        return True

    def forget(self, pose: Array, keep: float) -> None:
        """Forget what was seen farther than `keep` m from a pose."""
        self.layer.forget(pose, keep)
        self._changed()

    def costs(self) -> Costmap:
        """The inflated map with the live obstacles."""
        if self._costs is None:
            here = self._map
            self._costs = inflate(self.layer.states(), here.resolution, here.origin, self._wide)
        return self._costs

    def _solid(self) -> Costmap:
        """What stands there alone, not inflated: asked for at each reading, it must be cheap."""
        if self._lethal is None:
            here, solid = self._map, self.layer.states() == OCCUPIED
            cells = np.where(solid, np.uint8(LETHAL), np.uint8(0))
            self._lethal = Costmap(cells, here.resolution, here.origin)
        return self._lethal

    def _changed(self) -> None:
        self._costs: Costmap | None = None
        self._lethal: Costmap | None = None

    def approach(self, goal: Array) -> float:
        """Metres about a goal within which the margin is not asked for: where the vehicle fits."""
        return self.options.approach if self.costs().fits(goal, self._footprint) else 0.0

    def costs_with_lanes(self, now: float, cost: int = LANE) -> Costmap:
        """Likewise, where what moves is going dearer, or closed."""
        costs, lanes = self.costs(), self.layer.moving.lanes(now)
        if lanes:
            costs = Costmap(costs.cells.copy(), costs.resolution, costs.origin)
            for a, b, half in lanes:
                costs.dearer(a, b, half + self._footprint.inscribed, cost)
        return costs

    def along(self, now: float, way: Array, start: Array, length: float) -> Array:
        """Rows as in `clearance` of what stands beside the beginning of a way, and what moves.

        Args:
            now: s.
            way: points in world from the start on. Shape (n, 2).
            start: x, y, yaw in world where the vehicle is.
            length: m of the way that count.
        """
        way = np.vstack([start[:2], way]) if len(way) else start[None, :2]
        s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way, axis=0).T))])
        around = self._solid().obstacles_along(way[s <= length], self.options.beside)
        around = np.vstack([around, self.layer.moving.obstacles(now)])
        return shrunk(around, start, self._footprint)

    @property
    def known(self) -> NDArray[np.bool_]:
        """Cells that the camera looked at, or that hold what is drawn or seen. Shape (h, w)."""
        return self.layer.looked | self.layer.live | self._map.occupied

    def unknown_ahead(
        self, trajectory: Trajectory, phase: float, within: float, inset: float
    ) -> tuple[float, Array | None]:
        """When a band covers ground that nobody will have looked at, and where: `first_unknown`.

        The vehicle's rim, `inset` m wide, does not count.
        """
        here = self._map
        solid = here.occupied | self.layer.live
        return first_unknown(
            trajectory, phase, within, self.layer.looked | solid, solid, here.resolution,
            here.origin, self._footprint.half - inset, self.options.sight,
        )  # fmt: skip

    def unseen(self, pose: Array) -> Array:
        """Rows as in `clearance` of ground near a pose that might hold what the lidar misses.

        The camera looks ahead. A vehicle that turns beside what it has never looked at sweeps over
        it with its tail.
        """
        here = self._map
        cells = np.where(self.known, np.uint8(0), np.uint8(LETHAL))
        ground = Costmap(cells, here.resolution, here.origin)
        return shrunk(ground.obstacles(pose, self.options.unseen), pose, self._footprint)

    def about(self, now: float, pose: Array) -> Array:
        """Rows as in `clearance` of what stands and moves about a pose."""
        near = self._solid().obstacles(pose, self.options.about)
        near = np.vstack([near, self.layer.moving.obstacles(now)])
        return shrunk(near, pose, self._footprint)

    def strangers(self, now: float, pose: Array, by_camera: bool) -> Array:
        """Rows as in `clearance` of what stands near a pose off the map, and what moves.

        Args:
            now: s.
            pose: x, y, yaw in world.
            by_camera: whether what the depth camera alone sees counts.
        """
        here = self._map
        live = self.layer.live if by_camera else self.layer.live_by_lidar
        cells = Costmap(np.where(live, np.uint8(LETHAL), np.uint8(0)), here.resolution, here.origin)
        near = cells.obstacles(pose, self.options.about)
        near = np.vstack([near, self.layer.moving.obstacles(now)])
        return shrunk(near, pose, self._footprint)

    def threats(self, now: float, time: float, pose: Array) -> Array:
        """Rows as in `clearance` of where what moves may be after some time, should it turn."""
        return shrunk(self.layer.moving.threats(now, time), pose, self._footprint)

    def moving(self, now: float) -> bool:
        """Whether anything moves."""
        return len(self.layer.moving.obstacles(now)) > 0


def shrunk(obstacles: Array, pose: Array, footprint: Footprint) -> Array:
    """Obstacles cut back to where the vehicle is not: it stands there, so they do not.

    Cells are coarse and poses err; a few centimetres of a wall may seem to reach into the vehicle,
    and what is guessed of a thing's far side may lie in it whole.
    """
    out = obstacles.copy() if len(obstacles) else no_obstacles()
    kept = np.ones(len(out), dtype=bool)
    for k in range(len(out)):
        free = room(pose, footprint, out[k : k + 1])
        if free < APART:
            out[k, RADIUS] = max(out[k, RADIUS] + free - APART, 0.0)
            kept[k] = room(pose, footprint, out[k : k + 1]) > 0
    return out[kept]

"""The vehicle is carried off while it drives, six times a run, and must find itself again.

It is switched on without being told where it is: its filter then takes the particles of a start
from nothing. Every other time it is carried to a place that looks like the one it was taken from,
the same spot before another rack. Where it is put only the plant knows. Once it has found itself it
drives on to its goals for a while. All metrics come from truth.
"""

from itertools import permutations

import numpy as np

from evaluation.belief import belief
from evaluation.kidnaps import LIMIT, KidnapMonitor
from evaluation.localisation import LocalisationMonitor
from evaluation.particles import GRAIN, ParticleComparison
from evaluation.run import Criterion, RunRequest, RunResult
from evaluation.simulation import Simulation
from twin.floor_plan import FOOTPRINT, machines
from twin.geometry import compose2, rectangle, rectangles_overlap
from twin.layout import Layout, LayoutError
from twin.loop import Tick
from twin.messages import DriveOrder, Goal
from twin.site import Site

KIDNAPS = 6
ALONE = 8.0  # s at least that it drives on after it has found itself
WAIT = 40.0  # s more for it to come into an aisle, if it is to be carried to a place alike
GOALS = 60  # more than can be reached
BESIDE, AHEAD = 0.12, 0.60  # m of free floor around the vehicle where it is put, and before it
TRIES = 2000  # places looked at before the hall counts as full
ALIKE = 4.0  # m at most between places that look alike
LONGEST = LIMIT + KIDNAPS * (ALONE + WAIT + LIMIT)

CRITERIA = [
    Criterion("relocalised", ">=", 0.95),
    Criterion("wrong_places", "==", 0.0),
    Criterion("collisions", "==", 0.0),
    Criterion("kld_particle_ratio", ">=", 5.0),
    Criterion("ape_kld_excess_mm", "<=", GRAIN),
]

Pose = tuple[float, float, float]


def run(request: RunRequest, layout: Layout) -> RunResult:
    """One run to the last kidnapping's end."""
    rng = np.random.default_rng([request.seed, 3])
    options = layout.options.model_copy(update={"start_known": False})
    layout = layout.model_copy(update={"options": options})
    floor = Floor(layout.site)
    kidnaps, poses = KidnapMonitor(), LocalisationMonitor(layout.site)
    order = DriveOrder(0.0, draw_goals(layout.site, rng))
    config = belief(layout)
    particles = ParticleComparison(config, lambda: kidnaps.searching is not None)
    observers = (kidnaps, poses, particles)
    with Simulation(request, layout, order, observers, config) as sim:
        particles.odometry = sim.stack.localiser.fused.history.at
        due = 0.0  # when the vehicle may be carried off again
        start = np.nan  # when it knew where it is

        asked: list[bool] = []  # of each kidnapping, whether to a place that looks alike

        def over(tick: Tick) -> bool:
            nonlocal due, start
            carried = [e for e in sim.plant.faults.log if e.kind == "kidnapped"]
            for event in carried[len(kidnaps.episodes) :]:
                n = len(kidnaps.episodes)
                kidnaps.kidnapped(event.stamp, event.pose, n < len(asked) and asked[n])
                due = event.stamp + ALONE
            if np.isnan(start) and not tick.state.lost:
                start, due = tick.stamp, tick.stamp + ALONE
            if np.isnan(start) and tick.stamp < LIMIT:
                return False
            episode = kidnaps.searching
            if episode is not None and tick.stamp < episode.began + LIMIT:
                due = tick.stamp + ALONE
                return False
            if tick.stamp < due:
                return False
            if len(kidnaps.episodes) == KIDNAPS:
                return True
            if len(asked) > len(kidnaps.episodes):
                return False  # its place is not free yet
            pose = None
            if len(kidnaps.episodes) % 2 == 0 and tick.stamp < due + WAIT:
                pose = floor.alike(tick.truth.pose, rng)
                if pose is None:
                    return False  # not in an aisle yet
            alike = pose is not None
            pose = pose or floor.anywhere(rng)
            sim.plant.faults.carry_off(pose)
            asked.append(alike)
            return False

        complete = sim.run(LONGEST, over)
        metrics = {
            **kidnaps.metrics(),
            "start_found_s": start,
            "kld_particle_ratio": poses.particle_ratio(),
            **particles.metrics(),
            "collisions": float(len(sim.plant.world.collisions)),
        }
        return sim.result(metrics, CRITERIA, complete, kidnaps.notes)


def draw_goals(site: Site, rng: np.random.Generator) -> tuple[Goal, ...]:
    """Floor tags with room to stand any way, in any order, never the same twice running.

    With fewer than two of them the goals lie anywhere.
    """
    floor = Floor(site)
    ways = (0.0, np.pi / 2, np.pi, -np.pi / 2)
    free = [t for t in site.tags if all(floor.is_free((*t.pose[:2], yaw)) for yaw in ways)]
    if len(free) < 2:
        return tuple(Goal(f"place {i}", floor.anywhere(rng)) for i in range(GOALS))
    goals: list[Goal] = []
    while len(goals) < GOALS:
        tag = free[int(rng.integers(len(free)))]
        yaw = float(rng.choice(ways))
        if not goals or not goals[-1].name.startswith(f"{tag.name} "):
            goals.append(Goal(f"{tag.name} {len(goals)}", (*tag.pose[:2], yaw)))
    return tuple(goals)


class Floor:
    """Where the vehicle can be put down."""

    def __init__(self, site: Site):
        self._site = site
        self._boxes = [box for boxes in machines(site).values() for box in boxes]
        racks = [np.array(rack.pose[:2]) for rack in site.racks]
        shifts = {tuple(np.round(b - a, 3)) for a, b in permutations(racks, 2)}
        self._shifts = sorted(s for s in shifts if np.hypot(*s) <= ALIKE)
        self._racks = racks

    def is_free(self, pose) -> bool:
        """Whether the vehicle and some room around and before it are clear of the drawing."""
        x, y, _ = compose2(pose, (AHEAD / 2, 0.0, 0.0))
        needed = rectangle(
            x, y, pose[2], FOOTPRINT[0] + 2 * BESIDE + AHEAD, FOOTPRINT[1] + 2 * BESIDE
        )
        (x0, x1), (y0, y1) = self._site.hall.x, self._site.hall.y
        if not all(x0 < px < x1 and y0 < py < y1 for px, py in needed):
            return False
        return not any(rectangles_overlap(needed, box) for box in self._boxes)

    def anywhere(self, rng: np.random.Generator) -> Pose:
        """A free pose of the hall, evenly drawn.

        Raises:
            LayoutError: there is hardly any.
        """
        (x0, x1), (y0, y1) = self._site.hall.x, self._site.hall.y
        for _ in range(TRIES):
            x, y, yaw = (float(v) for v in rng.uniform((x0, y0, -np.pi), (x1, y1, np.pi)))
            if self.is_free((x, y, yaw)):
                return x, y, yaw
        raise LayoutError("kidnap: the hall has no free floor to put the vehicle down on")

    def alike(self, pose, rng: np.random.Generator) -> Pose | None:
        """The same place before another rack; None for a place away from racks."""
        if not any(np.hypot(*(pose[:2] - rack)) < 1.4 for rack in self._racks):
            return None
        for i in rng.permutation(len(self._shifts)):
            dx, dy = self._shifts[i]
            place = float(pose[0] + dx), float(pose[1] + dy), float(pose[2])
            near = any(np.hypot(place[0] - r[0], place[1] - r[1]) < 1.4 for r in self._racks)
            if near and self.is_free(place):
                return place
        return None

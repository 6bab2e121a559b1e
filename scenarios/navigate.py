"""The vehicle finds its way: at least ten goals among racks, line and dock (Li & An 2025, 2.2).

Goals and what stands or comes in the way are drawn by the run's seed: things that one sensor alone
misses, things that appear before the vehicle, carts that cross. They narrow the ways and never
close the only one. All metrics come from plant truth.
"""

import numpy as np

from evaluation.goals import GoalMonitor
from evaluation.localisation import LocalisationMonitor
from evaluation.run import Criterion, RunRequest, RunResult
from evaluation.simulation import Simulation
from twin.floor_plan import stops
from twin.geometry import compose2
from twin.layout import Layout, LayoutError, Mover, Obstacle
from twin.messages import DriveOrder, Goal

LONGEST = 600.0  # s of simulated time after which the run is given up
SETTLE = 0.3  # s after the last goal

RACKS = 6  # goals among the racks
FEWEST = 10  # goals, besides the dock at the end
SUDDEN = 3  # things that appear before the vehicle
SUDDEN_NEAR = (1.8, 2.6)  # m at which they do: it can stop, and must find another way
STANDING = ("low_box", "carton")  # there from the start, beside the middle of an aisle
BESIDE = 0.40  # m that things stand off an aisle's middle: in one of 1.5 m they leave 0.9 m
MOVER_SPEED = (0.3, 0.5)  # m/s

CRITERIA = [
    Criterion("goals_reached", ">=", 0.98),
    Criterion("collisions", "==", 0.0),
    Criterion("sudden_obstacles", ">=", 1.0),
    Criterion("ape_aisle_rmse_m", "<=", 0.03),
]


def run(request: RunRequest, layout: Layout) -> RunResult:
    """One run through all goals.

    Raises:
        LayoutError: the drawing has no racks, or nothing could appear before the vehicle.
    """
    check_layout(layout)
    rng = np.random.default_rng([request.seed, 1])
    goals = draw_goals(layout, rng)
    layout = with_faults(layout, rng)
    monitor, poses = GoalMonitor(goals), LocalisationMonitor(layout.site)
    order = DriveOrder(0.0, goals)
    with Simulation(request, layout, order, observers=(monitor, poses)) as sim:
        done_at = np.inf

        def over(tick) -> bool:
            nonlocal done_at
            if sim.stack.done:
                done_at = min(done_at, tick.stamp)
            return tick.stamp >= done_at + SETTLE

        complete = sim.run(LONGEST, over)
        metrics = {
            **monitor.metrics(),
            "sudden_obstacles": float(sum(e.kind == "placed" for e in sim.plant.faults.log)),
            "collisions": float(len(sim.plant.world.collisions)),
            **poses.metrics(),
        }
        placed = [
            f"{e.stamp:.2f} s: {e.name} {e.kind} at ({e.pose[0]:.2f}, {e.pose[1]:.2f}) {e.because}"
            for e in sim.plant.faults.log
        ]
        return sim.result(metrics, CRITERIA, complete, [*monitor.notes, *placed])


def check_layout(layout: Layout) -> None:
    """Refuse a layout on which the criteria could never be met.

    Raises:
        LayoutError: one line saying what is missing.
    """
    if not layout.site.racks:
        raise LayoutError(
            "navigate: the drawing has no racks; give it site.racks, whose aisles it drives in"
        )
    near = [obstacle for obstacle in layout.world.faults.obstacles if obstacle.near]
    if not layout.world.hazards.mouths and not near:
        raise LayoutError(
            "navigate: nothing can appear before the vehicle; give the layout world.hazards.mouths,"
            " or world.faults.obstacles with a value of near"
        )


def draw_goals(layout: Layout, rng: np.random.Generator) -> tuple[Goal, ...]:
    """Racks, stations and named places in any order; the dock comes last."""
    places = stops(layout.site)
    racks = sorted(name for name in places if name.startswith("rack "))
    names = list(rng.choice(racks, min(RACKS, len(racks)), replace=False)) if racks else []
    names += [n for n in ("pick_approach", "receiving", "goods_in") if n in places]
    names += [place.name for place in layout.site.places]
    order = list(rng.permutation(sorted(names)))
    while len(order) < FEWEST:  # of a small plant: round again, never twice the same in a row
        order += order[: FEWEST - len(order)]
    return (*(Goal(str(n), places[n]) for n in order), Goal("dock", places["dock"]))


def with_faults(layout: Layout, rng: np.random.Generator) -> Layout:
    """The layout with what stands and comes in the way; what it has already stays."""
    hazards = layout.world.hazards
    kinds = [("", True)] * SUDDEN + [(kind, False) for kind in STANDING]
    mouths = [hazards.mouths[i] for i in rng.permutation(len(hazards.mouths))[: len(kinds)]]
    obstacles = []
    for (kind, sudden), mouth in zip(kinds, mouths, strict=False):
        side = float(rng.choice((-1.0, 1.0)))
        pose = compose2(mouth, (0.0, side * BESIDE, float(rng.uniform(-0.3, 0.3))))
        near = 0.0
        if sudden:
            kind = str(rng.choice(("carton", "pillar", "low_box")))
            near = float(rng.uniform(*SUDDEN_NEAR))
        obstacles.append({"kind": kind, "pose": pose.tolist(), "near": near})
    for panel in hazards.panels:
        a, b = np.array(panel.line[:2]), np.array(panel.line[2:])
        x, y = a + rng.uniform() * (b - a)
        obstacles.append({"kind": panel.kind, "pose": (x, y, panel.yaw)})
    movers = [
        Mover(path=way, speed=float(rng.uniform(*MOVER_SPEED)), starts=float(rng.uniform(0, 10)))
        for way in hazards.carts
    ]
    faults = layout.world.faults
    faults = faults.model_copy(
        update={
            "obstacles": (*faults.obstacles, *(Obstacle.model_validate(o) for o in obstacles)),
            "movers": (*faults.movers, *movers),
        }
    )
    return layout.model_copy(update={"world": layout.world.model_copy(update={"faults": faults})})

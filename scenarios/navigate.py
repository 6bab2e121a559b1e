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
from twin.layout import Layout, Mover, Obstacle
from twin.messages import DriveOrder, Goal

LONGEST = 420.0  # s of simulated time after which the run is given up
SETTLE = 0.3  # s after the last goal

RACKS = 6  # goals among the racks
DEAD_END = (13.3, 7.55, 0.0)  # in the aisle behind rack 8, closed in the east
SUDDEN = 3  # things that appear before the vehicle
SUDDEN_NEAR = (1.8, 2.6)  # m at which they do: it can stop, and must find another way
MOVER_SPEED = (0.3, 0.5)  # m/s

# Mouths of the aisles, x and y of their middle, 1.5 m wide: a thing beside the middle leaves 0.9 m.
MOUTHS = [(x, y) for y in (1.55, 3.65, 5.75) for x in (8.5, 10.1, 11.9)]
BESIDE = 0.40  # m that things stand off an aisle's middle
# In front of the warehouse, 2.4 m wide: a panel across the way leaves room to go round.
GLASS, BLACK = (6.1, (-0.75, 0.05)), (7.3, (6.6, 6.9))
# Carts go along one side of the cross aisles, which leaves the vehicle 0.8 m.
CART_WAYS = (((7.0, 0.3), (7.0, 4.9)), ((14.85, 0.2), (14.85, 5.2)))

CRITERIA = [
    Criterion("goals_reached", ">=", 0.98),
    Criterion("collisions", "==", 0.0),
    Criterion("ape_aisle_rmse_m", "<=", 0.03),
]


def run(request: RunRequest, layout: Layout) -> RunResult:
    """One run through all goals."""
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
            "collisions": float(len(sim.plant.world.collisions)),
            **poses.metrics(),
        }
        placed = [
            f"{e.stamp:.2f} s: {e.name} {e.kind} at ({e.pose[0]:.2f}, {e.pose[1]:.2f}) {e.because}"
            for e in sim.plant.faults.log
        ]
        return sim.result(metrics, CRITERIA, complete, [*monitor.notes, *placed])


def draw_goals(layout: Layout, rng: np.random.Generator) -> tuple[Goal, ...]:
    """Racks, line, goods-in, receiving and the dead end in any order; the dock comes last."""
    places = stops(layout.site)
    racks = sorted(name for name in places if name.startswith("rack "))
    names = list(rng.choice(racks, min(RACKS, len(racks)), replace=False))
    names += [n for n in ("pick_approach", "receiving", "goods_in") if n in places]
    named = {name: places[name] for name in names} | {"dead end": DEAD_END}
    order = rng.permutation(sorted(named))
    return (*(Goal(str(n), named[str(n)]) for n in order), Goal("dock", places["dock"]))


def with_faults(layout: Layout, rng: np.random.Generator) -> Layout:
    """The layout with what stands and comes in the way; what it has already stays."""
    mouths = [MOUTHS[i] for i in rng.permutation(len(MOUTHS))[: SUDDEN + 2]]
    obstacles = []
    for i, (x, y) in enumerate(mouths):
        side = float(rng.choice((-1.0, 1.0)))
        pose = (x, y + side * BESIDE, float(rng.uniform(-0.3, 0.3)))
        if i < SUDDEN:
            kind = str(rng.choice(("carton", "pillar", "low_box")))
            near = float(rng.uniform(*SUDDEN_NEAR))
        else:
            kind, near = ("low_box", "carton")[i - SUDDEN], 0.0
        obstacles.append(Obstacle(kind=kind, pose=pose, near=near))
    x, span = GLASS
    y = float(rng.uniform(*span))
    obstacles.append(Obstacle(kind="glass_panel", pose=(x, y, np.pi / 2)))
    x, span = BLACK
    obstacles.append(Obstacle(kind="black_panel", pose=(x, float(rng.uniform(*span)), 0.2)))
    movers = [
        Mover(path=way, speed=float(rng.uniform(*MOVER_SPEED)), starts=float(rng.uniform(0, 10)))
        for way in CART_WAYS
    ]
    faults = layout.world.faults
    faults = faults.model_copy(
        update={
            "obstacles": (*faults.obstacles, *obstacles),
            "movers": (*faults.movers, *movers),
        }
    )
    return layout.model_copy(update={"world": layout.world.model_copy(update={"faults": faults})})

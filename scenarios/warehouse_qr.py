"""Load at goods-in, read the goods code, drive from tag to tag to rack seven, unload.

Li & An 2025, section 2.3, and Xu et al., section 3. The same order is carried out twice with the
same seed: by lidar alone, and by lidar with the floor tags; the report has both. The seed draws how
the parcel lies, what stands in the aisle before the rack, and a tag that is misplaced, torn or
printed for another place. The rack is that of `world.parcel`; ways and places follow the drawing.
All metrics come from plant truth.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from evaluation.localisation import LocalisationMonitor
from evaluation.run import Criterion, RunRequest, RunResult
from evaluation.simulation import Simulation
from evaluation.transport import TransportMonitor
from twin.floor_plan import rack_stop
from twin.geometry import compose2
from twin.layout import Layout, LayoutError, Obstacle, TagFault
from twin.messages import TransportOrder
from twin.site import Tag
from twin.stack.config import nominal_config
from twin.stack.planning.tag_route import nearest_tag, tag_route

LONGEST = 180.0  # s of simulated time after which a pass is given up
SETTLE = 0.5  # s that the parcel gets to come to rest

# What stands in the way: in the aisle before the rack, 1.5 m wide, off its middle, so that the
# vehicle can pass on one side.
AISLE = 1.5  # m: the last leg at least so long is the aisle
WAY, BESIDE = (0.8, 1.0), 0.40  # m along it and off it
APPEARS = (1.8, 2.6)  # m from the vehicle at which it comes into the way
MISPLACED, ASKEW = (0.05, 0.20), 0.05  # m, rad: by which a misplaced one is off

CRITERIA = [
    Criterion("delivered", "==", 1.0),
    Criterion("qr_pose_error_p95_mm", "<=", 10.0),
    Criterion("ape_aisle_rmse_m", "<=", 0.03),
    Criterion("ape_aisle_rmse_lidar_m", "<=", 0.03),
    Criterion("collisions", "==", 0.0),
    Criterion("delivered_lidar", "==", 1.0),
    Criterion("collisions_lidar", "==", 0.0),
]


def run(request: RunRequest, layout: Layout) -> RunResult:
    """By lidar alone first, of which only figures are kept; then with the tags.

    Raises:
        LayoutError: the drawing has no goods-in, no such rack, or no way from tag to tag.
    """
    layout = with_faults(layout, np.random.default_rng([request.seed, 2]))

    def progress(time: float, total: float, text: str) -> None:
        request.progress(time, total, f"lidar alone: {text}")

    quiet = replace(request, record=False, log=False, viewer=False, progress=progress)
    first = _transport(quiet, _with_tags(layout, False))
    if not first.complete and first.sim_time < (request.duration or LONGEST) - 0.1:
        return first  # interrupted: there is no second pass
    result, lidar = _transport(request, _with_tags(layout, True)), first.metrics
    metrics = {
        **result.metrics,
        "ape_aisle_rmse_lidar_m": lidar["ape_aisle_rmse_m"],
        "over_tags_error_p95_lidar_mm": lidar["over_tags_error_p95_mm"],
        "transport_time_lidar_s": lidar["transport_time_s"],
        "delivered_lidar": lidar["delivered"],
        "placement_error_lidar_mm": lidar["placement_error_mm"],
        "collisions_lidar": lidar["collisions"],
    }
    return replace(result, metrics=metrics, complete=first.complete and result.complete)


def _transport(request: RunRequest, layout: Layout) -> RunResult:
    """One order, from the dock to the parcel on the rack."""
    parcel = TransportMonitor(layout, nominal_config(layout.site, layout.options))
    poses = LocalisationMonitor(layout.site)
    done_at = np.inf
    order = TransportOrder(0.0)
    with Simulation(request, layout, order, observers=(parcel, poses)) as sim:

        def over(tick) -> bool:
            nonlocal done_at
            if sim.stack.done:
                done_at = min(done_at, tick.stamp)
            return tick.stamp >= done_at + SETTLE

        complete = sim.run(LONGEST, over)
        known = poses.metrics()
        metrics = {
            **parcel.metrics(),
            "transport_time_s": min(done_at, sim.plant.time),
            "collisions": float(len(sim.plant.world.collisions)),
            **{name: known[name] for name in KNOWN},
        }
        notes = [f"{stamp:.2f} s: {text}" for stamp, text in parcel.events]
        return sim.result(metrics, CRITERIA, complete, notes)


KNOWN = (
    "qr_pose_error_p95_mm",
    "over_tags_error_p95_mm",
    "ape_aisle_rmse_m",
    "tags_read",
    "tags_refused",
)


def with_faults(layout: Layout, rng: np.random.Generator) -> Layout:
    """The layout with what the seed puts in the way; what it has already stays."""
    way = tag_way(layout)
    start, along = aisle(way)
    ahead, side = float(rng.uniform(*WAY)), float(rng.choice((-1.0, 1.0)))
    kind, late = str(rng.choice(("carton", "pillar", "low_box"))), bool(rng.integers(2))
    near = float(rng.uniform(*APPEARS)) if late else 0.0
    x, y, yaw = (float(v) for v in compose2((*start, along), (ahead, side * BESIDE, 0.0)))
    obstacle = Obstacle(kind=kind, pose=(x, y, yaw), near=near)  # type: ignore[arg-type]
    shift, turn = rng.uniform(*MISPLACED), rng.uniform(-np.pi, np.pi)
    faults = layout.world.faults
    faulty = {fault.tag for fault in faults.tags}
    whole = [tag.name for tag in way[1:-2] or way[:1] if tag.name not in faulty]
    tag = TagFault(
        tag=str(rng.choice(whole or [way[0].name])),
        kind=str(rng.choice(("misplaced", "damaged", "foreign"))),  # type: ignore[arg-type]
        shift=(
            float(shift * np.cos(turn)),
            float(shift * np.sin(turn)),
            float(rng.uniform(-ASKEW, ASKEW)),
        ),
    )
    more = {
        "obstacles": (*faults.obstacles, obstacle),
        "tags": (*faults.tags, tag) if whole else faults.tags,
    }
    world = layout.world.model_copy(update={"faults": faults.model_copy(update=more)})
    return layout.model_copy(update={"world": world})


def tag_way(layout: Layout) -> list[Tag]:
    """Tags along the drawn way from goods-in to the rack that the parcel is for.

    Raises:
        LayoutError: there is no goods-in, no such rack, or no way.
    """
    site, number = layout.site, layout.world.parcel.rack
    if site.goods_in is None:
        raise LayoutError("warehouse_qr: the drawing has no site.goods_in")
    poses = {rack.number: rack.pose for rack in site.racks}
    if number not in poses:
        known = ", ".join(map(str, sorted(poses))) or "none: the drawing has no racks"
        raise LayoutError(f"world.parcel.rack: no rack {number}; choose from {known}")
    try:
        start, goal = (nearest_tag(site.tags, p) for p in (site.goods_in, rack_stop(poses[number])))
        return tag_route(site.tags, start.name, goal.name)
    except ValueError as error:
        raise LayoutError(f"warehouse_qr: {error}") from None


def aisle(way: list[Tag]) -> tuple[tuple[float, float], float]:
    """Where the last long leg of a way begins, x and y in world, and its heading.

    Raises:
        LayoutError: no leg is long enough for something to stand in.
    """
    for a, b in reversed(list(pairwise(way))):
        (ax, ay, _), (bx, by, _) = a.pose, b.pose
        if np.hypot(bx - ax, by - ay) >= AISLE:
            return (ax, ay), float(np.arctan2(by - ay, bx - ax))
    raise LayoutError(f"warehouse_qr: no {AISLE} m from tag to tag on the way to the rack")


def _with_tags(layout: Layout, tags: bool) -> Layout:
    return layout.model_copy(update={"options": layout.options.model_copy(update={"tags": tags})})

"""The vehicle drives a course as drawn, over dry floor first and then over wet patches.

Dead reckoning from the wheels alone against the fused one (Li & An 2025, section 2.2): both start
at the dock and are never corrected. The vehicle itself drives on its localised pose: a long aisle
at full speed, turns on the spot, a long strafe. Where the patches lie is drawn by seed, unless the
layout has some of its own; only the plant knows. All metrics come from plant truth.
"""

from dataclasses import dataclass

import numpy as np

from evaluation.ape import pose_errors
from evaluation.odometry import Aisle, CourseMonitor, step_errors
from evaluation.places import check_way
from evaluation.run import Criterion, RunRequest, RunResult
from evaluation.simulation import Simulation
from twin.layout import Layout, WetPatch
from twin.loop import Tick
from twin.messages import CourseOrder
from twin.site import Pose2, Site
from twin.stack.config import Wheels

LONGEST = 180.0  # s of simulated time after which the run is given up
SETTLE = 0.5  # s at rest in the end
FRICTION = 0.03, 0.10  # of rollers on a patch, from, to: soapy water or oil on concrete; guess
LENGTH = 0.5, 1.2  # m of a patch along the way, from, to

CRUISE = 0.9 * 0.95  # m/s: of the top speed, from which the aisle is judged
SOUTH_SIDE, EAST_SIDE = 0.85, 0.65  # m from the hall's south and east walls to the way along them
WEST, NORTH = 5.65, 5.60  # m: west end of the south aisle, north end of the east aisle
LANE, WEST_END = 0.0, 1.40  # m: lane back in the cell, and its end
THIRD, QUARTER, HALF = 2 * np.pi / 3, np.pi / 2, np.pi

CRITERIA = [
    Criterion("odometry_ratio", "<=", 0.5),
    Criterion("cross_track_max_m", "<=", 0.05),
    Criterion("turn_drift_m", "<=", 0.05),
    Criterion("collisions", "==", 0.0),
]


@dataclass(frozen=True)
class Course:
    """The way of a run, along the south and the east wall of a hall.

    Attributes:
        aisle: in which it drives at full speed; no patch lies in it.
        east, west: ends of the aisle, x and y in world, where it turns once around.
        route: all way-points.
    """

    aisle: Aisle
    east: tuple[float, float]
    west: tuple[float, float]
    route: tuple[Pose2, ...]


def drawn_course(site: Site) -> Course:
    """The course in a hall.

    Raises:
        LayoutError: something is drawn on it.
    """
    x, y = site.hall.x[1] - EAST_SIDE, site.hall.y[0] + SOUTH_SIDE
    route = (
        (0.60, 0.00, 0.0),
        (0.60, y, 0.0),  # strafe
        (x, y, 0.0),  # 14 m at full speed in the default hall
        *((x, y, k * THIRD) for k in (1, 2, 3)),  # once around to the left
        (x, y, QUARTER),
        (x, NORTH, QUARTER),  # over two patches, to a stop on a third
        (x, NORTH, HALF),  # turn on it
        (x, y, HALF),  # set out on it, and strafe back
        (WEST, y, HALF),
        *((WEST, y, HALF - k * THIRD) for k in (1, 2, 3)),  # once around to the right
        (WEST, LANE, HALF),  # strafe
        (WEST_END, LANE, HALF),  # over two patches, to a stop on a third
        (WEST_END, LANE, QUARTER),
        (WEST_END, LANE, 0.0),  # turn on it
        (WEST, LANE, 0.0),  # set out on it
        (WEST_END, LANE, 0.0),  # backwards
        (0.0, 0.0, 0.0),
    )
    check_way("odometry", site, (site.dock, *route))
    return Course(Aisle(y=y, x=(WEST, x), cruise=CRUISE), (x, y), (WEST, y), route)


def run(request: RunRequest, layout: Layout) -> RunResult:
    """One run over the course.

    Raises:
        LayoutError: the drawing has something on the course.
    """
    way = drawn_course(layout.site)
    wet = layout.world.faults.wet or patches(way, np.random.default_rng([request.seed, 1]))
    faults = layout.world.faults.model_copy(update={"wet": wet})
    world = layout.world.model_copy(update={"faults": faults})
    layout = layout.model_copy(update={"world": world})
    wheels = Wheels()
    x, y = wheels.half_base, wheels.half_track
    course = CourseMonitor(wet, np.array([(x, y), (x, -y), (-x, y), (-x, -y)]))
    done_at = np.inf
    with Simulation(request, layout, CourseOrder(0.0, way.route), observers=(course,)) as sim:

        def over(tick: Tick) -> bool:
            nonlocal done_at
            if sim.stack.done:
                done_at = min(done_at, tick.stamp)
            return tick.stamp >= done_at + SETTLE

        complete = sim.run(LONGEST, over)
        notes = [f"wet: x {p.x}, y {p.y} m, friction {p.friction:.3f}" for p in wet]
        return sim.result(metrics(sim, course, way), CRITERIA, complete, notes)


def patches(way: Course, rng: np.random.Generator) -> tuple[WetPatch, ...]:
    """Wet patches by a course: across the whole lane, or under the wheels of one side."""

    def patch(along: tuple[float, float], across: tuple[float, float], middle: float):
        """Both sides in two of five cases, else the lower or the upper one."""
        length, place = rng.uniform(*LENGTH), rng.uniform(*along)
        side = rng.choice(["both", "both", "low", "low", "high"])
        low = middle if side == "high" else across[0]
        high = middle if side == "low" else across[1]
        return (place - length / 2, place + length / 2), (low, high), rng.uniform(*FRICTION)

    out, east = [], way.east[0]
    for span in ((0.8, 2.0), (3.0, 4.2)):  # in the east aisle
        y, x, friction = patch(span, (east - EAST_SIDE, east + EAST_SIDE), east)
        out.append(WetPatch(x=x, y=y, friction=friction))
    for span in ((2.5, 3.1), (4.1, 4.7)):  # in the cell
        x, y, friction = patch(span, (-0.35, 0.40), LANE)
        out.append(WetPatch(x=x, y=y, friction=friction))
    for (x, y), most in (((east, NORTH), 0.6), ((WEST_END, LANE), 0.35)):
        dx, dy = rng.uniform(0.25, most, 2)  # where it stops, turns and sets out
        friction = rng.uniform(*FRICTION)
        out.append(WetPatch(x=(x - dx, x + dx), y=(y - dy, y + dy), friction=friction))
    return tuple(out)


def worst_drift(course: CourseMonitor, way: Course) -> float:
    """Greatest drift of the turns at both ends of the aisle, m; NaN if either was not turned."""
    return float(np.maximum(course.turn_drift(way.east), course.turn_drift(way.west)))


def metrics(sim: Simulation, course: CourseMonitor, way: Course) -> dict[str, float]:
    """All figures of the report, in the order of its table."""
    tracks = sim.paths.trajectories()
    truth = tracks["truth"]
    estimate, fused, wheels = (
        pose_errors(truth, tracks[name]) for name in ("estimate", "fused", "odometry")
    )
    dry = wheels.stamps < course.dry_until()
    cross_track, cruised = course.cross_track(way.aisle)
    return {
        "odometry_ape_rmse_m": wheels.rmse,
        "odometry_fused_ape_rmse_m": fused.rmse,
        "odometry_fused_ape_max_m": fused.maximum,
        "odometry_ratio": fused.rmse / wheels.rmse,
        "odometry_dry_ape_rmse_m": wheels.where(dry).rmse,
        "odometry_fused_dry_ape_rmse_m": fused.where(dry).rmse,
        "odometry_dry_ratio": fused.where(dry).rmse / wheels.where(dry).rmse,
        "odometry_yaw_rmse_deg": wheels.yaw_rmse_deg,
        "odometry_fused_yaw_rmse_deg": fused.yaw_rmse_deg,
        **step_errors(truth, tracks["fused"]),
        "wet_share": float(np.mean(course.wheels_wet() > 0)),
        "cross_track_max_m": cross_track,
        "cruise_way_m": cruised,
        "turn_drift_m": worst_drift(course, way),
        "ape_rmse_m": estimate.rmse,
        "ape_max_m": estimate.maximum,
        "ape_yaw_rmse_deg": estimate.yaw_rmse_deg,
        "collisions": float(len(sim.plant.world.collisions)),
    }

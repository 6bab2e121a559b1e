"""The vehicle drives at 0.5 m/s before the truss: error of its pose while it moves.

The head's planes sweep for a thirtieth of a second while the vehicle goes 17 mm on; each crossing
is taken at its own instant. Ways along the truss, towards it and aslant, with turns in between.
"""

from dataclasses import replace

import numpy as np

from evaluation.beacon_field import WEST, calibrated_field
from evaluation.beacons import BeaconMonitor, calibration_errors, matrix, rms
from evaluation.belief import belief
from evaluation.run import Criterion, RunRequest, RunResult
from evaluation.simulation import Simulation
from twin.geometry import Array, wrap_angle
from twin.layout import Layout
from twin.loop import Tick
from twin.messages import CourseOrder

SPEED = 0.5  # m/s
FULL = 0.9 * SPEED  # m/s from which the vehicle counts as driving at speed
BEGIN = 4.0  # s after which the filter has settled
LONGEST = 120.0  # s of simulated time after which the run is given up
ROUTE = (
    (2.3, 3.8, WEST),  # along the truss: a strafe
    (2.3, 1.2, WEST),
    (1.2, 1.2, WEST),  # towards it
    (1.2, 3.8, WEST),
    (2.3, 3.8, WEST),  # away from it
    (1.2, 1.4, WEST),  # aslant
    (1.2, 3.6, WEST + 0.6),  # turning on the way
    (2.2, 2.0, WEST - 0.3),
    (2.3, 2.6, WEST),
)

CRITERIA = [
    Criterion("moving_rmse_mm", "<=", 5.0),
    Criterion("fix_availability", ">=", 0.95),
    Criterion("collisions", "==", 0.0),
]


def run(request: RunRequest, layout: Layout) -> RunResult:
    """Calibration drive, then the route."""
    found = calibrated_field(request, layout)
    if isinstance(found, str):
        return RunResult(notes=[found])
    request, field = found
    watch = BeaconMonitor()
    config = belief(field)
    config = replace(config, drive=replace(config.drive, speed=SPEED, strafe_speed=SPEED))
    with Simulation(request, field, CourseOrder(0.0, ROUTE), (watch,), config) as sim:

        def over(tick: Tick) -> bool:
            return sim.stack.done

        complete = sim.run(LONGEST, over)
        return sim.result(metrics(sim, watch), CRITERIA, complete, watch.outcomes())


def metrics(sim: Simulation, watch: BeaconMonitor) -> dict[str, float]:
    """All figures of the report."""
    settled = np.array(watch.stamps) >= BEGIN
    off = 1e3 * (watch.estimate[:, :3] - watch.truth[:, :3])
    yaw = wrap_angle(_yaw(watch.estimate) - _yaw(watch.truth))
    speed = np.hypot(*watch.velocity[:, :2].T)
    driving = settled & (speed >= FULL)
    distance = np.linalg.norm(off, axis=1)
    fixes = single_fixes(watch)
    heard = [s for s in watch.sights if s.stamp >= BEGIN]
    rejected = sum(bool(s.rejected) for s in heard)
    return {
        "moving_rmse_mm": rms(distance[driving]),
        "moving_max_mm": float(distance[driving].max(initial=0.0)) if driving.any() else np.nan,
        "moving_rmse_plane_mm": rms(np.hypot(*off[driving, :2].T)),
        "moving_yaw_rmse_deg": float(np.degrees(rms(yaw[driving]))),
        "moving_share": float(np.mean(driving[settled])) if settled.any() else np.nan,
        "course_rmse_mm": rms(distance[settled]),
        "fix_rmse_mm": rms(fixes),
        "fix_availability": _share(heard),
        "fixes_with_rejected": float(rejected),
        **calibration_errors(sim),
        "collisions": float(len(sim.plant.world.collisions)),
    }


def single_fixes(watch: BeaconMonitor) -> Array:
    """Errors of the fixes themselves while driving at speed, mm. Shape (n,)."""
    stamps, found = np.array(watch.stamps), []
    speed = np.hypot(*watch.velocity[:, :2].T)
    for sight in watch.sights:
        if sight.pose is None or sight.stamp < BEGIN:
            continue
        if np.interp(sight.stamp, stamps, speed) >= FULL:
            true = watch.truth_at(sight.stamp)[:3, 3]
            found.append(1e3 * np.linalg.norm(sight.pose[:3] - true))
    return np.array(found)


def _share(heard) -> float:
    return float(np.mean([s.reason == "fused" for s in heard])) if heard else float("nan")


def _yaw(poses: Array) -> Array:
    return np.array([np.arctan2(T[1, 0], T[0, 0]) for T in map(matrix, poses)])

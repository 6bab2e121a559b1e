"""Thirty moves of 50 to 1000 mm, each ending parked to a millimetre by the photoelectric network.

The source's Fig. 12 (Liu et al. 2022, section 3.2.2) is the residual of the measured distance from
stop to stop against a laser tracker: that is reported for its method and for ours, and so is the
true parking error, which is what the vehicle is for. The wheels close the loop on the filter.
`moves.npz` in the run's folder holds distances and residuals.
"""

import numpy as np

from evaluation.beacon_field import WEST, calibrated_field
from evaluation.beacons import (
    BeaconMonitor,
    best_triple,
    calibration_errors,
    matrix,
    true_mount,
)
from evaluation.run import Criterion, RunRequest, RunResult
from evaluation.simulation import Simulation
from twin.geometry import Array, wrap_angle
from twin.layout import Layout
from twin.messages import ParkOrder
from twin.stack.estimation.beacon_receiver import locator, stamp_batch
from twin.stack.estimation.beacons.fix import Fix

MOVES = 30
SHORTEST, FARTHEST = 0.050, 1.000  # m of a move
X, Y, YAW = (1.2, 2.35), (1.4, 3.8), 0.15  # m, rad about facing the truss: where it parks
LONGEST = 400.0  # s of simulated time after which the run is given up

CRITERIA = [
    Criterion("parking_error_max_mm", "<=", 2.0),
    Criterion("moves", "==", float(MOVES)),
    Criterion("collisions", "==", 0.0),
]


def run(request: RunRequest, layout: Layout) -> RunResult:
    """Calibration drive, then the moves."""
    found = calibrated_field(request, layout)
    if isinstance(found, str):
        return RunResult(notes=[found])
    request, field = found
    poses = moves(np.random.default_rng([request.seed, 5]), field.site.dock)
    watch = BeaconMonitor()
    with Simulation(request, field, ParkOrder(0.0, poses), (watch,)) as sim:
        complete = sim.run(LONGEST, lambda tick: sim.stack.done)
        figures, table = metrics(sim, watch)
        np.savez_compressed(request.out / "moves.npz", allow_pickle=False, **table)
        return sim.result(figures, CRITERIA, complete, watch.outcomes())


def moves(rng: np.random.Generator, start) -> tuple[tuple[float, float, float], ...]:
    """Poses to park at, moves of a drawn length apart; the first is where the first one starts."""
    x, y = 2.2, start[1]
    poses = [(x, y, WEST)]
    while len(poses) <= MOVES:
        length, bearing = rng.uniform(SHORTEST, FARTHEST), rng.uniform(-np.pi, np.pi)
        nx, ny = x + length * np.cos(bearing), y + length * np.sin(bearing)
        if X[0] <= nx <= X[1] and Y[0] <= ny <= Y[1]:
            x, y = nx, ny
            poses.append((float(x), float(y), WEST + float(rng.uniform(-YAW, YAW))))
    return tuple(poses)


def metrics(sim: Simulation, watch: BeaconMonitor) -> tuple[dict[str, float], dict[str, Array]]:
    """All figures, and the table of the moves."""
    parked = sim.stack.parker.parked
    true = np.array([watch.truth_at(t) for t, _ in parked]).reshape(-1, 4, 4)
    goals = np.array([goal for _, goal in parked]).reshape(-1, 3)
    off = true[:, :2, 3] - goals[:, :2]
    yaw = wrap_angle(np.arctan2(true[:, 1, 0], true[:, 0, 0]) - goals[:, 2])
    believed = np.array([_estimate(watch, t) for t, _ in parked]).reshape(-1, 4, 4)
    error = 1e3 * np.hypot(*off[1:].T)
    heads = true @ true_mount(sim.plant)
    distance = _steps(heads[:, :3, 3])
    ours = _steps((believed @ sim.stack.config.beacons.T_base_head)[:, :3, 3]) - distance
    single = [_single(sim, watch, t) for t, _ in parked]
    source, single_ours = (
        _steps(np.array([s[k] for s in single]).reshape(-1, 3)) - distance for k in (0, 1)
    )
    # Both methods are judged by the same moves: those whose two turns gave both of them a pose.
    both = np.isfinite(source) & np.isfinite(single_ours)
    table = {
        "distance": distance,
        "parking_error_mm": error,
        "residual_source": source,
        "residual_ours": single_ours,
        "residual_filtered": ours,
    }
    return {
        "parking_error_max_mm": _most(error),
        "parking_error_rms_mm": float(np.sqrt(np.mean(error**2))) if len(error) else np.nan,
        "parking_yaw_error_max_deg": float(np.degrees(_most(yaw[1:]))),
        "estimate_error_max_mm": 1e3 * _most(np.hypot(*(believed - true)[1:, :2, 3].T)),
        "distance_residual_source_max_mm": 1e3 * _most(source[both]),
        "distance_residual_ours_max_mm": 1e3 * _most(single_ours[both]),
        "distances_compared": float(both.sum()),
        "turns_without_source": float(sum(np.isnan(s[0]).any() for s in single)),
        "turns_without_ours": float(sum(np.isnan(s[1]).any() for s in single)),
        "distance_residual_filtered_max_mm": 1e3 * _most(ours),
        "moves": float(len(error)),
        "move_shortest_mm": 1e3 * float(distance.min()) if len(distance) else np.nan,
        "move_longest_mm": 1e3 * float(distance.max()) if len(distance) else np.nan,
        "time_per_move_s": float((parked[-1][0] - parked[0][0]) / len(error))
        if len(error)
        else np.nan,
        **calibration_errors(sim),
        "collisions": float(len(sim.plant.world.collisions)),
    }, table


def _estimate(watch: BeaconMonitor, time: float) -> Array:
    return matrix(watch.estimate[int(np.argmin(np.abs(np.array(watch.stamps) - time)))])


def _single(sim: Simulation, watch: BeaconMonitor, time: float) -> tuple[Array, Array]:
    """Place of the head by the last turn before a time: the source's method, and ours. (3,) each.

    The source's on the three nodes that are best there by their bound: near the cylinder through
    three nodes it may be decimetres off. NaN where there is no fix.
    """
    place, nowhere = locator(sim.stack.config), np.full(3, np.nan)
    reading = [r for r in watch.readings if r.stamp <= time][-1]
    batch = stamp_batch(reading)
    three, _ = best_triple(sim.plant, watch.truth_at(time) @ true_mount(sim.plant))
    fourth = next(name for name in place.survey.names if name not in three)
    source = place.source_fix(batch, (*three, fourth))  # type: ignore[arg-type]
    ours = place.fix(batch)
    return (
        source[:3, 3] if isinstance(source, np.ndarray) else nowhere,
        ours.T_world_head[:3, 3] if isinstance(ours, Fix) else nowhere,
    )


def _steps(places: Array) -> Array:
    """Distances from each place to the next, m. Shapes (n, 3) to (n - 1,)."""
    return np.linalg.norm(np.diff(places, axis=0), axis=1)


def _most(values: Array) -> float:
    """Greatest size; NaN of nothing."""
    return float(np.max(np.abs(values))) if len(values) else float("nan")

"""The vehicle drives to the belt, picks an order off it with two arms and delivers it.

Li & An 2025. From the dock to the line at least 4 m away with a strafe and a turn, an order of 20
parts from a moving belt, then to the receiving point. All metrics come from plant truth.
"""

import numpy as np

from evaluation.ape import pose_errors
from evaluation.picks import PickMonitor
from evaluation.run import Criterion, RunRequest, RunResult
from evaluation.simulation import Simulation
from twin.layout import Layout
from twin.loop import Tick
from twin.stack.config import nominal_config

LONGEST = 240.0  # s of simulated time after which the run is given up
SETTLE = 0.5  # s that parts get to come to rest after the vehicle has stopped

CRITERIA = [
    Criterion("ape_max_m", "<=", 0.10),
    Criterion("pick_rate_per_hour", ">=", 600.0),
    Criterion("pick_success", ">=", 0.95),
    Criterion("wrong_class", "==", 0.0),
    Criterion("collisions", "==", 0.0),
]


def run(request: RunRequest, layout: Layout) -> RunResult:
    """One run to the end of the order."""
    picks = PickMonitor(layout, nominal_config(layout.site, layout.options))
    done_at = np.inf
    with Simulation(request, layout, observers=(picks,), counts=picks.counts) as sim:

        def over(tick: Tick) -> bool:
            nonlocal done_at
            if sim.stack.done:
                done_at = min(done_at, tick.stamp)
            return tick.stamp >= done_at + SETTLE

        complete = sim.run(LONGEST, over)
        notes = [f"{stamp:.2f} s: {text}" for stamp, text in picks.events]
        return sim.result(metrics(sim, picks), CRITERIA, complete, notes)


def metrics(sim: Simulation, picks: PickMonitor) -> dict[str, float]:
    """All figures of the report, in the order of its table."""
    tracks = sim.paths.trajectories()
    estimate = pose_errors(tracks["truth"], tracks["estimate"])
    return {
        "ape_rmse_m": estimate.rmse,
        "ape_max_m": estimate.maximum,
        "ape_yaw_rmse_deg": estimate.yaw_rmse_deg,
        "ape_moving_rmse_m": estimate.where(sim.paths.moving()).rmse,
        "odometry_fused_ape_rmse_m": pose_errors(tracks["truth"], tracks["fused"]).rmse,
        "odometry_ape_rmse_m": pose_errors(tracks["truth"], tracks["odometry"]).rmse,
        **picks.metrics(),
        "collisions": float(len(sim.plant.world.collisions)),
    }

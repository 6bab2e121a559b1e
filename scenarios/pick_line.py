"""The vehicle drives to the belt, picks an order off it with two arms and delivers it.

Li & An 2025. From the dock to the line at least 4 m away with a strafe and a turn, an order of 20
parts from a moving belt, then to the receiving point. All metrics come from plant truth.
"""

import numpy as np

from evaluation.ape import pose_errors
from evaluation.picks import PickMonitor
from evaluation.report import metrics_page
from evaluation.run import Criterion, RunRequest, RunResult
from evaluation.trajectories import TrajectoryMonitor
from twin.layout import Layout
from twin.loop import Loop
from twin.plant.live_viewer import LiveViewer
from twin.plant.plant import Plant
from twin.recording.log import ReadingsLog
from twin.recording.viewer_log import ViewerLog
from twin.stack.config import nominal_config
from twin.stack.control_unit import ControlUnit
from twin.stack.stack import Stack

LONGEST = 240.0  # s of simulated time after which the run is given up
SETTLE = 0.5  # s that parts get to come to rest after the vehicle has stopped
WARM_UP = 2.0  # s left out of the real-time factor

CRITERIA = [
    Criterion("ape_max_m", "<=", 0.10),
    Criterion("pick_rate_per_hour", ">=", 600.0),
    Criterion("pick_success", ">=", 0.95),
    Criterion("collisions", "==", 0.0),
]


def run(request: RunRequest, layout: Layout) -> RunResult:
    """One run to the end of the order."""
    config = nominal_config(layout.site, layout.options)
    plant = Plant(layout, request.seed)
    stack = Stack(config)
    plant.park([w.motion.rest for w in stack.arms])
    picks, paths = PickMonitor(layout, config), TrajectoryMonitor()
    watchers: list = []
    if request.record:
        rrd = request.out / "recording.rrd"
        watchers.append(ViewerLog(rrd, plant.world, config, picks.counts))
    if request.log:
        watchers.append(ReadingsLog(request.out / "readings.log", config.site, config.options))
    if request.viewer:
        watchers.append(LiveViewer(plant.world))
    loop = Loop(plant, stack, ControlUnit(config.wheels), (picks, paths, *watchers))
    longest = request.duration or LONGEST
    warm, complete = (0.0, 0.0), False
    try:
        done_at = np.inf
        while plant.time < longest - 1e-9 and not complete:
            tick = loop.tick()
            if loop.stack.done:
                done_at = min(done_at, tick.stamp)
            complete = tick.stamp >= done_at + SETTLE
            if warm[0] == 0.0 and plant.time >= WARM_UP:
                warm = (plant.time, loop.busy_s)
            request.progress(plant.time, longest, tick.state.task)
    except KeyboardInterrupt:
        pass  # what was measured so far is reported, marked incomplete
    finally:
        figures = metrics(plant, picks, paths)
        for watcher in watchers:
            if isinstance(watcher, ViewerLog):
                watcher.metrics(metrics_page(figures))
            watcher.close()
        plant.close()
    timed, busy = plant.time - warm[0], loop.busy_s - warm[1]
    return RunResult(
        metrics=figures,
        criteria=CRITERIA,
        sim_time=plant.time,
        wall_time=loop.busy_s,
        rtf=timed / busy if warm[0] and busy > 0 else float("nan"),
        complete=complete,
        trajectories=paths.trajectories(),
        notes=[f"{stamp:.2f} s: {text}" for stamp, text in picks.events]
        + [
            f"{c.stamp:.2f} s: collision {c.kind}: {c.first}, {c.second}" for c in collisions(plant)
        ],
    )


def collisions(plant: Plant):
    """Onsets of contacts that should not have been."""
    return plant.world.collisions


def metrics(plant: Plant, picks: PickMonitor, paths: TrajectoryMonitor) -> dict[str, float]:
    """All figures of the report, in the order of its table."""
    tracks = paths.trajectories()
    fused = pose_errors(tracks["truth"], tracks["estimate"])
    wheels = pose_errors(tracks["truth"], tracks["odometry"])
    return {
        "ape_rmse_m": fused.rmse,
        "ape_max_m": fused.maximum,
        "ape_yaw_rmse_deg": fused.yaw_rmse_deg,
        "ape_moving_rmse_m": fused.where(paths.moving()).rmse,
        "odometry_ape_rmse_m": wheels.rmse,
        **picks.metrics(),
        "collisions": float(len(collisions(plant))),
    }

"""A point drives one metre along x; its odometry drifts.

The belt's speed chooses what happens: 0.4 fails, 0.3 waits to be interrupted.
"""

import time

import numpy as np

from evaluation.ape import pose_errors
from evaluation.run import Criterion, RunRequest, RunResult
from twin.layout import Layout, LayoutError

LENGTH = 1.0  # s


def run(request: RunRequest, layout: Layout) -> RunResult:
    rng = np.random.default_rng(request.seed)
    speed = layout.world.line.speed
    if speed == 0.4:
        raise RuntimeError("wheels\nfell off")
    if speed == 0.45:
        raise LayoutError("models/agv/agv.xml: missing")
    end = min(request.duration or LENGTH, LENGTH)
    t = np.arange(0, end, 0.01)
    truth = np.column_stack([t, 0 * t, 0 * t])
    estimate = truth + np.cumsum(rng.normal(0, 1e-4, truth.shape), axis=0)
    if request.record:
        (request.out / "recording.rrd").write_bytes(b"frames")
    interrupted = False
    if speed == 0.3:
        try:
            print("ready", flush=True)
            time.sleep(60)
        except KeyboardInterrupt:
            interrupted = True
    request.progress(end, LENGTH, "drives [0, 1]")
    errors = pose_errors((t, truth), (t, estimate))
    return RunResult(
        metrics={"ape_max_m": errors.maximum, "first_grip_delay_s": float("nan")},
        criteria=[Criterion("ape_max_m", "<=", 1e-9 if speed == 0.2 else 0.1)],
        sim_time=end,
        wall_time=time.perf_counter(),
        rtf=1.0 + time.perf_counter() % 1,
        complete=end == LENGTH and not interrupted,
        trajectories={"truth": (t, truth), "estimate": (t, estimate)},
    )

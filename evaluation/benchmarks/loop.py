"""Where the time of a run goes: physics, each sensor, each stage of the stack, the whole.

    python -m evaluation.benchmarks.loop [--job pick|drive|navigate] [--seed 100]
                                         [--seconds 60] [--repeats 3]

`pick` fills an order off the belt; `drive` goes from rack to rack with nothing in the way. Times
are wall time inside one process; shares are of the loop. Rendering runs in a worker thread beside
physics: its rows count the worker's time, which overlaps the loop's. `navigate` is the scenario
itself, with the goals and hazards of its seed, whole unless `--seconds` are given: each run is a
process of its own, and only its real-time factor is told.
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from functools import wraps
from pathlib import Path

from rich.console import Console
from rich.table import Table

from twin.floor_plan import stops
from twin.layout import load_layout
from twin.loop import Loop
from twin.messages import DriveOrder, Goal
from twin.plant.plant import Plant
from twin.site import Site
from twin.stack.config import nominal_config
from twin.stack.control_unit import ControlUnit
from twin.stack.stack import Stack

WARM_UP = 2.0  # s of simulated time: compilation of inner loops, first pictures


class Stopwatch:
    """Adds up the time spent in chosen methods of chosen objects."""

    def __init__(self):
        self.seconds: dict[str, float] = defaultdict(float)
        self.calls: dict[str, int] = defaultdict(int)

    def watch(self, label: str, owner, method: str) -> None:
        """Replace `owner.method` by one that is timed under `label`."""
        inner = getattr(owner, method)

        @wraps(inner)
        def timed(*args, **kwargs):
            start = time.perf_counter()
            try:
                return inner(*args, **kwargs)
            finally:
                self.seconds[label] += time.perf_counter() - start
                self.calls[label] += 1

        setattr(owner, method, timed)

    def clear(self) -> None:
        self.seconds.clear()
        self.calls.clear()


def drive_order(site: Site) -> DriveOrder:
    """From rack to rack through the whole warehouse, and back to the dock."""
    places = stops(site)
    racks = [name for name in places if name.startswith("rack")]
    return DriveOrder(0.0, tuple(Goal(name, places[name]) for name in (*racks, "dock")))


def watched_loop(job: str, seed: int, watch: Stopwatch) -> Loop:
    """The loop on the default layout, every stage under the watch."""
    layout = load_layout()
    config = nominal_config(layout.site, layout.options)
    order = drive_order(layout.site) if job == "drive" else None
    plant, stack = Plant(layout, seed, order), Stack(config)
    plant.park([w.motion.rest for w in stack.arms])
    unit = ControlUnit(config.wheels)
    watch.watch("physics", plant.world, "step")
    watch.watch("feeder", plant.feeder, "step")
    watch.watch("encoders", plant, "encoder_counts")
    for sensor in plant.sensors:
        watch.watch(f"sensor {type(sensor).__name__}", sensor, "sample")
    watch.watch("renderer (worker thread)", plant.renderer, "_run")
    watch.watch("waiting for readings", plant, "readings")
    watch.watch("truth (evaluation)", plant, "truth")
    watch.watch("control unit", unit, "step")
    watch.watch("stack: odometry and EKF", stack.localiser.fused, "step")
    watch.watch("stack: localiser, whole", stack.localiser, "step")
    watch.watch("stack: AMCL", stack.localiser.amcl, "update")
    watch.watch("stack: navigator", stack.navigator, "step")
    watch.watch("stack: obstacle layer", stack.navigator, "hear")
    watch.watch("stack: detection", stack.detector, "detect")
    watch.watch("stack: tracking", stack.tracker, "update")
    watch.watch("stack: distance S", stack.distance, "update")
    watch.watch("stack: drive", stack.drive, "step")
    watch.watch("stack: picking", stack.picker, "step")
    for worker in stack.arms:
        watch.watch("stack: arms", worker, "step")
    watch.watch("stack, whole", stack, "step")
    return Loop(plant, stack, unit)


def scenario_factor(name: str, seed: int, seconds: float | None) -> float:
    """Real-time factor that a run of a scenario reports; NaN if it was too short to say.

    Raises:
        RuntimeError: the run failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        run = [sys.executable, "-m", "twin", "run", name, "--seed", str(seed), "--out", folder]
        cut = [] if seconds is None else ["--duration", str(seconds)]
        done = subprocess.run([*run, *cut], capture_output=True, text=True)
        if done.returncode not in (0, 1):
            raise RuntimeError(done.stderr.strip())
        factor = json.loads((Path(folder) / "report.json").read_text())["rtf"]
    return float("nan") if factor is None else float(factor)


def watched_factor(job: str, seed: int, seconds: float, tell: bool) -> float:
    """Real-time factor of a job in this process; prints its table if it is to be told."""
    watch = Stopwatch()
    loop = watched_loop(job, seed, watch)
    loop.run(WARM_UP)
    watch.clear()
    busy = loop.busy_s
    loop.run(seconds)
    busy = loop.busy_s - busy
    loop.plant.close()
    if tell:
        Console().print(_table(watch, busy))
    return (seconds - WARM_UP) / busy


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--job", choices=("pick", "drive", "navigate"), default="pick")
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--seconds", type=float, help="simulated seconds a run")
    parser.add_argument("--repeats", type=int, default=3)
    asked = parser.parse_args()
    factors = []
    for repeat in range(asked.repeats):
        if asked.job == "navigate":
            factors.append(scenario_factor(asked.job, asked.seed, asked.seconds))
            print(f"navigate, seed {asked.seed}: real-time factor {factors[-1]:.2f}", flush=True)
        else:
            last = repeat == asked.repeats - 1
            factors.append(watched_factor(asked.job, asked.seed, asked.seconds or 60.0, last))
    print(f"real-time factor, median of {asked.repeats}: {statistics.median(factors):.2f}")


def _table(watch: Stopwatch, busy: float) -> Table:
    table = Table("stage", "calls", "ms a call", "share of the loop")
    for label, seconds in sorted(watch.seconds.items(), key=lambda item: -item[1]):
        calls = watch.calls[label]
        table.add_row(label, str(calls), f"{1e3 * seconds / calls:.3f}", f"{seconds / busy:.1%}")
    table.add_row("loop", "", "", "100.0%")
    return table


if __name__ == "__main__":
    main()

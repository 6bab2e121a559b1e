"""Where the time of a run goes: physics, each sensor, each stage of the stack, the whole.

    python -m evaluation.benchmarks.loop [--job pick|drive] [--seconds 60] [--repeats 3]

Times are wall time inside one process; shares are of the loop. Rendering runs in a worker thread
beside physics: its rows count the worker's time, which overlaps the loop's.
"""

import argparse
import statistics
import time
from collections import defaultdict
from functools import wraps

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


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--job", choices=("pick", "drive"), default="pick")
    parser.add_argument("--seconds", type=float, default=60.0, help="simulated seconds a run")
    parser.add_argument("--repeats", type=int, default=3)
    asked = parser.parse_args()
    factors = []
    for repeat in range(asked.repeats):
        watch = Stopwatch()
        loop = watched_loop(asked.job, 100, watch)
        loop.run(WARM_UP)
        watch.clear()
        busy = loop.busy_s
        loop.run(asked.seconds)
        busy = loop.busy_s - busy
        loop.plant.close()
        factors.append((asked.seconds - WARM_UP) / busy)
        if repeat == asked.repeats - 1:
            Console().print(_table(watch, busy))
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

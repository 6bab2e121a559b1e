"""Records the drive that `test_recorded_drive.py` localises on.

Run `python tests/data/make_warehouse_drive.py` in the root of the repository.

Around two racks of the default plant as built for one seed, by lidar alone. Kept of every other
scan: ranges in millimetres, as the lidar gives them (0: nothing heard), the fused odometry and the
true pose at its exposure.
"""

from pathlib import Path

import numpy as np

from evaluation.run import RunRequest
from evaluation.simulation import Simulation
from twin.layout import load_layout
from twin.messages import DriveOrder, Goal, LidarScan
from twin.stack.estimation.pose_history import PoseHistory

SEED, LONGEST = 100, 90.0  # s
WAREHOUSE = 7.0  # m: recorded from here on
EVERY = 2
GOALS = (("W1", (7.35, 1.55, 0.0)), ("M1", (11.0, 1.55, 0.0)), ("M2", (11.0, 3.65, np.pi)),
         ("W2", (7.35, 3.65, np.pi)))  # fmt: skip


class Recorder:
    """Scans with odometry and truth at their exposures."""

    def __init__(self):
        self.odometry = lambda stamp: None
        self._truth = PoseHistory()
        self.heard, self.rows = 0, []

    def observe(self, tick):
        self._truth.add(tick.stamp, tick.truth.pose)
        for scan in tick.readings:
            if not isinstance(scan, LidarScan) or tick.truth.pose[0] < WAREHOUSE:
                continue
            odometry, truth = self.odometry(scan.stamp), self._truth.at(scan.stamp)
            self.heard += 1
            if self.heard % EVERY == 0 and odometry is not None and truth is not None:
                mm = np.where(np.isfinite(scan.ranges), np.rint(1e3 * scan.ranges), 0)
                self.rows.append((scan.stamp, mm.astype(np.uint16), odometry, truth))
                self.angles = scan.angle_min, scan.angle_increment, scan.range_max


def main():
    layout = load_layout(None, ("options.tags=off",))
    order = DriveOrder(0.0, tuple(Goal(*goal) for goal in GOALS))
    recorder = Recorder()
    request = RunRequest(seed=SEED, out=Path("."))
    with Simulation(request, layout, order, (recorder,)) as sim:
        recorder.odometry = sim.stack.localiser.fused.history.at
        assert sim.run(LONGEST, lambda tick: sim.stack.done), sim.stack.state.navigation.outcomes
        print(sim.stack.state.navigation.outcomes)
    stamps, ranges, odometry, truth = map(np.array, zip(*recorder.rows, strict=True))
    path = Path(__file__).parent / "warehouse_drive.npz"
    np.savez_compressed(path, stamps=stamps, ranges_mm=ranges, odometry=odometry.astype(np.float32),
                        truth=truth.astype(np.float32), angles=recorder.angles)  # fmt: skip
    print(f"{path}: {len(stamps)} scans, {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()

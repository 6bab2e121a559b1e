"""Whether fewer particles cost accuracy: two shadow filters on the readings of one run.

One keeps as many particles as KLD sampling asks for, the other as many as at the start. Both begin
where the vehicle has found itself and take the same scans with the same odometry until it is lost
or carried off again. Nothing of them flows back into the run.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from evaluation.ape import PoseErrors
from twin.geometry import Array, between2
from twin.loop import Tick
from twin.messages import LidarScan
from twin.stack.config import StackConfig
from twin.stack.estimation.kld import Kld
from twin.stack.estimation.pose_history import PoseHistory
from twin.stack.estimation.site_amcl import default_settings, site_amcl

SEED = 21  # of the particles; any will do
LOSS, GRAIN = 0.10, 1.0  # of the fixed filter's error that may be lost; mm on top, for rounding


class ParticleComparison:
    """Follows a run with both filters.

    Args:
        config: the stack's belief.
        carried_off: whether the vehicle is where it does not know yet.
    """

    def __init__(self, config: StackConfig, carried_off: Callable[[], bool]):
        settings = default_settings(config)
        most = settings.kld.most
        fixed = replace(settings, kld=Kld(least=most, most=most))
        self._filters = [
            site_amcl(config, np.random.default_rng(SEED), s) for s in (settings, fixed)
        ]
        self._carried_off = carried_off
        self.odometry: Callable[[float], Array | None] = lambda stamp: None
        """Fused odometry's pose x, y, yaw in odom at an exposure."""
        self._truth = PoseHistory()
        self._running = False
        self._stamps: list[float] = []
        self._off: list[list[Array]] = []  # of both filters

    def observe(self, tick: Tick) -> None:
        state = tick.state
        self._truth.add(tick.stamp, tick.truth.pose)
        if state.lost or self._carried_off():
            self._running = False
            return
        if not self._running:
            self._running = True
            for amcl in self._filters:
                amcl.initialise(state.pose, state.pose_covariance, state.fused_pose, tick.stamp)
            return
        for reading in tick.readings:
            if isinstance(reading, LidarScan):
                self._scan(reading)

    def _scan(self, scan: LidarScan) -> None:
        odometry, true = self.odometry(scan.stamp), self._truth.at(scan.stamp)
        if odometry is None or true is None:
            return
        if any([amcl.update(scan, odometry) for amcl in self._filters]):
            return  # of before the start
        self._stamps.append(scan.stamp)
        self._off.append([between2(true, amcl.pose_at(odometry)) for amcl in self._filters])

    def metrics(self) -> dict[str, float]:
        """ape_kld_rmse_m, ape_fixed_rmse_m: of both filters; ape_kld_excess_mm: by how much the
        first is worse than the second and a tenth. NaN without a scan."""
        off = np.array(self._off).reshape(-1, 2, 3)
        stamps = np.array(self._stamps)
        kld, fixed = (
            PoseErrors(stamps, np.hypot(off[:, i, 0], off[:, i, 1]), off[:, i, 2]).rmse
            for i in range(2)
        )
        return {
            "ape_kld_rmse_m": kld,
            "ape_fixed_rmse_m": fixed,
            "ape_kld_excess_mm": 1e3 * (kld - (1 + LOSS) * fixed),
        }

"""The photoelectric network in the vehicle's estimate: 6-DoF fixes in the filter of `pose_filter`.

While fixes come in, scan and floor tags add nothing: they are ten times coarser. When the network
falls silent they take over again; when it comes back, the filter starts from their pose.
"""

import numpy as np

from twin.geometry import Array, quat_wxyz
from twin.messages import BeaconSight, BeaconStamps
from twin.stack.config import StackConfig
from twin.stack.estimation.beacon_receiver import BeaconReceiver, Located
from twin.stack.estimation.beacons.stamps import NoFix
from twin.stack.estimation.map_correction import growth
from twin.stack.estimation.pose_filter import PoseFilter
from twin.stack.estimation.pose_history import PoseHistory

SILENCE = 0.5  # s without a fix after which others tell the pose
CONTRADICTIONS = "no solution", "residuals", "ambiguous"  # nodes are seen, and disagree
FOREIGN = 30  # turns of nothing but these from the start, after which the calibration is doubted
FOREIGN_HEAD = "; never a fix: is the head's calibration of this vehicle?"
PATIENCE = 5  # fixes in a row outside the gate, after which they are believed


class BeaconFusion:
    """Receiver and filter.

    Args:
        config: drawing, head and options.
    """

    def __init__(self, config: StackConfig):
        self._receiver = BeaconReceiver(config)
        self.filter: PoseFilter | None = None
        self._fused_at = -np.inf
        self._reckoned = np.eye(3)  # covariance of the dead reckoning at the filter's state
        self._outside = 0
        self._contradicted: int | None = 0  # turns from the start; nothing once there was a fix

    def alive(self, stamp: float) -> bool:
        """Whether the network tells the pose at this time."""
        return self.filter is not None and stamp - self._fused_at < SILENCE

    def hear(
        self,
        reading: BeaconStamps,
        history: PoseHistory,
        reckoned: Array,
        believed: tuple[Array, Array, Array],
    ) -> BeaconSight:
        """Take a turn of the head.

        Args:
            reading: its stamps.
            history: of the dead reckoning.
            reckoned: the dead reckoning's covariance now. Shape (3, 3).
            believed: where the filter starts if it does not run: pose in world (3,), its
                covariance (3, 3), and the dead reckoning's pose at that time (3,).
        """
        found = self._receiver.locate(reading, history.at)
        if isinstance(found, NoFix):
            return BeaconSight(reading.stamp, found.reason + self._doubt(found.reason))
        self._contradicted = None
        odometry = history.at(found.stamp)
        if odometry is None:
            return BeaconSight(found.stamp, "where the vehicle was is not known")
        if self.filter is None or not self.alive(found.stamp):
            pose, covariance, at = believed
            self.filter = PoseFilter(pose, covariance, at, found.stamp)
            self._reckoned = reckoned
        way = odometry[:2] - self.filter.odometry[:2]
        self.filter.carry(odometry, found.stamp, growth(self._reckoned, reckoned, way))
        self._reckoned = reckoned
        # What all fixes share does not average out: the filter keeps it apart.
        own, self.filter.common = found.covariance - found.common, found.common
        fused = self.filter.update(found.T_world_base, own)
        self._outside = 0 if fused else self._outside + 1
        if self._outside >= PATIENCE:  # carried off: the fixes agree, the filter does not
            self.filter.T, self.filter.P = found.T_world_base, own
            self._outside, fused = 0, True
        if fused:
            self._fused_at = found.stamp
        return _sight(found, "fused" if fused else "refused by the estimate")

    def _doubt(self, reason: str) -> str:
        """What to add to the reason of a turn without a fix."""
        if self._contradicted is None:
            return ""
        self._contradicted += reason in CONTRADICTIONS
        return FOREIGN_HEAD if self._contradicted >= FOREIGN else ""


def pose7(T_world_base: Array) -> Array:
    """x, y, z, qw, qx, qy, qz. Shape (7,)."""
    return np.concatenate([T_world_base[:3, 3], quat_wxyz(T_world_base[:3, :3])])


def _sight(found: Located, what: str) -> BeaconSight:
    return BeaconSight(
        found.stamp,
        what,
        pose7(found.T_world_base),
        found.covariance,
        found.rejected,
        found.nodes,
    )

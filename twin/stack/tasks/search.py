"""A vehicle that does not know where it is: the search for its place takes the wheels."""

import numpy as np

from twin.geometry import Array
from twin.messages import BodyVelocity, LidarScan, RgbdFrame
from twin.stack.config import StackConfig
from twin.stack.estimation.depth_to_scan import DepthToScan
from twin.stack.estimation.localiser import Localiser
from twin.stack.estimation.scans import beam_points, scan_fault
from twin.stack.estimation.slam import compose_points
from twin.stack.tasks.relocalise import Relocaliser

LIMIT = 180.0  # s after which a search is given up: the longest of sixty took 6 s


class Search:
    """Feeds the relocaliser from the readings while the localiser is lost.

    Args:
        config: the stack's belief of the sensors.
    """

    def __init__(self, config: StackConfig):
        self._relocaliser = Relocaliser()
        self._convert = DepthToScan(config.rgbd)
        T = config.T_base_lidar
        self._lidar_in_base = np.array([T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])])
        self._scan: Array = np.zeros((0, 2))
        self._depth: Array | None = None
        self.active, self._began = False, 0.0

    def failed(self, now: float) -> bool:
        """Whether it has gone on for too long."""
        return self.active and now - self._began > LIMIT

    def give_up(self) -> None:
        """Stop searching."""
        self.active = False

    @property
    def reason(self) -> str:
        """What it is doing, in a few words; empty while it has nothing to do."""
        return self._relocaliser.reason if self.active else ""

    def hear(self, reading: LidarScan | RgbdFrame) -> None:
        """Take a scan or, during a search, a depth picture; broken ones are left out."""
        if isinstance(reading, LidarScan):
            if scan_fault(reading) is None:
                self._scan = compose_points(self._lidar_in_base, beam_points(reading))
        elif self.active:
            seen = self._convert.convert(reading)
            if seen is not None:
                place = seen.sensor_pose
                self._depth = compose_points(place, beam_points(seen.scan))

    def begin(self, now: float) -> None:
        self._relocaliser.start(now)
        self.active, self._began, self._depth = True, now, None

    def step(self, now: float, localiser: Localiser) -> BodyVelocity:
        """Command of this tick; `active` falls when the place has been found."""
        depth, self._depth = self._depth, None
        command = self._relocaliser.step(now, self._scan, depth, localiser)
        standing = not np.any(np.abs(command.as_array()) > 1e-3)
        self.active = not (self._relocaliser.done and standing)
        return command

"""Straight along an outer wall by the line that the lidar sees of it, not by the localised pose.

Xu et al., Eqs. 3-5: a line through the scan's points says how far the vehicle is from the wall and
how it points. It takes over side and heading on long legs at speed; how far along the vehicle is
the pose alone can tell. Switched on by `options.aisle = "line"`.
"""

import numpy as np

from twin.geometry import apply, between2
from twin.messages import BodyVelocity, LidarScan
from twin.site import Hall
from twin.stack.config import StackConfig
from twin.stack.estimation.scans import beam_points, scan_fault
from twin.stack.planning.drive import Leg
from twin.stack.planning.line_following import LineFollower

LONG = 4.0  # m of a leg that is worth it
SIDE = 0.4, 1.2  # m from the way to a wall that is followed, from, to
CRUISE = 0.5  # share of the top speed above which the line steers
FRESH = 0.25  # s: two scans may be missed
STRAIGHT = np.radians(1.0)  # between the leg and the vehicle's heading, and between leg and wall


class AisleKeeper:
    """Steers by a wall where there is one.

    Args:
        config: the drawing, for walls, mount and limits.
    """

    def __init__(self, config: StackConfig):
        self._config = config
        self._p_base = np.zeros((0, 2))
        self._stamp = -np.inf

    def hear(self, scan: LidarScan) -> None:
        """Keep the newest scan; a broken one is left out."""
        if scan_fault(scan) is None and scan.stamp > self._stamp:
            p_lidar = beam_points(scan)
            points = np.column_stack([p_lidar, np.zeros(len(p_lidar))])
            self._p_base = apply(self._config.T_base_lidar, points)[:, :2]
            self._stamp = scan.stamp

    def steered(self, now: float, leg: Leg | None, command: BodyVelocity) -> BodyVelocity:
        """The command of this tick, with side and heading from the wall where it can be followed.

        Args:
            now: s.
            leg: under way.
            command: by the localised pose.
        """
        if leg is None or now - self._stamp > FRESH:
            return command
        speed = float(np.hypot(*leg.at(now)[1][:2]))
        distance = wall_beside(self._config.site.hall, leg)
        if distance is None or speed < CRUISE * self._config.drive.speed:
            return command
        line = LineFollower(speed, distance).command(self._p_base)
        return command if line is None else BodyVelocity(command.vx, line.vy, line.omega)


def wall_beside(hall: Hall, leg: Leg) -> float | None:
    """Distance of the nearest outer wall that runs along a long straight leg, m; left is positive.

    None if there is none near enough, or the vehicle does not drive straight ahead on the leg.
    """
    x, y, yaw = between2(leg.start, leg.goal)
    if x < LONG or abs(np.arctan2(y, x)) > STRAIGHT or abs(yaw) > STRAIGHT:
        return None
    left = np.array([-np.sin(leg.goal[2]), np.cos(leg.goal[2])])
    beside: list[float] = []
    for axis, faces in enumerate((hall.x, hall.y)):
        if abs(left[axis]) > np.cos(STRAIGHT):
            beside += [float((face - leg.goal[axis]) * left[axis]) for face in faces]
    near = [d for d in beside if SIDE[0] < abs(d) < SIDE[1]]
    return min(near, key=abs, default=None)

"""The photoelectric network in a recording: nodes, and the rays of each turn of the head."""

import numpy as np
import rerun as rr

from twin.geometry import Array, rotation_from_quat
from twin.messages import BeaconSight
from twin.stack.config import StackConfig

USED, REJECTED = (60, 180, 75), (230, 25, 75)


class BeaconView:
    """Draws under `world/beacons`, and plots under `network`.

    Args:
        out: the recording.
        config: drawing of nodes and head.
    """

    def __init__(self, out: rr.RecordingStream, config: StackConfig):
        network = config.site.beacons
        self._out, self._head = out, config.beacons.T_base_head[:3, 3]
        self._nodes = {n.name: np.array(n.position) for n in network.nodes} if network else {}
        used = config.options.beacons != "off"
        if self._nodes and used:
            points = rr.Points3D(
                list(self._nodes.values()), labels=list(self._nodes), radii=0.02, colors=USED
            )
            out.log("world/beacons/nodes", points, static=True)

    def draw(self, sight: BeaconSight) -> None:
        """Rays from the head to the nodes of a fix; red to those that contradicted it."""
        self._out.set_time("sim", duration=sight.stamp)
        if sight.pose is None:
            self._out.log("world/beacons/rays", rr.LineStrips3D([]))
            return
        head = sight.pose[:3] + rotation_from_quat(sight.pose[3:]) @ self._head
        refused = {name for name, _ in sight.rejected}
        names = [*sight.rays, *sorted(refused - set(sight.rays))]
        lines = [[head, self._nodes[name]] for name in names]
        colours = [REJECTED if name in refused else USED for name in names]
        self._out.log("world/beacons/rays", rr.LineStrips3D(lines, colors=colours, radii=0.004))

    def sigma(self, sight: BeaconSight) -> dict[str, float]:
        """Standard deviations of a fix along x, y, z, mm, for the plots."""
        if sight.covariance is None:
            return {}
        found: Array = 1e3 * np.sqrt(np.diag(sight.covariance)[:3])
        return {f"network/sigma_{a}_mm": float(v) for a, v in zip("xyz", found, strict=True)}

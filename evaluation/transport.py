"""Whether the parcel of a transport order arrived, and how exactly, from the plant's truth."""

import re

import numpy as np

from twin.floor_plan import RACK, rack_stop
from twin.geometry import Array, compose2
from twin.layout import Layout
from twin.loop import Tick
from twin.stack.config import StackConfig

PARCEL = "part_parcel_0"
AT_REST = 0.01  # m/s
HEIGHT_TOLERANCE = 0.005  # m off the deck's face that a standing parcel's bottom may be
STRIP = 0.195  # m of free strip along the front edge: models/warehouse/README.md
REPEAT = 1.0  # s within which the same thing is not told again
UPRIGHT = 0.99  # least cosine of its tilt


class TransportMonitor:
    """Follows the parcel; `metrics()` at the end.

    Args:
        layout: what stands where, and for which rack the parcel is.
        config: the drawing of parcel and deck.
    """

    def __init__(self, layout: Layout, config: StackConfig):
        self._config, self._rack = config, layout.world.parcel.rack
        racks = {rack.number: rack.pose for rack in layout.site.racks}
        self._pose = racks.get(self._rack)
        self._T: Array | None = None
        self._speed, self._held = np.inf, True
        self.lifted = 0  # times that a hand took hold of it
        self.events: list[tuple[float, str]] = []
        self._last: dict[str, float] = {}  # when something was last said of a subject

    def observe(self, tick: Tick) -> None:
        truth = tick.truth
        held = any(grip.part == PARCEL for grip in truth.grips)
        self.lifted += held and not self._held
        self._held = held
        self._T = truth.T_world_part(PARCEL)
        i = truth.part_names.index(PARCEL)
        self._speed = float(np.linalg.norm(truth.part_velocity[i]))
        for event in tick.state.events:
            self._note(tick.stamp, event)

    def _note(self, stamp: float, event: str) -> None:
        """Keep an event, but not one that was told just now with other numbers."""
        about = re.sub(r"[0-9.]+", "", event)
        if stamp - self._last.get(about, -np.inf) > REPEAT:
            self.events.append((stamp, event))
        self._last[about] = stamp

    @property
    def delivered(self) -> bool:
        """At rest, let go, upright on the free strip of the rack that it is for.

        The rack is taken as drawn: it stands 4 mm (1 sigma) off that, and the strip is 0.195 m.
        """
        if self._T is None or self._pose is None or self._held or self._speed > AT_REST:
            return False
        x, y = _in_frame(self._pose, self._T[:2, 3])
        behind = y + RACK[1] / 2  # of the front edge
        room = self._config.parcel.length / 2
        return bool(
            abs(x) < RACK[0] / 2 - room
            and room < behind < STRIP - room
            and abs(self._T[2, 3] - self._config.stand_height) < HEIGHT_TOLERANCE
            and self._T[2, 2] > UPRIGHT
        )

    def placement_error(self) -> float:
        """Distance of the parcel from its drawn place on the rack, seen from above, m."""
        if self._T is None or self._pose is None:
            return float("nan")
        wanted = compose2(rack_stop(self._pose), self._config.parcel_place)
        return float(np.hypot(*(self._T[:2, 3] - wanted[:2])))

    def metrics(self) -> dict[str, float]:
        """Figures for the report; the placement error is NaN for what was not delivered."""
        error = 1e3 * self.placement_error() if self.delivered else float("nan")
        return {"delivered": float(self.delivered), "placement_error_mm": error}


def _in_frame(pose, position) -> Array:
    """x, y of a point of world in the frame at `pose`. Shape (2,)."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[c, s], [-s, c]]) @ np.subtract(position, pose[:2])

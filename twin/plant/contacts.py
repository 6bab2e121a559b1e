"""Which contacts are collisions, and when each began."""

from dataclasses import dataclass

import mujoco
import numpy as np

GAP = 0.1  # s without contact after which a touch of the same two bodies counts anew

# What a geom belongs to. A wheel's roller and the floor are meant to touch, as are the tray and
# a part; fingers are arm. Racks and stands are stations, partitions are hall, a mover is an
# obstacle.
KINDS = (
    "none",
    "floor",
    "hall",
    "line",
    "station",
    "agv",
    "tray",
    "roller",
    "arm0",
    "arm1",
    "part",
    "obstacle",
)


@dataclass(frozen=True)
class Collision:
    """One touch that should not have been: its onset."""

    stamp: float
    kind: str  # arm-arm, arm-self, arm-agv, arm-line, arm-hall, agv-line, agv-obstacle...
    first: str  # geom or body
    second: str


def collision_kind(first: str, second: str) -> str | None:
    """Name of the collision between two kinds of geom; None where they are meant to touch."""
    a, b = sorted((first, second))
    arms = [k for k in (a, b) if k.startswith("arm")]
    if len(arms) == 2:
        return "arm-self" if a == b else "arm-arm"
    vehicle = {"agv", "tray", "roller"}
    if arms:
        other = b if a in arms else a
        if other == "part":
            return None
        if other in vehicle:
            return "arm-agv"
        return f"arm-{'hall' if other == 'floor' else other}"
    ours = {a, b} & vehicle
    if not ours:
        return None
    other = ({a, b} - ours).pop() if {a, b} - ours else None
    if other is None or (ours == {"roller"} and other == "floor"):
        return None
    if ours == {"tray"} and other == "part":
        return None
    return f"agv-{'hall' if other == 'floor' else other}"


class CollisionCounter:
    """Reads the contacts of each step. A touch lasts until `GAP` seconds pass without it."""

    def __init__(self, model: mujoco.MjModel):
        kinds = [_kind_of(model, g) for g in range(model.ngeom)]
        self._kind = np.array([KINDS.index(k) for k in kinds], dtype=np.intp)
        n = len(KINDS)
        self._name = [[collision_kind(a, b) for b in KINDS] for a in KINDS]
        self._bad = np.array([[bool(self._name[i][j]) for j in range(n)] for i in range(n)])
        self._bodies = model.geom_bodyid.copy()
        self._labels = [_label(model, g) for g in range(model.ngeom)]
        self._last_seen: dict[tuple[str, int, int], float] = {}
        self.onsets: list[Collision] = []

    def observe(self, time: float, data: mujoco.MjData) -> None:
        """Note the collisions among the contacts of the present state."""
        if not data.ncon:
            return
        geom = data.contact.geom
        bad = self._bad[self._kind[geom[:, 0]], self._kind[geom[:, 1]]]
        if not bad.any():
            return
        for g1, g2 in geom[bad & (data.contact.dist < 0)].tolist():
            kind = self._name[self._kind[g1]][self._kind[g2]]
            assert kind is not None  # or it would not be bad
            low, high = sorted((int(self._bodies[g1]), int(self._bodies[g2])))
            key = (kind, low, high)
            if time - self._last_seen.get(key, -np.inf) > GAP:
                self.onsets.append(Collision(time, kind, self._labels[g1], self._labels[g2]))
            self._last_seen[key] = time


def _label(model: mujoco.MjModel, geom: int) -> str:
    return model.geom(geom).name or model.body(model.geom_bodyid[geom]).name


def _kind_of(model: mujoco.MjModel, geom: int) -> str:
    name, body = model.geom(geom).name, model.body(model.geom_bodyid[geom]).name
    if name == "floor":
        return "floor"
    if name.startswith("wall_"):
        return "hall"
    if body.startswith("part_"):
        return "part"
    prefix = body.partition("/")[0]
    if prefix == "head":
        return "agv"
    if name.startswith("beacons/"):
        return "station"
    if prefix == "agv":
        if "/tray_" in name:
            return "tray"
        return "roller" if "/roller_" in name else "agv"
    if prefix in ("arm0", "arm1", "line"):
        return prefix
    if prefix.startswith(("obstacle_", "mover_")):
        return "obstacle"
    return "station" if prefix.startswith(("receiving", "dock", "goods_in", "rack")) else "none"

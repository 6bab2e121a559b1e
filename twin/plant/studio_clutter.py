"""What lies about in the studio and is no connector: nuts, screws, washers, caps, cables.

Sizes are those of M6 to M16 hardware (DIN 934, DIN 933, DIN 125) and of the connectors' own loose
nuts, which are the hardest to tell from a connector. Each lies on the belt at height 0; occluders
are meant to hang above it.
"""

import mujoco
import numpy as np

CYLINDER, BOX = mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_BOX
SPHERE, CAPSULE = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE
ALONG_X = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)
METAL, DARK = (0.75, 0.75, 0.73), (0.08, 0.08, 0.08)
OCCLUDER = "occluder"


def add_clutter(spec: mujoco.MjSpec) -> tuple[str, ...]:
    """Add one body of each kind; returns their names. A material of the same name colours each."""
    names = []
    for kind, build in KINDS.items():
        spec.add_material(name=kind, rgba=(*METAL, 1), specular=0.5, shininess=0.6)
        spec.add_material(name=f"{kind}_dark", rgba=(*DARK, 1), specular=0.0, shininess=0.0)
        body = spec.worldbody.add_body(name=kind, mocap=True, pos=(0, 0, -2))
        build(body, kind)
        names.append(kind)
    return tuple(names)


def _add(body, kind, material: str, size, pos=(0, 0, 0), quat=(1, 0, 0, 0)) -> None:
    body.add_geom(
        type=kind, size=size, pos=pos, quat=quat, material=material, group=4, contype=0,
        conaffinity=0,
    )  # fmt: skip


def _hexagon(body, material: str, flats: float, half: float, x: float, z: float) -> None:
    """A hexagonal prism along x, on a flat: three boxes turned by 60 degrees."""
    for k in range(3):
        c, s = np.cos(k * np.pi / 6), np.sin(k * np.pi / 6)
        size = (half, flats / (2 * np.sqrt(3)), flats / 2)
        _add(body, BOX, material, size, (x, 0, z), (c, s, 0, 0))


def _loose_nut(flats: float, length: float, bore: float):
    """A connector's coupling nut alone, lying on a flat, bored through."""

    def build(body, kind: str) -> None:
        z = flats / 2
        _hexagon(body, kind, flats, length / 2, 0.0, z)
        _add(body, CYLINDER, f"{kind}_dark", (bore / 2, length / 2 + 2e-4, 0), (0, 0, z), ALONG_X)

    return build


def _hex_nut(flats: float, thickness: float):
    """A plain nut lying flat: its hole looks up."""

    def build(body, kind: str) -> None:
        for k in range(3):
            yaw = k * np.pi / 6
            size = (flats / (2 * np.sqrt(3)), flats / 2, thickness / 2)
            quat = (np.cos(yaw), 0, 0, np.sin(yaw))
            _add(body, BOX, kind, size, (0, 0, thickness / 2), quat)
        hole = (flats * 0.3, thickness / 2 + 2e-4, 0)
        _add(body, CYLINDER, f"{kind}_dark", hole, (0, 0, thickness / 2))

    return build


def _screw(head: float, shaft: float, length: float):
    def build(body, kind: str) -> None:
        z = head / 2
        _hexagon(body, kind, head, 0.2 * head, 0.0, z)
        size = (shaft / 2, length / 2, 0)
        _add(body, CYLINDER, kind, size, (0.2 * head + length / 2, 0, z), ALONG_X)

    return build


def _washer(body, kind: str) -> None:
    _add(body, CYLINDER, kind, (0.012, 0.001, 0), (0, 0, 0.001))
    _add(body, CYLINDER, f"{kind}_dark", (0.0065, 0.0012, 0), (0, 0, 0.001))


def _cap(body, kind: str) -> None:
    _add(body, CYLINDER, kind, (0.009, 0.007, 0), (0, 0, 0.009), ALONG_X)
    _add(body, CYLINDER, f"{kind}_dark", (0.0075, 0.0072, 0), (0, 0, 0.009), ALONG_X)


def _rod(body, kind: str) -> None:
    _add(body, CYLINDER, kind, (0.005, 0.020, 0), (0, 0, 0.005), ALONG_X)


def _block(body, kind: str) -> None:
    _add(body, BOX, kind, (0.014, 0.010, 0.008), (0, 0, 0.008))


def _ball(body, kind: str) -> None:
    _add(body, SPHERE, kind, (0.009, 0, 0), (0, 0, 0.009))


def _cable(body, kind: str) -> None:
    _add(body, CAPSULE, kind, (0.003, 0.030, 0), (0.0, 0.0, 0.003), ALONG_X)
    yawed = (np.cos(0.4), 0, 0, np.sin(0.4))
    turned = np.empty(4)
    mujoco.mju_mulQuat(turned, np.array(yawed), np.array(ALONG_X))
    _add(body, CAPSULE, kind, (0.003, 0.022, 0), (0.045, 0.015, 0.003), tuple(turned))


def _bar(body, kind: str) -> None:
    _add(body, BOX, kind, (0.05, 0.010, 0.010))


KINDS = {
    "n_nut": _loose_nut(0.01905, 0.017, 0.0159),
    "tnc_nut": _loose_nut(0.01429, 0.013, 0.0111),
    "nut_m10": _hex_nut(0.017, 0.008),
    "nut_m16": _hex_nut(0.024, 0.013),
    "screw_m8": _screw(0.013, 0.008, 0.025),
    "screw_m6": _screw(0.010, 0.006, 0.018),
    "washer": _washer,
    "cap": _cap,
    "rod": _rod,
    "block": _block,
    "ball": _ball,
    "cable": _cable,
    OCCLUDER: _bar,
}

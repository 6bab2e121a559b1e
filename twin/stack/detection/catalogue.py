"""The drawings of the connector classes, lying in the resting pose in which they are fed.

Part frame: x along the axis towards the N (or TNC) nut, for a tee along its through bore with the
stem on +y; z up; origin on the belt under the centroid of the outline seen from above. The numbers
are those of models/connectors/README.md, which names their sources; a test compares them with the
models. All lengths here in millimetres until `_drawing` turns them to metres.
"""

import numpy as np

from twin.geometry import Array
from twin.messages import PartClass
from twin.stack.config import PartDrawing

N_FLATS, N_TURNED = 19.05, 20.5  # coupling nuts: across flats, turned diameter over the corners
TNC_FLATS, TNC_TURNED = 14.29, 15.4
SMA_FLATS, SMA_TURNED = 7.94, 8.8
SMA_THREAD, N_THREAD = 6.55, 15.88
BRANCHES = (("x", 1), ("x", -1), ("y", 1))  # of a tee


def _prism(axis: str, start: float, end: float, section: Array, height: float) -> Array:
    """Corners of a prism along x or y with a (lateral, vertical) section about the axis height."""
    ends = np.repeat([start, end], len(section))
    lateral, vertical = np.tile(section[:, 0], 2), np.tile(section[:, 1], 2) + height
    columns = (ends, lateral, vertical) if axis == "x" else (lateral, ends, vertical)
    return np.column_stack(columns)


def _round(axis: str, start: float, end: float, diameter: float, height: float) -> Array:
    angle = np.arange(16) * (2 * np.pi / 16)
    section = diameter / 2 * np.column_stack([np.cos(angle), np.sin(angle)])
    return _prism(axis, start, end, section, height)


def _nut(axis: str, start: float, end: float, flats: float, turned: float, height: float) -> Array:
    """Hexagon lying on a flat, its corners turned down to a diameter."""
    flat, corner = flats / 2, turned / 2
    half_flat = 2 * corner - np.sqrt(3) * flat
    angle = np.arange(6) * (np.pi / 3)
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    ends = np.array([-half_flat, half_flat])
    section = np.stack([ends * cos - flat * sin, ends * sin + flat * cos], axis=-1).reshape(-1, 2)
    return _prism(axis, start, end, section, height)


def _block(low, high) -> Array:
    corners = [
        (x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])
    ]
    return np.array(corners, dtype=float)


def _drawing(
    origin: tuple[float, float],
    solids: list[Array],
    grasp: tuple[float, float, float],
    grip_width: float,
    mass: float,
) -> PartDrawing:
    """Drawing from solids in millimetres; `origin` is the part frame's in their coordinates."""
    shift = np.array([*origin, 0.0])
    metres = tuple((s - shift) / 1000.0 for s in solids)
    corners = np.concatenate(metres)
    extent = corners.max(axis=0) - corners.min(axis=0)
    x, y, z = (np.array(grasp) - shift) / 1000.0
    return PartDrawing(
        length=float(extent[0]),
        width=float(extent[1]),
        height=float(corners[:, 2].max()),
        grasp_x=float(x),
        grasp_y=float(y),
        grasp_z=float(z),
        grip_width=grip_width / 1000.0,
        grip_yaw=np.pi / 2,  # every class is gripped across its x axis
        symmetric=False,
        mass=mass,
        solids=metres,
    )


def _adapter_n(sma_male: bool) -> PartDrawing:
    """N male to SMA; the N face at 0, the rest on -x. Gripped across the N nut's corners."""
    z = N_FLATS / 2
    solids = [
        _round("x", -1.2, 0, 19.0, z),
        _nut("x", -17, -1.2, N_FLATS, N_TURNED, z),
        _round("x", -18, -17, 17.2, z),
        _round("x", -21, -18, 15.0, z),
    ]
    if sma_male:
        solids += [
            _round("x", -23.5, -21, 7.0, z),
            _nut("x", -32.4, -23.5, SMA_FLATS, SMA_TURNED, z),
            _round("x", -33, -32.4, 7.6, z),
        ]
        return _drawing((-13.49, 0), solids, (-10.0, 0, 9.5), N_TURNED, 0.0255)
    solids += [_round("x", -23, -21, 11.0, z), _round("x", -32, -23, SMA_THREAD, z)]
    return _drawing((-12.71, 0), solids, (-10.0, 0, 9.5), N_TURNED, 0.0260)


def _adapter_tnc() -> PartDrawing:
    z = TNC_FLATS / 2
    solids = [
        _round("x", -1, 0, 14.2, z),
        _nut("x", -13, -1, TNC_FLATS, TNC_TURNED, z),
        _round("x", -17, -13, 10.5, z),
        _round("x", -26, -17, SMA_THREAD, z),
    ]
    return _drawing((-10.62, 0), solids, (-8.0, 0, 8.0), TNC_TURNED, 0.0148)


def _tee_male() -> PartDrawing:
    """Gripped along the stem: between the stem's face and the flat back of the body."""
    z = N_FLATS / 2
    solids = [_block((-11, -11, z - 8), (11, 11, z + 8))]
    for axis, sign in BRANCHES:
        solids.append(_nut(axis, sign * 11, sign * 18.8, N_FLATS, N_TURNED, z))
        solids.append(_round(axis, sign * 18.8, sign * 20, 19.0, z))
    return _drawing((0, 2.75), solids, (0, 2.75, 9.5), 31.0, 0.0801)


def _tee_female() -> PartDrawing:
    z = 8.0
    solids = [_block((-8, -8, 0), (8, 8, 16))]
    for axis, sign in BRANCHES:
        solids.append(_round(axis, sign * 8, sign * 20, N_THREAD, z))
    return _drawing((0, 3.23), solids, (0, 3.23, 9.0), 28.0, 0.0683)


CATALOGUE: dict[PartClass, PartDrawing] = {
    "sma_f_n_m": _adapter_n(sma_male=False),
    "sma_m_n_m": _adapter_n(sma_male=True),
    "tnc_m_sma_f": _adapter_tnc(),
    "n_tee_m_mm": _tee_male(),
    "n_tee_fff": _tee_female(),
}

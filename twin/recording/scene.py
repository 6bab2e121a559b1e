"""The cell's shapes as rerun entities: drawn once, then moved body by body."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from twin.geometry import Array, rotation_from_quat

if TYPE_CHECKING:  # the plant brings the simulator, which a reader of recordings may not have
    from twin.plant.shapes import Shape

GROUPS = {0: "hall", 1: "line", 2: "vehicle", 4: "parts"}


def body_entities(shapes: Iterable["Shape"]) -> dict[int, str]:
    """Entity of each body that can be seen."""
    return {
        s.body: f"world/{GROUPS.get(s.group, 'other')}/{s.body_name.replace('/', '_') or s.body}"
        for s in shapes
    }


def draw(recording: rr.RecordingStream, shapes: Sequence["Shape"]) -> None:
    """Log all shapes once, each in its body's frame."""
    entities = body_entities(shapes)
    by_kind: dict[tuple[int, str], list[Shape]] = {}
    for shape in shapes:
        by_kind.setdefault((shape.body, shape.kind), []).append(shape)
    for (body, kind), members in by_kind.items():
        entity = f"{entities[body]}/{kind}"
        if kind != "mesh":
            recording.log(entity, _primitives(kind, members), static=True)
            continue
        for i, shape in enumerate(members):
            quat = rr.Quaternion(xyzw=_xyzw(shape.quat_wxyz))
            placed = rr.Transform3D(translation=shape.position, quaternion=quat)
            recording.log(f"{entity}{i}", placed, _mesh(shape), static=True)


def _primitives(kind: str, shapes: Sequence["Shape"]):
    size = np.array([s.size for s in shapes])
    center = np.array([s.position for s in shapes])
    common = {
        "quaternions": [_xyzw(s.quat_wxyz) for s in shapes],
        "colors": [_colour(s) for s in shapes],
        "fill_mode": "solid",
    }
    if kind == "cylinder":
        lengths = 2 * size[:, 1]
        return rr.Cylinders3D(lengths=lengths, radii=size[:, 0], centers=center, **common)
    if kind == "capsule":
        # rerun's capsule starts at its origin, MuJoCo's is centred on it.
        axes = [rotation_from_quat(s.quat_wxyz)[:, 2] for s in shapes]
        start = center - size[:, 1:2] * np.array(axes)
        lengths = 2 * size[:, 1]
        return rr.Capsules3D(lengths=lengths, radii=size[:, 0], translations=start, **common)
    if kind in ("ellipsoid", "sphere"):
        half = size if kind == "ellipsoid" else np.repeat(size[:, :1], 3, axis=1)
        return rr.Ellipsoids3D(half_sizes=half, centers=center, **common)
    if kind == "plane":  # half sizes of 0 mean that it has no end
        half = np.where(size[:, :2] > 0, size[:, :2], 10.0)
        half = np.column_stack([half, np.full(len(half), 1e-3)])
        return rr.Boxes3D(half_sizes=half, centers=center - (0, 0, 1e-3), **common)
    return rr.Boxes3D(half_sizes=size, centers=center, **common)


def _mesh(shape: "Shape") -> rr.Mesh3D:
    """A mesh with a normal at each vertex, or it would not be shaded."""
    assert shape.vertices is not None and shape.faces is not None
    a, b, c = (shape.vertices[shape.faces[:, i]] for i in range(3))
    normals = np.zeros_like(shape.vertices)
    for i in range(3):
        np.add.at(normals, shape.faces[:, i], np.cross(b - a, c - a))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return rr.Mesh3D(
        vertex_positions=shape.vertices,
        triangle_indices=shape.faces,
        vertex_normals=normals,
        albedo_factor=_colour(shape),
    )


def _colour(shape: "Shape") -> NDArray[np.uint8]:
    return np.round(255 * np.asarray(shape.rgba)).astype(np.uint8)


def _xyzw(quat_wxyz) -> Array:
    return np.roll(quat_wxyz, -1)

"""The model's geometry in plain numpy, so that a recorder needs no simulator."""

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array

KINDS = {
    mujoco.mjtGeom.mjGEOM_PLANE: "plane",
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: "ellipsoid",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_BOX: "box",
    mujoco.mjtGeom.mjGEOM_MESH: "mesh",
}


@dataclass(frozen=True)
class Shape:
    """One primitive on a body. Sizes as MuJoCo's: half lengths; capsule and cylinder along z."""

    name: str
    body: int
    body_name: str
    kind: str  # plane, sphere, capsule, ellipsoid, cylinder, box, mesh
    size: Array  # (3,) m; radius and half length for capsule and cylinder
    position: Array  # (3,) in the body
    quat_wxyz: Array  # (4,) in the body
    rgba: Array  # (4,)
    group: int  # 0 hall, 1 line and stations, 2 vehicle and arms, 3 collision only, 4 parts
    vertices: Array | None = None  # (n, 3) of a mesh
    faces: NDArray[np.int32] | None = None  # (m, 3)


def shapes_of(model: mujoco.MjModel) -> tuple[Shape, ...]:
    """All geoms that are drawn (group 3 is collision only and left out)."""
    return tuple(_shape(model, g) for g in range(model.ngeom) if model.geom_group[g] != 3)


def _shape(model: mujoco.MjModel, g: int) -> Shape:
    body, material = int(model.geom_bodyid[g]), int(model.geom_matid[g])
    mesh = int(model.geom_dataid[g]) if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH else -1
    vertices = faces = None
    if mesh >= 0:
        v, f = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
        vertices = model.mesh_vert[v : v + model.mesh_vertnum[mesh]].astype(float)
        faces = model.mesh_face[f : f + model.mesh_facenum[mesh]].copy()
    return Shape(
        name=model.geom(g).name,
        body=body,
        body_name=model.body(body).name,
        kind=KINDS[mujoco.mjtGeom(model.geom_type[g])],
        size=model.geom_size[g].copy(),
        position=model.geom_pos[g].copy(),
        quat_wxyz=model.geom_quat[g].copy(),
        rgba=np.array(model.mat_rgba[material] if material >= 0 else model.geom_rgba[g], float),
        group=int(model.geom_group[g]),
        vertices=vertices,
        faces=faces,
    )

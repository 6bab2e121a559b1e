"""Composes the models into one world: hall, line, stations, racks, vehicle, arms and parts."""

from pathlib import Path

import mujoco
import numpy as np

from twin.geometry import Array, inverse, quat_wxyz, rot_x, rotation_from_quat, transform
from twin.layout import Layout, models_dir
from twin.messages import PART_CLASSES, PartClass
from twin.plant.as_built import AsBuilt
from twin.plant.assembly import MASKS, attach, set_masks
from twin.plant.beacons import add_network
from twin.plant.fault_plan import check_faults
from twin.plant.floor_tags import add_floor_tags
from twin.plant.hall import hall
from twin.plant.model_files import load_model
from twin.plant.obstacles import add_movers, add_obstacles
from twin.plant.parcel import add_parcel
from twin.plant.site_as_built import SiteAsBuilt
from twin.plant.warehouse import add_warehouse
from twin.site import Line

SPARE = 5  # parts of each class in the feeder's store beyond those that are ordered
WHEELS = ("fl", "fr", "rl", "rr")


def build(
    layout: Layout,
    as_built: AsBuilt,
    pool: int | None = None,
    models: Path | None = None,
    parcel: bool = False,
) -> mujoco.MjSpec:
    """The whole cell as one editable model, not yet compiled.

    Args:
        layout: what stands where.
        as_built: deviations of the machine from the drawing.
        pool: number of parts of each class in the feeder's store; None lets the order decide.
        models: folder of the models, the installed one by default.
        parcel: whether one lies at goods-in.

    Raises:
        LayoutError: a model file is missing, or names a file outside the folder of the models; or
            a fault cannot come about.
    """
    root = models or models_dir()
    check_faults(layout)
    built = SiteAsBuilt(layout.world.tolerances, as_built.floor_seed)
    spec = hall(layout, built)
    add_floor_tags(spec, layout, as_built.floor_seed)
    line = load_model(root, "line/line.xml")
    _resize_line(line, layout.site.line)
    line.geom("belt").friction[0] = layout.world.line.friction
    origin = (*layout.site.line.origin, layout.site.line.direction)
    attach(spec, line, built.machine("belt", origin), "line/", MASKS["standing"])
    dock = built.machine("dock", layout.site.dock)
    for name, pose in (
        ("receiving", built.machine("receiving", layout.site.receiving)),
        ("dock", dock),
    ):
        station = load_model(root, f"station/{name}.xml")
        attach(spec, station, pose, f"{name}/", MASKS["standing"])
    add_warehouse(spec, layout, as_built.floor_seed, built, root)
    _attach_vehicle(spec, root, dock, as_built)
    if layout.world.beacons.fitted:
        add_network(spec, layout, as_built, root)
    add_obstacles(spec, layout.world.faults.obstacles, root)
    add_movers(spec, layout.world.faults.movers, root)
    store = pool_counts(layout) if pool is None else dict.fromkeys(PART_CLASSES, pool)
    _attach_parts(spec, root, store)
    if parcel:
        add_parcel(spec, layout, as_built.floor_seed, built, root)
    return spec


def _resize_line(spec: mujoco.MjSpec, line: Line) -> None:
    """Bring the drawn conveyor (2.5 x 0.2 m, face at 0.70 m) to the layout's size."""
    belt = spec.geom("belt")
    dl = line.length - 2 * belt.size[0]
    dw = line.width / 2 - belt.size[1]
    dh = line.height - (belt.pos[2] + belt.size[2])
    for name in ("belt", "bed", "rail_left", "rail_right"):
        geom = spec.geom(name)
        geom.pos[0] += dl / 2
        geom.size[0] += dl / 2
    for name in ("belt", "bed"):
        spec.geom(name).size[1] += dw
    spec.body("downstream").pos[0] += dl
    for geom in spec.geoms:
        if geom.name.startswith(("leg", "bin")):  # these stand on the floor
            if geom.name.startswith("leg"):
                geom.size[2] += dh / 2
                geom.pos[2] += dh / 2
        else:
            geom.pos[2] += dh
        if geom.name.startswith("bin"):
            continue
        if geom.name in ("hood_top", "drum_up", "drum_down"):
            geom.size[1] += dw
        elif geom.name.startswith(("rail", "leg", "hood_left", "hood_right", "drive")):
            geom.pos[1] += np.sign(geom.pos[1]) * dw


def _attach_vehicle(spec: mujoco.MjSpec, root: Path, dock: Array, as_built: AsBuilt) -> None:
    agv = load_model(root, "agv/agv.xml")
    _deviate(agv, as_built)
    attach(spec, agv, dock + as_built.dock, "agv/", MASKS["vehicle"])
    for i in range(2):
        arm = load_model(root, "arm/arm.xml")
        set_masks(arm, MASKS["arm"])
        spec.attach(arm, site=spec.site(f"agv/arm{i}_mount"), prefix=f"arm{i}/")


def _deviate(agv: mujoco.MjSpec, as_built: AsBuilt) -> None:
    """Apply the deviations as built to the drawing of the vehicle."""
    for i, wheel in enumerate(WHEELS):
        body = agv.body(f"wheel_{wheel}")
        body.pos[1] += np.sign(body.pos[1]) * as_built.half_track
        for roller in agv.bodies:
            if roller.name.startswith(f"roller_{wheel}_"):
                radius = np.linalg.norm(roller.pos)
                roller.pos = roller.pos * (1 + as_built.wheel_radius[i] / radius)
    flip = transform(rot_x(np.pi), (0, 0, 0))  # MuJoCo looks along -z, the optical frame along z
    _move(agv.body("mast_camera"), flip @ as_built.camera_mount @ inverse(flip))
    _move(agv.body("rgbd"), flip @ as_built.rgbd_mount @ inverse(flip))
    _move(agv.body("tag_camera"), flip @ as_built.tag_camera_mount @ inverse(flip))
    _set_intrinsics(agv.camera("mast_camera"), as_built.camera_focal, as_built.camera_centre)
    _set_intrinsics(agv.camera("rgbd"), as_built.rgbd_focal, as_built.rgbd_centre)
    _set_intrinsics(agv.camera("tag_camera"), as_built.tag_camera_focal, as_built.tag_camera_centre)


def _set_intrinsics(camera, focal: float, centre: Array) -> None:
    """Give a camera the lens that it was built with.

    Args:
        camera: as drawn, by its field of view.
        focal: factor on the drawn focal length.
        centre: u and v by which the principal point lies off the middle of the picture, px.
    """
    width, height = (int(v) for v in camera.resolution)
    # a longer focal length f = h / (2 tan(fovy / 2)) narrows the view
    pixels = focal * 0.5 * height / np.tan(np.radians(camera.fovy) / 2)
    camera.fovy = float(np.degrees(2 * np.arctan(0.5 * height / pixels)))
    if np.any(centre):
        camera.sensor_size = 1e-6 * np.array([width, height])  # pixels of a micrometre
        camera.focal_pixel = (pixels, pixels)
        camera.principal_pixel = -centre  # MuJoCo has the picture move against it


def _move(element, T_drawn_true) -> None:
    """Shift a body within its parent: `T_parent_true = T_parent_drawn @ T_drawn_true`."""
    quat = element.quat
    if element.alt.type == mujoco.mjtOrientation.mjORIENTATION_XYAXES:
        axes = np.array(element.alt.xyaxes).reshape(2, 3)
        x, y = axes / np.linalg.norm(axes, axis=1, keepdims=True)
        rotation = np.column_stack([x, y, np.cross(x, y)])
        element.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    else:
        rotation = rotation_from_quat(quat)
    T = transform(rotation, element.pos) @ T_drawn_true
    element.pos, element.quat = T[:3, 3], quat_wxyz(T[:3, :3])


def store_pose(index: int) -> np.ndarray:
    """Where a part waits in the feeder's store: below the floor, out of sight. Shape (3,)."""
    return np.array([0.15 * (index % 9), 0.15 * (index // 9), -1.0])


def pool_counts(layout: Layout) -> dict[PartClass, int]:
    """Parts of each class that the store needs for a layout's order."""
    return {c: layout.world.order.get(c, 0) + SPARE for c in PART_CLASSES}


def _attach_parts(spec: mujoco.MjSpec, root: Path, pool: dict[PartClass, int]) -> None:
    stored = 0
    for name in PART_CLASSES:
        part = load_model(root, f"connectors/{name}/{name}.xml")
        set_masks(part, MASKS["part"])
        for geom in part.geoms:
            geom.group = 4
        child = part.worldbody.first_body()
        for k in range(pool[name]):
            frame = spec.worldbody.add_frame(pos=store_pose(stored))
            stored += 1
            body = frame.attach_body(child, f"{name}_{k}/", "")
            body.name = f"part_{name}_{k}"
            for joint in list(body.joints):
                spec.delete(joint)
            body.add_freejoint(name=body.name)
            # Asleep in the store: costs nothing until the feeder writes its state.
            body.sleep = mujoco.mjtSleepPolicy.mjSLEEP_INIT

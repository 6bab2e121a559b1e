"""Model files: they run, are the drawing that the stack believes in, and keep to their folder."""

import shutil

import mujoco
import numpy as np
import pytest

from twin.floor_plan import FOOTPRINT
from twin.geometry import rot_x, transform
from twin.layout import LayoutError, load_layout, models_dir
from twin.plant import factory
from twin.plant.actuators import wheel_drive
from twin.plant.as_built import AsBuilt
from twin.plant.sensors import encoders
from twin.stack.config import Camera, Tray, Wheels, arm_mounts, nominal_config
from twin.stack.control_unit.wheel_pid import MotorDrawing

MODELS = sorted(p.relative_to(models_dir()).as_posix() for p in models_dir().rglob("*.xml"))
FLIP = transform(rot_x(np.pi), (0, 0, 0))  # optical frame to MuJoCo's camera frame


def nominal():
    """The whole cell with every tolerance at zero, at its reference pose."""
    exact = ("world.tolerances.scale=0", "world.tolerances.dock_xy=0")
    layout = load_layout(None, (*exact, "world.tolerances.dock_yaw_deg=0"))
    as_built = AsBuilt.draw(np.random.default_rng(0), layout.world.tolerances)
    model = factory.build(layout, as_built, pool=1).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return layout, model, data


@pytest.mark.parametrize("name", MODELS)
def test_model_steps_without_a_warning(name):
    model = mujoco.MjModel.from_xml_path(str(models_dir() / name))
    data = mujoco.MjData(model)
    for _ in range(300):
        mujoco.mj_step(model, data)
    assert not data.warning.number.any()
    assert np.isfinite(data.qpos).all()
    assert data.time == pytest.approx(300 * model.opt.timestep)


def test_wheels_are_the_drawing():
    _, model, data = nominal()
    wheels = Wheels()
    for name, sx, sy in (("fl", 1, 1), ("fr", 1, -1), ("rl", -1, 1), ("rr", -1, -1)):
        x, y, z = data.xpos[model.body(f"agv/wheel_{name}").id]
        np.testing.assert_allclose((x, y), (sx * wheels.half_base, sy * wheels.half_track))
        rollers = [b for b in range(model.nbody) if f"/roller_{name}_" in model.body(b).name]
        assert len(rollers) == wheels.rollers
        lowest = min(data.xpos[b][2] for b in rollers) - 0.017
        assert lowest == pytest.approx(0.0, abs=1e-9)
        # the calibrated rolling radius is the drawn one, less what the rubber gives
        assert wheels.radius == pytest.approx(z, rel=0.002)
        actuator = model.actuator(f"agv/wheel_{name}")
        assert actuator.gear[0] == wheels.gear_ratio
        assert actuator.ctrlrange[1] == wheel_drive.SUPPLY == MotorDrawing().supply
        assert actuator.gainprm[0] == MotorDrawing().resistance
        assert actuator.gainprm[1] == MotorDrawing().torque_constant
        joint = model.joint(f"agv/wheel_{name}")
        assert model.dof_frictionloss[joint.dofadr[0]] == MotorDrawing().friction
    assert wheels.counts_per_turn * wheels.gear_ratio == encoders.COUNTS_PER_WHEEL_TURN


def test_mounts_and_cameras_are_the_drawing():
    layout, model, data = nominal()
    config = nominal_config(layout.site, layout.options)
    for i, T in enumerate(arm_mounts()):
        site = model.site(f"agv/arm{i}_mount").id
        np.testing.assert_allclose(data.site_xpos[site], T[:3, 3], atol=1e-9)
        np.testing.assert_allclose(data.site_xmat[site].reshape(3, 3), T[:3, :3], atol=1e-9)
        mount = model.body(f"arm{i}/mount").id
        np.testing.assert_allclose(data.xpos[mount], T[:3, 3], atol=1e-9)
        np.testing.assert_allclose(data.xmat[mount].reshape(3, 3), T[:3, :3], atol=1e-9)
    lidar = model.site("agv/lidar").id
    np.testing.assert_allclose(data.site_xpos[lidar], config.T_base_lidar[:3, 3])
    drawn: list[tuple[str, Camera]] = [
        ("mast_camera", config.camera),
        ("rgbd", config.rgbd),
        ("tag_camera", config.tag_camera),
    ]
    for name, camera in drawn:
        c = model.camera(f"agv/{name}").id
        T = camera.T_base_camera @ FLIP
        np.testing.assert_allclose(data.cam_xpos[c], T[:3, 3], atol=1e-9)
        np.testing.assert_allclose(data.cam_xmat[c].reshape(3, 3), T[:3, :3], atol=1e-9)
        assert model.cam_fovy[c] == pytest.approx(camera.fovy_deg)
        assert tuple(model.cam_resolution[c]) == (camera.width, camera.height)


def test_tray_is_the_drawing():
    _, model, data = nominal()
    tray = Tray()
    floor = model.geom("agv/tray_floor")
    assert data.geom_xpos[floor.id][2] + floor.size[2] == pytest.approx(tray.floor)
    for axis, centres, walls in ((0, tray.columns, 6), (1, tray.rows, 8)):
        name = "xy"[axis]
        geoms = [model.geom(f"agv/tray_wall_{name}{i}") for i in range(walls)]
        at = np.array([data.geom_xpos[g.id][axis] for g in geoms])
        for centre in centres:  # a wall stands half a pitch to either side of each slot
            for side in (-1, 1):
                np.testing.assert_allclose(
                    np.min(np.abs(at - centre - side * tray.pitch / 2)), 0.0, atol=1e-9
                )
        for g in geoms:
            top = data.geom_xpos[g.id][2] + g.size[2]
            assert top == pytest.approx(tray.floor + tray.wall)


def test_vehicle_keeps_its_size_and_mass():
    _, model, data = nominal()
    base = model.body("agv/base").id
    own = [b for b in range(model.nbody) if model.body(b).name.startswith("agv/")]
    corners = []
    for g in np.flatnonzero(np.isin(model.geom_bodyid, own)):
        R, half = data.geom_xmat[g].reshape(3, 3), model.geom_size[g].copy()
        if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_CYLINDER:
            half = np.array([half[0], half[0], half[1]])
        if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
            reach = np.linalg.norm(R * half, axis=1)
        else:
            reach = np.abs(R) @ half
        corners += [data.geom_xpos[g] - reach, data.geom_xpos[g] + reach]
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    assert (high[:2] <= np.array(FOOTPRINT) / 2 + 1e-9).all()
    assert (low[:2] >= -np.array(FOOTPRINT) / 2 - 1e-9).all()
    assert high[2] <= 1.0
    platform = sum(model.body_mass[b] for b in own)
    assert platform == pytest.approx(42.0, abs=0.5)
    assert model.body_subtreemass[base] == pytest.approx(60.0, abs=5.0)


def test_deviations_move_what_they_name():
    layout, drawn_model, drawn = nominal()
    as_built = AsBuilt.draw(
        np.random.default_rng(3), layout.world.tolerances.model_copy(update={"scale": 1.0})
    )
    model = factory.build(layout, as_built, pool=1).compile()
    data = mujoco.MjData(model)
    data.qpos[:] = drawn.qpos  # the same dock pose
    mujoco.mj_forward(model, data)
    c = model.camera("agv/mast_camera").id
    true = transform(data.cam_xmat[c].reshape(3, 3), data.cam_xpos[c])
    ideal = transform(drawn.cam_xmat[c].reshape(3, 3), drawn.cam_xpos[c])
    optical = np.linalg.inv(ideal @ FLIP) @ true @ FLIP
    np.testing.assert_allclose(optical, as_built.camera_mount, atol=1e-9)
    focal = [1 / np.tan(np.radians(m.cam_fovy[c]) / 2) for m in (model, drawn_model)]
    assert focal[0] / focal[1] == pytest.approx(as_built.camera_focal)
    wheel = model.body("agv/wheel_rr").id
    moved = drawn.xpos[wheel][1] - data.xpos[wheel][1]
    assert moved == pytest.approx(as_built.half_track)
    roller = model.body("agv/roller_rr_00").id
    arm = np.linalg.norm(data.xpos[roller] - data.xpos[wheel])
    assert arm - 0.059 == pytest.approx(as_built.wheel_radius[3])


@pytest.fixture
def copied_models(tmp_path):
    return shutil.copytree(models_dir(), tmp_path / "models")


def test_missing_model_is_one_clear_line(copied_models):
    (copied_models / "line" / "line.xml").unlink()
    with pytest.raises(LayoutError, match=r"line\.xml: model file is missing") as error:
        factory.load_model(copied_models, "line/line.xml")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "element",
    [
        '<include file="../../outside.xml"/>',
        '<include file="/etc/passwd"/>',
        '<asset><mesh name="m" file="../../outside.obj"/></asset>',
        '<asset><texture name="t" type="2d" file="../../outside.png"/></asset>',
    ],
)
def test_file_outside_the_models_folder_is_refused(copied_models, element):
    path = copied_models / "line" / "line.xml"
    path.write_text(path.read_text().replace("<worldbody>", element + "<worldbody>", 1))
    with pytest.raises(LayoutError, match="outside the models' folder") as error:
        factory.load_model(copied_models, "line/line.xml")
    assert "\n" not in str(error.value)


def test_broken_model_is_one_clear_line(copied_models):
    (copied_models / "line" / "line.xml").write_text("<mujoco><worldbody>")
    with pytest.raises(LayoutError, match="not an MJCF file"):
        factory.load_model(copied_models, "line/line.xml")


@pytest.mark.parametrize(("length", "width", "height"), [(2.5, 0.2, 0.7), (2.2, 0.26, 0.72)])
def test_line_takes_the_layouts_size(length, width, height):
    sizes = {"length": length, "width": width, "height": height}
    drawn = (*(f"site.line.{k}={v}" for k, v in sizes.items()), "world.tolerances.scale=0")
    layout = load_layout(None, drawn)
    as_built = AsBuilt.draw(np.random.default_rng(0), layout.world.tolerances)
    model = factory.build(layout, as_built, pool=1).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    belt, rail = model.geom("line/belt"), model.geom("line/rail_left")
    np.testing.assert_allclose(2 * belt.size[:2], (length, width))
    top = data.geom_xpos[belt.id][2] + belt.size[2]
    assert top == pytest.approx(height)
    # rails stand 5 mm below the face, so that a hand over the edge of the belt does not meet them
    assert data.geom_xpos[rail.id][2] + rail.size[2] == pytest.approx(height - 0.005)
    x, y = layout.site.line.origin
    far = (x, y - length)
    np.testing.assert_allclose(data.xpos[model.body("line/downstream").id][:2], far, atol=1e-6)

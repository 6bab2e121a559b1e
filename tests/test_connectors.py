"""The connector models: they equal the catalogue, lie still, ride the belt and fit the gripper."""

import mujoco
import numpy as np
import pytest

from twin.layout import models_dir
from twin.messages import PART_CLASSES
from twin.stack.config import Gripper, Tray
from twin.stack.detection.catalogue import CATALOGUE

PLANE_Z = 0.0


def scene(part_class: str, belt_speed: float = 0.0) -> tuple[mujoco.MjModel, mujoco.MjData]:
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.002
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10
    belt = spec.worldbody.add_geom(
        name="belt",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=(2, 2, 0.002),
        pos=(0, 0, PLANE_Z - 0.002),
        friction=(0.9, 0.005, 0.0001),
        contype=2,
        conaffinity=0,
    )
    belt.surfacevel[0] = 1e-9
    file = models_dir() / "connectors" / part_class / f"{part_class}.xml"
    child = mujoco.MjSpec.from_file(str(file))
    body = spec.worldbody.add_frame().attach_body(child.worldbody.first_body(), "p/", "")
    body.name = "part"
    body.add_freejoint(name="part")
    model = spec.compile()
    model.geom_surfacevel[model.geom("belt").id, 0] = belt_speed
    return model, mujoco.MjData(model)


def seen_corners(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Corners of all visible geoms of the part in world. Shape (n, 3)."""
    corners = []
    for g in range(model.ngeom):
        if model.geom_bodyid[g] == 0 or model.geom_group[g] != 4:
            continue
        size = model.geom_size[g]
        if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX:
            signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
            local = signs * size
        else:
            a = np.linspace(0, 2 * np.pi, 65)
            ring = np.column_stack([size[0] * np.cos(a), size[0] * np.sin(a), 0 * a])
            half = np.array([0, 0, size[1]])
            local = np.concatenate([ring + half, ring - half])
        corners.append(local @ data.geom_xmat[g].reshape(3, 3).T + data.geom_xpos[g])
    return np.concatenate(corners)


@pytest.mark.parametrize("part_class", PART_CLASSES)
def test_model_equals_catalogue(part_class):
    model, data = scene(part_class)
    mujoco.mj_forward(model, data)
    drawing = CATALOGUE[part_class]
    corners = seen_corners(model, data)
    low, high = corners.min(axis=0), corners.max(axis=0)
    # mouths of the connectors stand out by at most 0.2 mm, so that they are drawn
    np.testing.assert_allclose(
        high - low, (drawing.length, drawing.width, drawing.height), atol=4e-4
    )
    assert abs(low[2]) < 1e-5
    assert model.body("part").mass[0] == pytest.approx(drawing.mass, abs=1e-4)
    drawn = np.concatenate(drawing.solids)
    np.testing.assert_allclose(drawn.min(axis=0), low, atol=3e-4)
    np.testing.assert_allclose(drawn.max(axis=0), high, atol=3e-4)


@pytest.mark.parametrize("part_class", PART_CLASSES)
def test_size_is_within_the_source_range_and_fits_gripper_and_tray(part_class):
    drawing = CATALOGUE[part_class]
    assert 0.014 <= max(drawing.length, drawing.width) <= 0.0401
    assert drawing.grip_width < Gripper().stroke - 0.010
    slot = Tray().pitch - Tray().wall
    assert np.hypot(drawing.length, drawing.width) < slot


@pytest.mark.parametrize("part_class", PART_CLASSES)
def test_rides_the_belt_without_slip_or_roll(part_class):
    model, data = scene(part_class, belt_speed=0.15)
    rng = np.random.default_rng(3)
    for yaw in rng.uniform(-np.pi, np.pi, 3):
        mujoco.mj_resetData(model, data)
        data.qpos[:7] = (0, 0, PLANE_Z, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2))
        data.qvel[0] = 0.15
        for _ in range(1000):
            mujoco.mj_step(model, data)
        moved = data.qpos[:3] - (0.15 * data.time, 0, PLANE_Z)
        assert np.abs(moved).max() < 2e-4
        assert abs(data.qpos[0] - 0.30) < 1e-4
        turned = 2 * np.arctan2(data.qpos[6], data.qpos[3])
        assert abs(np.remainder(turned - yaw + np.pi, 2 * np.pi) - np.pi) < np.radians(0.1)
        assert np.abs(data.qvel - (0.15, 0, 0, 0, 0, 0)).max() < 1e-3
        assert not data.warning.number.any()


@pytest.mark.parametrize("part_class", PART_CLASSES)
def test_dropped_part_comes_to_rest(part_class):
    model, data = scene(part_class)
    rng = np.random.default_rng(5)
    for _ in range(6):
        mujoco.mj_resetData(model, data)
        quat = rng.normal(size=4)
        data.qpos[:7] = (0, 0, 0.05, *(quat / np.linalg.norm(quat)))
        for _ in range(1500):
            mujoco.mj_step(model, data)
        assert np.abs(data.qvel).max() < 0.01
        assert not data.warning.number.any()

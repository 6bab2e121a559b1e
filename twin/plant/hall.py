"""The empty hall: physics options, light, floor, walls and partitions."""

import mujoco
import numpy as np

from twin.floor_plan import PANEL
from twin.layout import Layout
from twin.plant.assembly import FLOOR, STANDING
from twin.plant.site_as_built import SiteAsBuilt

WALL_HEIGHT = 1.1  # m, a cell's partition


def hall(layout: Layout, built: SiteAsBuilt) -> mujoco.MjSpec:
    """A world with floor, walls, partitions and lamps, into which the machines are put.

    Args:
        layout: its drawing.
        built: how far walls and partitions stand off that.
    """
    spec = mujoco.MjSpec()
    spec.modelname = "cell"
    spec.compiler.degree = False
    spec.option.timestep = 0.002
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10
    spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
    spec.memory = 32 * 2**20
    spec.copy_during_attach = True  # one connector file makes many parts
    # Software rendering: no shadows, no multisampling, few slices.
    quality = spec.visual.quality
    quality.shadowsize, quality.offsamples = 0, 0
    quality.numslices, quality.numstacks = 16, 8
    spec.visual.map.znear, spec.visual.map.zfar = 0.005, 30.0
    spec.stat.extent, spec.stat.center = 4.0, (2.8, 2.0, 0.5)
    spec.visual.headlight.ambient = (0.34, 0.34, 0.34)
    spec.visual.headlight.diffuse = (0.12, 0.12, 0.12)
    spec.visual.headlight.specular = (0.05, 0.05, 0.05)
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.80, 0.84, 0.88),
        rgb2=(0.55, 0.60, 0.66),
        width=64,
        height=384,
    )
    for name, rgba in (
        ("floor", (0.50, 0.51, 0.52, 1)),
        ("wall", (0.72, 0.74, 0.75, 1)),
        ("partition", (0.80, 0.81, 0.78, 1)),
    ):
        spec.add_material(name=name, rgba=rgba, specular=0.03, shininess=0.05)

    world = spec.worldbody
    (x0, x1), (y0, y1) = layout.site.hall.x, layout.site.hall.y
    cx, cy, hx, hy = (x0 + x1) / 2, (y0 + y1) / 2, (x1 - x0) / 2, (y1 - y0) / 2
    for direction in ((-0.35, 0.25, -0.9), (0.5, -0.3, -0.8)):  # two rows of lamps
        world.add_light(
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            pos=(cx, cy, 4.0),
            dir=direction,
            diffuse=(0.36, 0.36, 0.35),
            specular=(0.25, 0.25, 0.25),
            castshadow=False,
        )
    world.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        pos=(cx, cy, 0),
        size=(hx, hy, 0.1),
        material="floor",
        group=0,
        contype=FLOOR | STANDING,
        conaffinity=0,
        friction=(0.5, 0.005, 0.0001),
    )
    t, h = 0.03, WALL_HEIGHT / 2
    for name, pos, size in (
        ("west", (x0 - t, cy, h), (t, hy + 2 * t, h)),
        ("east", (x1 + t, cy, h), (t, hy + 2 * t, h)),
        ("south", (cx, y0 - t, h), (hx + 2 * t, t, h)),
        ("north", (cx, y1 + t, h), (hx + 2 * t, t, h)),
    ):
        _add_wall(world, name, pos, size, built.wall(name))
    for i, (ax, ay, bx, by) in enumerate(layout.site.hall.partitions):
        middle, length = ((ax + bx) / 2, (ay + by) / 2, h), np.hypot(bx - ax, by - ay)
        size = (length / 2, PANEL / 2, h)
        off = built.wall(f"partition {i}")
        yaw = float(np.arctan2(by - ay, bx - ax))
        _add_wall(world, f"partition_{i}", middle, size, off, yaw, "partition")
    return spec


def _add_wall(world, name: str, pos, size, off, yaw: float = 0.0, material: str = "wall") -> None:
    """A wall drawn at `pos` and `yaw`, really `off` (x, y, yaw) from there."""
    (x, y, z), yaw = pos, yaw + off[2]
    world.add_geom(
        name=f"wall_{name}",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=(x + off[0], y + off[1], z),
        quat=(np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)),
        size=size,
        material=material,
        group=0,
        contype=STANDING,
        conaffinity=0,
    )

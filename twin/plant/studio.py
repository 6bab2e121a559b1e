"""A photographer's studio: parts laid on the belt, lit and seen as asked, without physics.

It makes the pictures on which the detector is trained and judged; no run of the cell uses it. What
is seen of a part is known exactly, since the same scene is rendered once more by object.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array, quat_wxyz, rot_x, rot_z
from twin.layout import Layout, Tolerances, models_dir
from twin.messages import PART_CLASSES
from twin.plant.assembly import MASKS, attach
from twin.plant.factory import attach_parts, resize_line
from twin.plant.hall import hall
from twin.plant.model_files import load_model
from twin.plant.sensors.camera import GROUPS, HEIGHT, WIDTH
from twin.plant.sensors.rendering import HIDDEN_GROUP, PART_PREFIX
from twin.plant.site_as_built import SiteAsBuilt
from twin.plant.studio_clutter import add_clutter

Rgb = tuple[float, float, float]
SUNK = 0.0001  # m: how far a resting part sinks into the belt's soft contact
AWAY = (0.0, 0.0, -2.0)  # m: where what is not in the picture waits
NOTHING, BELT = -1, -2  # in `Picture.part`


@dataclass(frozen=True)
class Lamp:
    """A directional lamp; `direction` is where its light goes, in world."""

    direction: tuple[float, float, float]
    diffuse: Rgb
    specular: Rgb


@dataclass(frozen=True)
class Scene:
    """What stands in the studio. Poses are x, y, yaw in world, on the belt's face."""

    T_world_camera: Array  # (4, 4) optical frame
    fovy_deg: float
    parts: Mapping[str, Array]  # by the body's name
    clutter: Mapping[str, Array]  # x, y, yaw, height above the belt
    clutter_colour: Mapping[str, Rgb]
    lamps: tuple[Lamp, Lamp]
    ambient: float
    belt: Rgb
    shine: float  # of all metal, 0 to 1
    tint: Rgb  # factor on the metals' colour


@dataclass(frozen=True)
class Picture:
    """A clean rendering: no blur, no noise."""

    rgb: NDArray[np.uint8]  # (h, w, 3)
    part: NDArray[np.int16]  # (h, w) index into `Studio.part_names`, or NOTHING, or BELT


class Studio:
    """Renders scenes at the belt (a context manager, for it holds an OpenGL context).

    Args:
        layout: gives hall and line.
        pool: parts of each class.
    """

    def __init__(self, layout: Layout, pool: int = 3):
        spec = hall(layout, SiteAsBuilt(Tolerances(scale=0.0), 0))  # as drawn
        root = models_dir()
        line = load_model(root, "line/line.xml")
        resize_line(line, layout.site.line)
        origin = (*layout.site.line.origin, layout.site.line.direction)
        attach(spec, line, origin, "line/", MASKS["standing"])
        attach_parts(spec, root, dict.fromkeys(PART_CLASSES, pool))
        self.clutter_names = add_clutter(spec)
        spec.worldbody.add_camera(name="studio")
        # What sleeps is not moved by the kinematics, and here everything is put where it is wanted.
        spec.option.enableflags &= ~mujoco.mjtEnableBit.mjENBL_SLEEP.value
        self._model = m = spec.compile()
        self._data = mujoco.MjData(m)
        self._plane = layout.site.line.height
        bodies = [m.body(b).name for b in range(m.nbody)]
        self.part_names = tuple(b for b in bodies if b.startswith(PART_PREFIX))
        self._qpos = {name: int(m.joint(name).qposadr[0]) for name in self.part_names}
        self._mocap = {name: int(m.body(name).mocapid[0]) for name in self.clutter_names}
        self._of_geom = np.full(m.ngeom + 1, NOTHING, np.int16)  # the last is for "no geom"
        for i, name in enumerate(self.part_names):
            self._of_geom[:-1][m.geom_bodyid == m.body(name).id] = i
        self._of_geom[m.geom("line/belt").id] = BELT
        self._groups = m.geom_group.copy()
        self._movable = np.isin(
            m.geom_bodyid, [m.body(n).id for n in (*self.part_names, *self.clutter_names)]
        )
        self._rgba, self._specular = m.mat_rgba.copy(), m.mat_specular.copy()
        metals = ("nickel", "shade", "gold")
        self._metal = np.array([any(k in m.mat(i).name for k in metals) for i in range(m.nmat)])
        self._belt_material = m.mat("line/belt").id
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = 0
        self._option.geomgroup[list(GROUPS)] = 1
        self._renderer = mujoco.Renderer(m, HEIGHT, WIDTH, max_geom=m.ngeom + 10)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._renderer.scene.flags[flag.value] = 0

    def __enter__(self) -> "Studio":
        return self

    def __exit__(self, *error) -> None:
        self._renderer.close()

    def shoot(self, scene: Scene) -> Picture:
        """Render a scene and who is who in it."""
        self._place(scene)
        self._light(scene)
        m, d = self._model, self._data
        mujoco.mj_kinematics(m, d)
        mujoco.mj_camlight(m, d)
        heights = d.geom_xpos[:, 2]
        hidden = self._movable & (heights < 0.0)
        m.geom_group[:] = np.where(hidden, HIDDEN_GROUP, self._groups)
        self._renderer.update_scene(d, camera="studio", scene_option=self._option)
        rgb = self._renderer.render().copy()
        self._renderer.enable_segmentation_rendering()
        ids, kinds = np.moveaxis(self._renderer.render(), -1, 0)
        self._renderer.disable_segmentation_rendering()
        geom = np.where(kinds == mujoco.mjtObj.mjOBJ_GEOM.value, ids, m.ngeom)
        return Picture(rgb, self._of_geom[geom])

    def _place(self, scene: Scene) -> None:
        m, d = self._model, self._data
        camera = m.camera("studio").id
        m.cam_pos[camera] = scene.T_world_camera[:3, 3]
        # MuJoCo looks along -z, the optical frame along z.
        m.cam_quat[camera] = quat_wxyz(scene.T_world_camera[:3, :3] @ rot_x(np.pi))
        m.cam_fovy[camera] = scene.fovy_deg
        for name, address in self._qpos.items():
            x, y, yaw = scene.parts.get(name, (*AWAY[:2], 0.0))
            z = self._plane - SUNK if name in scene.parts else AWAY[2]
            d.qpos[address : address + 7] = (x, y, z, *_about_z(yaw))
        for name, i in self._mocap.items():
            x, y, yaw, height = scene.clutter.get(name, (*AWAY[:2], 0.0, 0.0))
            z = self._plane + height if name in scene.clutter else AWAY[2]
            d.mocap_pos[i], d.mocap_quat[i] = (x, y, z), _about_z(yaw)

    def _light(self, scene: Scene) -> None:
        m = self._model
        for i, lamp in enumerate(scene.lamps):
            m.light_dir[i] = np.array(lamp.direction) / np.linalg.norm(lamp.direction)
            m.light_diffuse[i], m.light_specular[i] = lamp.diffuse, lamp.specular
        m.vis.headlight.ambient[:] = scene.ambient
        m.mat_rgba[:], m.mat_specular[:] = self._rgba, self._specular
        m.mat_rgba[self._metal, :3] = np.minimum(self._rgba[self._metal, :3] * scene.tint, 1.0)
        m.mat_specular[self._metal] = scene.shine
        m.mat_rgba[self._belt_material, :3] = scene.belt
        for name, colour in scene.clutter_colour.items():
            m.mat_rgba[m.mat(name).id, :3] = colour


def _about_z(yaw: float) -> Array:
    return quat_wxyz(rot_z(yaw))

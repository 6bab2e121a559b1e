"""A picture of the cell from any point, for documents and for looking at what was built."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.plant.world import World

GROUPS = (0, 1, 2, 4)  # everything that can be seen; 3 is collision shapes
FOVY = 45.0  # degrees


def snapshot(
    world: World, position, target, width: int = 1280, height: int = 720
) -> NDArray[np.uint8]:
    """Render the present state from `position` towards `target`, in world, with shadows.

    Returns:
        RGB picture. Shape (height, width, 3).
    """
    model = world.model
    model.vis.global_.offwidth = max(width, model.vis.global_.offwidth)
    model.vis.global_.offheight = max(height, model.vis.global_.offheight)
    model.vis.global_.fovy = FOVY
    option = mujoco.MjvOption()
    option.geomgroup[:] = [group in GROUPS for group in range(len(option.geomgroup))]
    option.sitegroup[:] = 0
    offset = np.asarray(target, dtype=float) - np.asarray(position, dtype=float)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = target
    camera.distance = np.linalg.norm(offset)
    camera.azimuth = np.degrees(np.arctan2(offset[1], offset[0]))
    camera.elevation = np.degrees(np.arcsin(offset[2] / camera.distance))
    with mujoco.Renderer(model, height, width) as renderer:
        renderer.update_scene(world.data, camera, option)
        return renderer.render()

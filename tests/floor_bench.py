"""A vehicle put down and photographed from below, without a step of physics."""

from dataclasses import replace

import numpy as np

from twin.geometry import Array, between2, rot2
from twin.layout import Layout, load_layout
from twin.messages import FloorFrame
from twin.plant.as_built import AsBuilt
from twin.plant.sensors.floor_camera import FloorCamera
from twin.plant.sensors.rendering import RenderWorker
from twin.plant.world import World
from twin.stack.config import nominal_config

HALF_VIEW = (0.105, 0.141)  # m of floor in the picture, forward and left of its middle
HALF_CODE = 0.052  # m: half of a code and a pixel


class FloorBench:
    """The default plant, by default exactly as drawn; `built` replaces fields of `AsBuilt`."""

    def __init__(
        self, *overrides: str, exact: bool = True, noise: float = 1.0, seed: int = 0, **built
    ):
        if exact:
            overrides = ("world.tolerances.scale=0", *overrides)
        self.layout: Layout = load_layout(overrides=overrides)
        self.config = nominal_config(self.layout.site, self.layout.options)
        drawn = AsBuilt.draw(np.random.default_rng(seed), self.layout.world.tolerances)
        self.as_built = replace(drawn, **built)
        self.world = World(self.layout, self.as_built, pool=1)
        self._worker = RenderWorker(self.world.model)
        rng = np.random.default_rng(seed)
        self.camera = FloorCamera(self._worker, self.world.model, rng, noise)
        self.tags = {tag.name: np.array(tag.pose) for tag in self.layout.site.tags}

    def shoot(self, pose, velocity=(0.0, 0.0)) -> FloorFrame:
        """Picture of the vehicle at x, y, yaw in world, at a velocity in base axes, m/s."""
        data, joint = self.world.data, self.world.model.joint("agv/base")
        q, v = joint.qposadr[0], joint.dofadr[0]
        data.qpos[q : q + 2] = pose[:2]
        data.qpos[q + 3 : q + 7] = np.cos(pose[2] / 2), 0, 0, np.sin(pose[2] / 2)
        data.qvel[v : v + 2] = rot2(pose[2]) @ velocity
        return self.camera.sample(1.0, self.world.model, data).result()

    def close(self) -> None:
        self._worker.close()


def whole_code_in_view(pose: Array, tag: Array) -> bool:
    """Whether the camera, drawn in the vehicle's middle, sees all of a code."""
    x, y, yaw = between2(pose, tag)
    corners = HALF_CODE * np.array([(1, 1), (1, -1), (-1, 1), (-1, -1)]) @ rot2(yaw).T + (x, y)
    return bool(np.all(np.abs(corners) < HALF_VIEW))

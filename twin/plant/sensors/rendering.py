"""Pictures from a worker thread, so that rendering and physics overlap.

The worker owns a copy of the model, its own `MjData` and the OpenGL context. An exposure copies the
coordinates only (`qpos`); the worker recomputes where things are. Nothing it does depends on when
it runs, so the run stays deterministic.
"""

import copy
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

HIDDEN_GROUP = 5
PART_PREFIX = "part_"


@dataclass(frozen=True)
class View:
    """One camera's picture: size in pixels, and the geom groups that can reach it."""

    camera: str
    width: int
    height: int
    groups: tuple[int, ...]


class RenderWorker:
    """Renders views of copied states in one thread, in the order of submission.

    Args:
        model: the compiled cell, as built; later changes of it are not seen.
    """

    def __init__(self, model: mujoco.MjModel):
        self._model = copy.copy(model)
        self._data = mujoco.MjData(self._model)
        self._groups = model.geom_group.copy()
        part_bodies = [b for b in range(model.nbody) if model.body(b).name.startswith(PART_PREFIX)]
        self._is_part = np.isin(model.geom_bodyid, part_bodies)
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="render")
        self._executor.submit(self._open).result()

    def submit(
        self, data: mujoco.MjData, view: View, finish: Callable, depth: bool = False
    ) -> Future:
        """Render the present state; `finish(rgb)` or `finish(rgb, depth_m)` makes the reading.

        rgb has shape (height, width, 3), uint8; depth_m (height, width), metres along the optical
        axis. Both are the worker's buffers: `finish` must copy what it keeps.
        """
        return self._executor.submit(self._run, data.qpos.copy(), view, finish, depth)

    def close(self) -> None:
        """Finish what was asked for and free the OpenGL context."""
        self._executor.submit(self._free)
        self._executor.shutdown()

    def _open(self) -> None:
        vis = self._model.vis.global_
        self._gl = mujoco.GLContext(vis.offwidth, vis.offheight)
        self._gl.make_current()
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_50.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR.value
        self._scene = mujoco.MjvScene(self._model, maxgeom=self._model.ngeom + 100)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        self._buffers: dict[tuple[int, int], tuple[NDArray[np.uint8], NDArray[np.float32]]] = {}

    def _free(self) -> None:
        self._context.free()
        self._gl.free()

    def _run(self, qpos, view: View, finish: Callable, with_depth: bool):
        model, data = self._model, self._data
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        camera_id = model.camera(view.camera).id
        model.geom_group[:] = np.where(self._reaches(camera_id, view), self._groups, HIDDEN_GROUP)

        option = mujoco.MjvOption()
        option.geomgroup[:] = 0
        option.geomgroup[list(view.groups)] = 1
        option.sitegroup[:] = 0
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FIXED.value
        camera.fixedcamid = camera_id
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, data, option, None, camera, everything, self._scene)

        size = (view.height, view.width)
        if size not in self._buffers:
            self._buffers[size] = (np.empty((*size, 3), np.uint8), np.empty(size, np.float32))
        rgb, depth = self._buffers[size]
        viewport = mujoco.MjrRect(0, 0, view.width, view.height)
        mujoco.mjr_render(viewport, self._scene, self._context)
        mujoco.mjr_readPixels(rgb, depth if with_depth else None, viewport, self._context)
        if not with_depth:
            return finish(rgb[::-1])  # OpenGL counts rows from below
        return finish(rgb[::-1], self._metric(depth[::-1]))

    def _reaches(self, camera_id: int, view: View) -> NDArray[np.bool_]:
        """Geoms whose bounding sphere meets the camera's frustum. Shape (ngeom,).

        MuJoCo sends everything to OpenGL; in software each geom costs about 10 us. Parts in the
        feeder's store stand below the floor and drop out too.
        """
        model, data = self._model, self._data
        R_world_camera = data.cam_xmat[camera_id].reshape(3, 3)
        p_camera = (data.geom_xpos - data.cam_xpos[camera_id]) @ R_world_camera
        radius = np.where(model.geom_rbound > 0, model.geom_rbound, np.inf)  # a plane has none
        depth = -p_camera[:, 2]  # MuJoCo looks along -z
        half = np.radians(model.cam_fovy[camera_id]) / 2
        tan_v = np.tan(half)
        tan_u = tan_v * view.width / view.height
        inside = depth > -radius
        for tan, offset in ((tan_u, np.abs(p_camera[:, 0])), (tan_v, np.abs(p_camera[:, 1]))):
            inside &= offset - depth * tan < radius * np.hypot(1.0, tan)
        return inside & ~(self._is_part & (data.geom_xpos[:, 2] < 0.0))

    def _metric(self, buffer: NDArray[np.float32]) -> NDArray[np.float64]:
        """Depth buffer (1 near, 0 far) to metres: the inverse of glFrustum's third row."""
        extent = self._model.stat.extent
        near, far = self._model.vis.map.znear * extent, self._model.vis.map.zfar * extent
        return near * far / (near + buffer.astype(np.float64) * (far - near))

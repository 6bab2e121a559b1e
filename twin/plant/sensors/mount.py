"""Where a sensor that is bolted to the vehicle is, and how fast.

Read from the free joint's coordinates, which belong to the time of the step; derived quantities
such as `site_xpos` are one step old after `mj_step`, which is 2 mm at full speed.
"""

import mujoco
import numpy as np

from twin.geometry import Array, rotation_from_quat, transform


class Mount:
    """A site rigidly on a body with a free joint.

    Args:
        model: the compiled cell.
        site: name of the site.
        deviation: `T_drawn_true` of the sensor as built, (4, 4).
    """

    def __init__(self, model: mujoco.MjModel, site: str, deviation: Array | None = None):
        s = model.site(site).id
        body = model.site_bodyid[s]
        joint = model.body_jntadr[body]
        if joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
            raise ValueError(f"site {site}: its body must carry the free joint")
        self._qpos, self._dof = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
        T_base_drawn = transform(rotation_from_quat(model.site_quat[s]), model.site_pos[s])
        self.T_base_sensor = T_base_drawn if deviation is None else T_base_drawn @ deviation

    def _base(self, data) -> tuple[Array, Array, Array, Array]:
        q, v = data.qpos[self._qpos :], data.qvel[self._dof :]
        return q[:3].copy(), rotation_from_quat(q[3:7]), v[:3].copy(), v[3:6].copy()

    def pose(self, data) -> Array:
        """`T_world_sensor`. Shape (4, 4)."""
        p_world, R_world_base, _, _ = self._base(data)
        return transform(R_world_base, p_world) @ self.T_base_sensor

    def velocity(self, data) -> Array:
        """Velocity of the sensor's origin in world. Shape (3,), m/s."""
        _, R_world_base, velocity, rate_in_base = self._base(data)
        return velocity + R_world_base @ np.cross(rate_in_base, self.T_base_sensor[:3, 3])

"""Wet patches of the floor: rollers of a wheel that stands on one have little grip."""

from collections.abc import Sequence

import mujoco
import numpy as np

from twin.layout import WetPatch
from twin.plant.actuators.wheel_drive import WHEELS


class WetFloor:
    """Gives the rollers of each wheel the friction of the floor under its axle.

    The rollers carry priority in MuJoCo's contacts, so their friction alone counts.
    """

    def __init__(self, model: mujoco.MjModel, patches: Sequence[WetPatch]):
        self._wheels = [model.body(name).id for name in WHEELS]
        names = [model.geom(g).name for g in range(model.ngeom)]
        self._rollers = np.array(  # (4, rollers of a wheel)
            [
                [g for g, name in enumerate(names) if name.startswith(f"agv/roller_{wheel[-2:]}_")]
                for wheel in WHEELS
            ]
        )
        self._dry = model.geom_friction[self._rollers[:, 0], 0].copy()
        self._low = np.array([(p.x[0], p.y[0]) for p in patches]).reshape(-1, 2)
        self._high = np.array([(p.x[1], p.y[1]) for p in patches]).reshape(-1, 2)
        self._friction = np.array([p.friction for p in patches])
        self.now = self._dry.copy()  # (4,) of the wheels

    def step(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Look where the wheels are, and write the friction of those for which it changed."""
        xy = data.xpos[self._wheels][:, None, :2]
        wet = ((xy >= self._low) & (xy <= self._high)).all(axis=2)  # (4, patches)
        friction = np.where(wet, self._friction, np.inf).min(axis=1, initial=np.inf)
        friction = np.minimum(friction, self._dry)
        changed = friction != self.now
        if changed.any():
            model.geom_friction[self._rollers[changed], 0] = friction[changed, None]
            self.now = friction

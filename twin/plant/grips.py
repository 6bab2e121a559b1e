"""What each gripper really holds, from the contacts of its two fingers. Truth, for evaluation."""

from dataclasses import dataclass

import mujoco
import numpy as np


@dataclass(frozen=True)
class Grip:
    """A part between the fingers of one arm; `part` is None if not both fingers touch one."""

    part: str | None
    force: float  # N, the larger of the two fingers' normal forces on it


class GripWatcher:
    """Reads contacts between fingers and parts."""

    def __init__(self, model: mujoco.MjModel):
        self._model = model
        body = [model.body(b).name for b in range(model.nbody)]
        self._names = body
        # 0 for anything else; 1 + 2 * arm + side for the fingers.
        finger = np.zeros(model.nbody, dtype=int)
        for arm in range(2):
            for side, name in enumerate(("left", "right")):
                finger[model.body(f"arm{arm}/finger_{name}").id] = 1 + 2 * arm + side
        self._finger = finger[model.geom_bodyid]
        is_part = np.array([name.startswith("part_") for name in body])
        self._is_part = is_part[model.geom_bodyid]
        self._nothing = (Grip(None, 0.0), Grip(None, 0.0))
        self.held = self._nothing  # by each arm at the last look

    def observe(self, data: mujoco.MjData) -> None:
        """Look at the contacts; their forces must be solved, as they are right after a step."""
        self.held = self._nothing
        if not data.ncon:
            return
        geom = data.contact.geom
        touching = (self._finger[geom].max(axis=1) > 0) & self._is_part[geom].any(axis=1)
        if not touching.any():
            return
        force: dict[tuple[int, int, int], float] = {}  # (arm, part body, side) -> N
        wrench = np.zeros(6)
        for i in np.nonzero(touching)[0]:
            a, b = geom[i] if self._finger[geom[i, 0]] else geom[i][::-1]
            arm, side = divmod(int(self._finger[a]) - 1, 2)
            mujoco.mj_contactForce(self._model, data, int(i), wrench)
            key = (arm, int(self._model.geom_bodyid[b]), side)
            force[key] = force.get(key, 0.0) + float(wrench[0])
        self.held = (self._of(0, force), self._of(1, force))

    def _of(self, arm: int, force: dict[tuple[int, int, int], float]) -> Grip:
        best = Grip(None, 0.0)
        for a, body, side in force:
            both = force.get((arm, body, 0), 0.0), force.get((arm, body, 1), 0.0)
            if a == arm and side == 0 and min(both) > 0 and max(both) > best.force:
                best = Grip(self._names[body], max(both))
        return best

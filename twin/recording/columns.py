"""Values over time gathered in memory and sent in bulk, which costs far less than one by one."""

from collections import defaultdict

import numpy as np
import rerun as rr


class Columns:
    """Scalars, poses and line segments waiting to be sent, by entity."""

    def __init__(self, recording: rr.RecordingStream):
        self._out = recording
        self._clear()

    def _clear(self) -> None:
        self._scalars: dict[str, list] = defaultdict(list)
        self._poses: dict[str, list] = defaultdict(list)
        self._lines: dict[str, list] = defaultdict(list)

    def scalar(self, entity: str, stamp: float, value: float) -> None:
        self._scalars[entity].append((stamp, value))

    def pose(self, entity: str, stamp: float, pose) -> None:
        """Pose of an entity in its parent: x, y, z, qw, qx, qy, qz. Shape (7,)."""
        self._poses[entity].append((stamp, pose))

    def line(self, entity: str, stamp: float, points) -> None:
        """One strip of points. Shape (n, 3)."""
        self._lines[entity].append((stamp, points))

    def send(self) -> None:
        """Hand everything over."""
        for entity, rows in self._scalars.items():
            stamps, values = zip(*rows, strict=True)
            self._send(entity, stamps, rr.Scalars.columns(scalars=values))
        for entity, rows in self._poses.items():
            stamps, poses = zip(*rows, strict=True)
            poses = np.array(poses)
            xyzw = np.roll(poses[:, 3:], -1, axis=1)
            columns = rr.Transform3D.columns(translation=poses[:, :3], quaternion=xyzw)
            self._send(entity, stamps, columns)
        for entity, rows in self._lines.items():
            stamps, strips = zip(*rows, strict=True)
            self._send(entity, stamps, rr.LineStrips3D.columns(strips=strips))
        self._clear()

    def _send(self, entity: str, stamps, columns) -> None:
        self._out.send_columns(entity, [rr.TimeColumn("sim", duration=stamps)], columns)

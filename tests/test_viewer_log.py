"""The recording for the rerun viewer, read back."""

import os
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rerun.chunk import RrdReader

from twin.layout import load_layout
from twin.messages import (
    CameraFrame,
    Commands,
    Detection,
    FloorFrame,
    GripperReading,
    LidarScan,
    RgbdFrame,
    StackState,
    TrackedPart,
)
from twin.recording.log import ReadingsLog, read_log
from twin.recording.viewer_log import ViewerLog
from twin.stack.config import StackConfig

KINDS = ("plane", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")


@dataclass
class Box:
    """One shape of each kind on its own body."""

    body: int
    kind: str

    size = np.array([0.1, 0.2, 0.3])
    position = np.zeros(3)
    quat_wxyz = np.array([1.0, 0.0, 0.0, 0.0])
    rgba = np.array([0.5, 0.5, 0.5, 1.0])
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2]], np.int32)

    @property
    def body_name(self) -> str:
        return f"agv/body{self.body}"

    @property
    def group(self) -> int:
        return (0, 1, 2, 4)[self.body % 4]


class Cell:
    """A scene whose bodies 0 to 2 stand still and all others move."""

    def __init__(self):
        self.time = 0.0
        self.shapes = tuple(Box(i, kind) for i, kind in enumerate(KINDS))

    def body_poses(self):
        position = np.zeros((len(KINDS), 3))
        position[3:, 0] = self.time
        return position, np.tile([1.0, 0.0, 0.0, 0.0], (len(KINDS), 1))


def tick(t: float):
    """A tick with a picture of each camera, a scan, a detection and a track."""
    outline = np.array([[10.0, 10.0], [20.0, 10.0], [20.0, 15.0]])
    seen = Detection("n_tee_fff", 0.9, np.zeros(3), 0.0, outline, outline.mean(axis=0), False)
    track = TrackedPart(3, "n_tee_fff", 0.9, np.ones(3), np.zeros(3), 0.0, 5)
    state = StackState(
        stamp=t,
        pose=np.array([t + 0.003, 0.004, 0.0]),
        pose_covariance=np.eye(3),
        odometry_pose=np.array([t, 0.03, 0.0]),
        fused_pose=np.array([t, 0.01, 0.0]),
        velocity=np.zeros(3),
        task="drive",
        tracks=(track,),
        detections=(seen,),
        detections_stamp=t,
        events=(f"event at {t:.2f}",),
        goals={"lookahead": 0.3},
    )
    readings = (
        CameraFrame(t, np.full((48, 64, 3), 90, np.uint8)),
        FloorFrame(t, np.full((48, 64), 120, np.uint8)),
        RgbdFrame(t, np.full((24, 42, 3), 90, np.uint8), np.full((24, 42), 1500, np.uint16)),
        LidarScan(t, -np.pi, np.pi / 4, np.array([1.0, np.inf, 2.0, 1.0, 1.0, 1, 1, 1]), 8.0),
        GripperReading(t, 1, 0.03, 12.0),
    )
    truth = SimpleNamespace(pose=np.array([t, 0.0, 0.0]), velocity=np.array([1.0, 0.0, 0.0]))
    return SimpleNamespace(
        stamp=t, readings=readings, commands=Commands(), state=state, truth=truth
    )


def record(folder: Path, seconds: float, close: bool = True) -> None:
    layout, cell = load_layout(), Cell()
    config = StackConfig(layout.site, layout.options)
    log = ReadingsLog(folder / "readings.log", config)
    viewer = ViewerLog(folder / "recording.rrd", cell, config, lambda: {"attempts": 2.0})
    for k in range(round(seconds * 100)):
        now = tick(k * 0.01)
        cell.time = now.stamp + 0.01
        log.observe(now)
        viewer.observe(now)
    if close:
        viewer.metrics("| metric | value |\n|---|---|\n| missed | 0 |")
        viewer.close()
        log.close()


def rows(path: Path) -> Counter[str]:
    """Rows of each entity, the parts of a chunk that never change left out."""
    count: Counter[str] = Counter()
    for chunk in RrdReader(path).stream():
        count[chunk.entity_path] += 0 if chunk.is_static else chunk.num_rows
    return count


def test_everything_is_there_at_its_rate(tmp_path):
    record(tmp_path, 3.0)
    count = rows(tmp_path / "recording.rrd")
    assert count["/world/estimate/mast_camera"] == 300
    assert count["/world/estimate/mast_camera/detections"] == 300
    assert count["/world/estimate/rgbd/colour"] == count["/world/estimate/rgbd/depth"] == 300
    assert count["/world/estimate/lidar"] == count["/events"] == 300
    assert count["/world/estimate"] == count["/errors/estimate_position_mm"] == 60
    assert count["/world/paths/true"] == count["/world/paths/wheels"] == 14
    assert count["/grippers/arm1_width_mm"] == 300
    assert count["/picks/attempts"] == 60
    assert count["/goals/lookahead"] == count["/world/tracks"] == 60
    assert {f"/world/vehicle/agv_body2/{KINDS[2]}", "/metrics"} <= count.keys()
    assert RrdReader(tmp_path / "recording.rrd").blueprints()


def test_only_what_moves_is_logged_again(tmp_path):
    record(tmp_path, 1.0)
    count = rows(tmp_path / "recording.rrd")
    assert count["/world/vehicle/agv_body2"] == 1
    assert count["/world/vehicle/agv_body6"] == 20


def test_errors_are_the_distances_from_truth(tmp_path):
    record(tmp_path, 0.2)
    errors: dict[str, list[float]] = {}
    for chunk in RrdReader(tmp_path / "recording.rrd").stream():
        if chunk.entity_path.startswith("/errors/"):
            table = chunk.to_record_batch().to_pydict()
            (values,) = (v for k, v in table.items() if "Scalars" in k)
            errors.setdefault(chunk.entity_path, []).extend(np.ravel(values))
    assert errors["/errors/estimate_position_mm"] == pytest.approx([5.0] * 4)
    assert errors["/errors/wheels_position_mm"] == pytest.approx([30.0] * 4)


def test_a_killed_run_leaves_what_it_had(tmp_path):
    """Expected: both files are readable up to a few seconds before the end."""
    code = (
        "import os, sys; from pathlib import Path; import test_viewer_log as t\n"
        "t.record(Path(sys.argv[1]), 8.0, close=False); os._exit(9)"
    )
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    assert subprocess.run([sys.executable, "-c", code, str(tmp_path)], env=env).returncode == 9
    assert rows(tmp_path / "recording.rrd")["/world/estimate"] > 40
    assert len(list(read_log(tmp_path / "readings.log"))) > 400

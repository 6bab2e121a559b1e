"""Scenario mapping: obstacles and the camera's wrong drawing, and the files of a short run."""

from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest

from evaluation.run import RunRequest
from scenarios.mapping import (
    BOARD,
    BOARDS,
    BOTH_SEE,
    LIDAR_MISSES,
    ROUTE,
    WRONG_SHIFT,
    WRONG_TURN,
    FreeMapper,
    apart,
    run,
    with_obstacles,
    with_wrong_camera,
)
from twin.floor_plan import FOOTPRINT, machines
from twin.geometry import rectangle, rectangles_overlap
from twin.layout import load_layout
from twin.messages import LidarScan, RgbdFrame, WheelState
from twin.plant.obstacles import OUTLINE
from twin.stack.config import nominal_config
from twin.stack.estimation.map_file import load_map
from twin.stack.estimation.vehicle_calibration import Calibration, load_calibration

LAYOUT = load_layout()


@pytest.mark.parametrize("seed", range(8))
def test_obstacles_stand_beside_the_route_and_are_of_all_kinds(seed):
    layout = with_obstacles(LAYOUT, np.random.default_rng(seed))
    obstacles = layout.world.faults.obstacles
    kinds = Counter(o.kind for o in obstacles)
    assert kinds.pop(BOARD) == len(BOARDS)
    assert kinds.total() == 12 and all(kinds[kind] in (1, 2) for kind in LIDAR_MISSES)
    assert sum(kinds[kind] for kind in LIDAR_MISSES) == 6  # half, as the requirement has it
    assert sum(kinds[kind] for kind in BOTH_SEE) == 6
    boxes = [rectangle(*o.pose, *OUTLINE[o.kind]) for o in obstacles]
    built = [box for boxes_ in machines(layout.site).values() for box in boxes_]
    for i, box in enumerate(boxes):
        for other in (*boxes[:i], *built):
            assert not rectangles_overlap(box, other)
        for _, pose in ROUTE:
            assert not rectangles_overlap(box, rectangle(*pose, *FOOTPRINT))


def test_camera_is_drawn_wrong_by_as_much_as_is_said():
    config = nominal_config(LAYOUT.site, LAYOUT.options)
    for seed in range(5):
        wrong = with_wrong_camera(config, np.random.default_rng(seed))
        shift, turn = apart(wrong.rgbd.T_base_camera, config.rgbd.T_base_camera)
        assert shift == pytest.approx(WRONG_SHIFT) and turn == pytest.approx(WRONG_TURN)


def test_the_mapper_without_walls_gets_the_calibration_of_the_other():
    """Expected: the free mapper corrects ranges as the stack's does, once it can."""
    config = nominal_config(LAYOUT.site, LAYOUT.options)
    free = FreeMapper(config)
    state = SimpleNamespace(fused_pose=np.zeros(3))
    free.observe(SimpleNamespace(stamp=0.0, readings=(), state=state))
    assert not free.mapper.calibrated
    found = Calibration((0.0, 0.0, 0.4), (-1.57, 0.0, -1.57), (0.001,) * 3, (0.001,) * 3,
                        (0.0,) * 3, 0.012, 1.0, 30, 0)  # fmt: skip
    free.calibration = lambda: found
    free.observe(SimpleNamespace(stamp=0.1, readings=(), state=state))
    assert free.mapper.calibration is found
    np.testing.assert_array_equal(
        free.mapper.belief.rgbd.T_base_camera, found.applied(config).rgbd.T_base_camera
    )


def test_the_mapper_without_walls_hears_scans_and_depth_pictures():
    """Expected: both, as the stack's does; its fused map is scored."""
    free, heard = FreeMapper(nominal_config(LAYOUT.site, LAYOUT.options)), []
    free.mapper.hear = lambda reading, odometry: heard.append(reading) or True  # type: ignore
    scan = LidarScan(0.1, -1.0, 0.1, np.full(21, 2.0), 30.0)
    frame = RgbdFrame(0.1, np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.uint16))
    wheels = WheelState(0.1, np.zeros(4, np.int64), np.zeros(4), np.zeros(3))
    state = SimpleNamespace(fused_pose=np.zeros(3))
    free.observe(SimpleNamespace(stamp=0.1, readings=(wheels, scan, frame), state=state))
    assert heard == [scan, frame]


def test_short_run_leaves_maps_that_can_be_loaded(tmp_path):
    """Expected result: one second at the dock sees the walls of the cell, and reports them."""
    result = run(RunRequest(seed=3, out=tmp_path, duration=1.0), LAYOUT)
    assert not result.complete
    assert result.metrics["occupied_precision_lidar"] > 0.9
    assert 0.05 < result.metrics["occupied_recall_lidar"] < 1.0
    assert np.isnan(result.metrics.get("calibration_error_mm", np.nan))
    for name in ("lidar", "rgbd", "fused"):
        grid = load_map(tmp_path / f"{name}.yaml")
        assert grid.occupied.any() == (name != "rgbd")  # its pictures wait for the calibration
        assert (tmp_path / f"map_{name}_errors.png").stat().st_size > 0
    with pytest.raises(ValueError, match="cannot be read"):
        load_calibration(tmp_path / "calibration.json")

"""Files of an earlier run that the stack is given are used, or refused before anything runs."""

from dataclasses import replace

import numpy as np
import pytest

from evaluation.belief import belief
from twin.cli import main
from twin.layout import load_layout
from twin.stack.config import nominal_config
from twin.stack.estimation.localiser import Localiser
from twin.stack.estimation.map_file import save_map
from twin.stack.estimation.motion_models import omnidirectional, turn_path_turn
from twin.stack.estimation.occupancy_grid import OccupancyGrid
from twin.stack.estimation.vehicle_calibration import Calibration, save_calibration

FOUND = Calibration(
    position=(0.04, 0.0, 0.43),
    angles=(-1.56, 0.01, -1.58),
    position_sigma=(1e-3, 1e-3, 1e-3),
    angle_sigma=(1e-3, 1e-3, 1e-3),
    lidar_stand=(0.003, 0.004, -0.002),
    lidar_range_offset=0.01,
    residual_rms=1.0,
    pairs=30,
    boards=12,
)


def test_a_calibration_moves_the_depth_camera_and_nothing_else(tmp_path):
    save_calibration(FOUND, tmp_path / "c.json")
    layout = load_layout(None, (f"options.calibration={tmp_path / 'c.json'}",))
    drawn, found = nominal_config(layout.site, layout.options), belief(layout)
    T = found.T_base_lidar @ FOUND.T_level_rgbd
    assert not np.allclose(FOUND.T_level_rgbd, FOUND.T_lidar_rgbd, atol=1e-3)
    np.testing.assert_array_equal(found.rgbd.T_base_camera, T)
    assert not np.allclose(drawn.rgbd.T_base_camera, T, atol=1e-3)
    rest = replace(found, rgbd=drawn.rgbd)
    assert all(getattr(rest, f) is getattr(drawn, f) for f in ("site", "options", "rgbd", "parts"))


@pytest.mark.parametrize(
    "name, model", [("omni", omnidirectional), ("turn_path_turn", turn_path_turn)]
)
def test_the_particles_move_by_the_model_of_the_options(name, model):
    config = belief(load_layout(None, (f"options.motion_model={name}",)))
    assert Localiser(config, np.array(config.site.dock)).amcl.settings.motion is model


def small_map(folder):
    for name in ("lidar", "fused"):
        grid = OccupancyGrid(np.zeros(2), 0.05, np.full((40, 60), -3.0, np.float32))
        save_map(grid, folder / f"{name}.yaml")


@pytest.mark.parametrize("scenario", ["kidnap", "navigate", "mapping"])
@pytest.mark.parametrize(
    "option, said",
    [
        ("map", "options.map: map {folder}/lidar.yaml: of another hall: x from 0.00 to 3.00 m"),
        ("calibration", "options.calibration: calibration {folder}: cannot be read"),
    ],
)
def test_files_that_cannot_be_used_are_refused_before_anything_runs(
    scenario, option, said, tmp_path, capsys
):
    small_map(tmp_path)
    out = tmp_path / "out"
    run = ["run", scenario, "--out", str(out), "--set", f"options.{option}={tmp_path}"]
    assert main(run) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and said.format(folder=tmp_path) in error
    assert not out.exists()

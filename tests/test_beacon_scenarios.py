"""Scenarios of the photoelectric network, cut short: files, six degrees of freedom, trials."""

import json
from pathlib import Path

import numpy as np
import pytest

from evaluation.beacon_field import STOPS, in_the_field
from evaluation.run import RunRequest
from scenarios import beacon_faults, beacon_parking
from twin.cli import main
from twin.layout import load_layout
from twin.recording.tum import read_tum

# Measured by `twin run beacon_calibrate --seed 0`; it holds for the vehicle of that seed alone.
FILE = Path(__file__).parent.parent / "notebooks" / "beacon_calibration_seed0.json"
CALIBRATION = f"options.beacon_calibration={FILE}"


def test_a_short_measurement_leaves_poses_in_space_and_a_recording(tmp_path):
    run = ["run", "beacon_repeat", "--duration", "5", "--record", "--out", str(tmp_path)]
    assert main([*run, "--set", CALIBRATION]) == 1
    assert not (tmp_path / "error.txt").exists(), (tmp_path / "error.txt").read_text()
    report = json.loads((tmp_path / "report.json").read_text())
    assert not report["complete"] and report["metrics"]["measurements"] > 50
    assert report["metrics"]["mount_error_mm"] < 2.0
    assert report["metrics"]["sigma_filtered_y_mm"] < 0.5
    (stamps, truth), (_, estimate) = (
        read_tum(tmp_path / f"{name}.tum") for name in ("truth", "estimate")
    )
    settled = stamps > 3.0
    assert np.all(truth[settled, 2] != 0.0)  # the rubber gives
    assert np.abs(estimate[settled, :3] - truth[settled, :3]).max() < 2e-3
    assert (tmp_path / "recording.rrd").stat().st_size > 50_000
    with np.load(tmp_path / "series.npz") as series:
        assert series["source"].shape[1] == 3


def test_trials_with_trouble(tmp_path, monkeypatch):
    monkeypatch.setattr(beacon_faults, "TRIALS", 90)
    monkeypatch.setattr(beacon_faults, "PLACES", 3)
    result = beacon_faults.run(RunRequest(0, tmp_path), load_layout(None, (CALIBRATION,)))
    assert result.complete and result.metrics["trials"] == 90
    assert result.metrics["wrong_fixes"] == 0.0
    assert result.metrics["fix_availability"] > 0.85


@pytest.mark.parametrize("content", [None, b"{}"])
def test_a_calibration_that_cannot_be_read_ends_in_one_line(content, tmp_path, capsys):
    path = tmp_path / "head.json"
    if content is not None:
        path.write_bytes(content + b"x")
    run = ["run", "beacon_faults", "--out", str(tmp_path / "out")]
    assert main([*run, "--set", f"options.beacon_calibration={path}"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "head.json" in said


def test_moves_are_of_the_sources_lengths():
    poses = np.array(beacon_parking.moves(np.random.default_rng(0), (2.5, 2.6, np.pi)))
    assert len(poses) == 31
    length = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    assert np.all((length >= 0.05) & (length <= 1.0)) and np.ptp(length) > 0.5


def test_the_field_can_be_built_and_keeps_what_was_asked_for():
    layout = in_the_field(load_layout(None, ("site.beacons.spin_rate=40.0",)))
    assert layout.world.beacons.fitted and layout.options.beacons == "all"
    assert layout.site.beacons is not None and layout.site.beacons.spin_rate == 40.0
    asked = load_layout(None, ("world.beacons.fitted=true", "options.beacons=source"))
    assert in_the_field(asked).options.beacons == "source"
    assert len({stop[:2] for stop in STOPS}) >= 4

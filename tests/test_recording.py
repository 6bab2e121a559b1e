"""The log of readings gives back what was written, to the bit, and survives being cut off."""

import subprocess
import sys
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from scenarios.mapping import with_wrong_camera
from twin.layout import load_layout
from twin.messages import (
    ArmCommand,
    ArmReading,
    BodyVelocity,
    CameraFrame,
    Commands,
    DriveOrder,
    FloorFrame,
    Goal,
    GripperCommand,
    GripperReading,
    ImuReading,
    LidarScan,
    Order,
    RgbdFrame,
    WheelState,
)
from twin.recording.codec import decode, encode, same
from twin.recording.log import ReadingsLog, read_config, read_log
from twin.stack.config import StackConfig, nominal_config
from twin.stack.estimation.map_file import load_map, save_map
from twin.stack.estimation.occupancy_grid import OccupancyGrid


def every_reading(rng: np.random.Generator, t: float):
    """One reading of each kind, with the odd values that sensors do send."""
    ranges = rng.uniform(0.1, 8.0, 720)
    ranges[::7] = np.inf
    return (
        WheelState(t, rng.integers(-(2**40), 2**40, 4), rng.normal(size=4), rng.normal(size=3)),
        ImuReading(t, rng.normal(size=3), np.array([0.0, -0.0, np.nan])),
        LidarScan(t, -np.pi, 2 * np.pi / 720, ranges, 8.0),
        RgbdFrame(
            t,
            rng.integers(0, 256, (24, 42, 3), dtype=np.uint8),
            rng.integers(0, 2**16, (24, 42), dtype=np.uint16),
        ),
        CameraFrame(t, rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)),
        ArmReading(t, 0, rng.normal(size=6), rng.normal(size=6)),
        GripperReading(t, 1, 0.031, 1 / 3),
        FloorFrame(t, rng.integers(0, 256, (24, 32), dtype=np.uint8)),
        DriveOrder(t, (Goal("R7", (1.0, -2.0, 1 / 3)),)),
        Order(t, (("sma_f_n_m", 3), ("n_tee_fff", 2))),
    )


def some_commands(rng: np.random.Generator) -> Commands:
    arm = ArmCommand(0, rng.normal(size=6), rng.normal(size=6), rng.normal(size=6))
    return Commands(BodyVelocity(0.1, -0.2, 1e-300), (arm,), (GripperCommand(1, 0.05, 20.0),))


def belief(*overrides: str) -> StackConfig:
    layout = load_layout(None, overrides)
    return nominal_config(layout.site, layout.options)


def write_log(path, ticks=5, config=None):
    rng = np.random.default_rng(0)
    log = ReadingsLog(path, config or belief())
    written = []
    for k in range(ticks):
        written.append((k * 0.01, every_reading(rng, k * 0.01), some_commands(rng)))
        log.write(*written[-1])
    log.close()
    return written


def test_a_log_gives_back_what_was_written(tmp_path):
    written = write_log(tmp_path / "readings.log")
    read = list(read_log(tmp_path / "readings.log"))
    assert len(read) == len(written)
    for tick, (stamp, readings, commands) in zip(read, written, strict=True):
        assert tick.stamp == stamp
        assert [type(r) for r in tick.readings] == [type(r) for r in readings]
        assert same(tick.readings, readings) and same(tick.commands, commands)
        np.testing.assert_array_equal(tick.readings[3].depth_mm, readings[3].depth_mm)
        np.testing.assert_array_equal(tick.readings[4].image, readings[4].image)
        assert tick.readings[8:] == readings[8:]


def test_a_log_holds_the_belief_as_it_was_changed(tmp_path):
    """In `mapping` the depth camera is drawn wrong: with another drawing the replay differs."""
    config = with_wrong_camera(belief("arms=1"), np.random.default_rng(0))
    write_log(tmp_path / "readings.log", 1, config)
    read = read_config(tmp_path / "readings.log")
    assert read.site == config.site and read.options == config.options
    for field in fields(config):
        if field.name not in ("site", "options"):
            mine, logged = getattr(config, field.name), getattr(read, field.name)
            assert mine == logged if field.name == "arm_model" else same(mine, logged), field.name


def test_a_log_holds_the_maps_that_were_driven_by(tmp_path):
    rng = np.random.default_rng(1)
    (tmp_path / "mine").mkdir()
    for name in ("lidar", "fused"):
        cells = rng.choice(np.array([-4, 0, 4], np.float32), (20, 30))
        save_map(
            OccupancyGrid(np.array([-1.05, 1 / 3]), 0.05, cells), tmp_path / f"mine/{name}.yaml"
        )
    path = tmp_path / "readings.log"
    write_log(path, 1, belief(f"options.map={tmp_path / 'mine'}"))
    with pytest.raises(ValueError, match="a folder is needed"):
        read_config(path)
    config = read_config(path, tmp_path / "again")
    assert config.options.map == str(tmp_path / "again")
    for name in ("lidar", "fused"):
        a, b = (load_map(tmp_path / folder / f"{name}.yaml") for folder in ("mine", "again"))
        assert same((a.origin, a.resolution, a.log_odds), (b.origin, b.resolution, b.log_odds))


def test_same_run_same_bytes(tmp_path):
    write_log(tmp_path / "a")
    write_log(tmp_path / "b")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


@pytest.mark.parametrize("lost", [1, 100, 20000])
def test_a_log_cut_off_reads_up_to_there(lost, tmp_path):
    path = tmp_path / "readings.log"
    written = write_log(path)
    path.write_bytes(path.read_bytes()[:-lost])
    assert 0 < len(list(read_log(path))) < len(written)


def test_another_file_is_turned_away(tmp_path):
    (tmp_path / "x").write_text("stamp,x,y")
    with pytest.raises(ValueError, match="not a log"):
        list(read_log(tmp_path / "x"))


def test_same_tells_the_sign_of_zero_and_the_last_bit():
    assert same(np.array([np.nan]), np.array([np.nan]))
    assert not same(0.0, -0.0)
    assert not same(np.array([1.0]), np.array([np.nextafter(1.0, 2.0)]))
    assert not same(Commands(), Commands(BodyVelocity(1e-18)))


@given(st.floats(), hnp.arrays(np.float64, hnp.array_shapes(max_dims=3, min_side=0)))
def test_numbers_survive(number, array):
    assert same(decode(*encode((number, array))), (number, array))


def test_a_log_is_read_where_no_simulator_is(tmp_path):
    write_log(tmp_path / "readings.log")
    code = (
        "import sys; sys.modules.update(mujoco=None, dm_control=None, rerun=None)\n"
        "from pathlib import Path; from twin.recording.log import read_log\n"
        "print(sum(len(t.readings) for t in read_log(Path(sys.argv[1]))))"
    )
    run = [sys.executable, "-c", code, str(tmp_path / "readings.log")]
    assert subprocess.check_output(run, text=True).strip() == "50"

"""The plant as the loop sees it: every sensor at its rate and latency, seeds, bad models."""

import shutil

import numpy as np
import pytest

from twin.cli import main
from twin.layout import load_layout, models_dir
from twin.messages import ArmReading, Commands, GripperReading, LidarScan, RgbdFrame
from twin.plant import factory
from twin.plant.plant import STEPS_PER_TICK, Plant

SECONDS = 3.0
# Message, of which arm: period and latency, s.
RATES = {
    ("ImuReading", None): (0.010, 0.002),
    ("LidarScan", None): (0.100, 0.030),
    ("CameraFrame", None): (0.050, 0.040),
    ("RgbdFrame", None): (0.100, 0.050),
    ("FloorFrame", None): (0.050, 0.030),
    ("ArmReading", 0): (0.010, 0.004),
    ("ArmReading", 1): (0.010, 0.004),
    ("GripperReading", 0): (0.010, 0.004),
    ("GripperReading", 1): (0.010, 0.004),
}


def deliveries(seed: int = 0, seconds: float = SECONDS, scale: float = 1.0):
    """All readings of a vehicle at rest, with the times of their arrival."""
    layout = load_layout(None, (f"world.sensors.latency_scale={scale}",))
    plant, found = Plant(layout, seed), []
    try:
        plant.apply(Commands(mast_camera=True))
        for _ in range(round(seconds * 100)):
            found += [(plant.time, reading) for reading in plant.readings()]
            for _ in range(STEPS_PER_TICK):
                plant.step(np.zeros(4))
    finally:
        plant.close()
    return found


def kind(reading) -> tuple[str, int | None]:
    return type(reading).__name__, getattr(reading, "arm", None)


@pytest.fixture(scope="module")
def delivered():
    return deliveries()


def test_every_sensor_is_known_here(delivered):
    assert {kind(r) for _, r in delivered} == {*RATES, ("Order", None)}


@pytest.mark.parametrize("key", RATES, ids=lambda k: f"{k[0]}{'' if k[1] is None else k[1]}")
@pytest.mark.parametrize("scale", [1, 2])
def test_sensor_keeps_its_rate_and_latency(key, scale, delivered, request):
    rows = delivered if scale == 1 else request.getfixturevalue("delivered_late")
    period, latency = RATES[key]
    arrival, stamp = np.array([(t, r.stamp) for t, r in rows if kind(r) == key]).T
    np.testing.assert_allclose(stamp, np.arange(len(stamp)) * period, atol=1e-6)
    assert len(stamp) == pytest.approx((SECONDS - latency * scale) / period, abs=1.01)
    # It is heard at the first tick of 10 ms after the latency has passed.
    late = arrival - stamp
    assert (late >= latency * scale - 1e-6).all() and (late < latency * scale + 0.010).all()


@pytest.fixture(scope="module")
def delivered_late():
    return deliveries(scale=2.0)


def test_the_order_comes_once(delivered):
    orders = [r for _, r in delivered if kind(r)[0] == "Order"]
    assert len(orders) == 1
    assert dict(orders[0].items) == load_layout().world.order


def test_readings_are_of_the_size_that_was_asked_for(delivered):
    scan = next(r for _, r in delivered if isinstance(r, LidarScan))
    frame = next(r for _, r in delivered if isinstance(r, RgbdFrame))
    assert len(scan.ranges) >= 720 and np.isfinite(scan.ranges).any()
    assert frame.rgb.shape[:2] == frame.depth_mm.shape and frame.depth_mm.any()
    for arm in range(2):
        q = [r.position for _, r in delivered if isinstance(r, ArmReading) and r.arm == arm]
        assert q[0].shape == (6,)
        assert any(isinstance(r, GripperReading) and r.arm == arm for _, r in delivered)


def test_same_seed_same_readings():
    a, b, other = deliveries(7, 0.3), deliveries(7, 0.3), deliveries(8, 0.3)
    assert [(t, kind(r), r.stamp) for t, r in a] == [(t, kind(r), r.stamp) for t, r in b]
    imu = [
        np.array([r.gyro for _, r in rows if kind(r)[0] == "ImuReading"]) for rows in (a, b, other)
    ]
    np.testing.assert_array_equal(imu[0], imu[1])
    assert not np.array_equal(imu[0], imu[2])
    pictures = [[r.image for _, r in rows if kind(r)[0] == "CameraFrame"] for rows in (a, b, other)]
    np.testing.assert_array_equal(pictures[0], pictures[1])
    assert not np.array_equal(pictures[0], pictures[2])


BROKEN = {
    "missing": (lambda path: path.unlink(), "model file is missing"),
    "include outside": (
        lambda path: path.write_text('<mujoco><include file="../../../etc/passwd"/></mujoco>'),
        "outside the models' folder",
    ),
    "not xml": (lambda path: path.write_text("belt"), "not an MJCF file"),
}


@pytest.mark.parametrize("harm, said", BROKEN.values(), ids=BROKEN)
def test_a_model_that_cannot_be_used_ends_in_one_line(harm, said, tmp_path, monkeypatch, capsys):
    """Expected: exit code 2, the file named, an earlier run's report untouched."""
    models = shutil.copytree(models_dir(), tmp_path / "models")
    harm(models / "line" / "line.xml")
    monkeypatch.setattr(factory, "models_dir", lambda: models)
    out = tmp_path / "out"
    out.mkdir()
    (out / "report.json").write_text("earlier")
    assert main(["run", "pick_line", "--out", str(out)]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    assert "line.xml" in captured.err and said in captured.err
    assert [p.name for p in out.iterdir()] == ["report.json"]
    assert (out / "report.json").read_text() == "earlier"

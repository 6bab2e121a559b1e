"""Layouts that the photoelectric network's scenarios refuse, in one line."""

import pytest

from evaluation import beacon_field
from evaluation.beacon_field import DOCK, WEST, calibrated_field, in_the_field
from evaluation.run import RunRequest
from scenarios.beacon_faults import HELD, with_trouble
from twin.cli import main
from twin.layout import LayoutError, load_layout, models_dir


def test_a_layout_without_a_network_is_refused():
    short = load_layout(models_dir() / "cell" / "short.toml")
    with pytest.raises(LayoutError, match="no photoelectric network") as error:
        in_the_field(short)
    assert "\n" not in str(error.value)


def test_a_field_that_is_not_free_is_refused():
    layout = load_layout(None, ("site.goods_in=[2.5, 2.04, 0.0]",))
    with pytest.raises(LayoutError, match="field before the truss") as error:
        in_the_field(layout)
    assert "\n" not in str(error.value)


def test_what_the_layout_says_is_kept():
    """Expected: a dock in the field, tags and faults stay; another dock is replaced."""
    faults = 'world.faults.beacons={blocked=["T3"]}'
    asked = load_layout(None, ("site.dock=[2.0, 2.2, 3.0]", "options.tags=true", faults))
    field = in_the_field(with_trouble(asked))
    assert field.site.dock == (2.0, 2.2, 3.0) and field.options.tags
    assert field.world.faults.beacons.blocked == ("T3",)
    assert field.world.faults.beacons.shuffle == HELD
    assert in_the_field(load_layout()).site.dock == DOCK
    often = load_layout(None, ("world.faults.beacons.shuffle=5",))
    assert with_trouble(often).world.faults.beacons.shuffle == 5


def test_too_many_faults_for_the_lot_are_refused():
    layout = load_layout(None, ('world.faults.beacons.blocked=["T1","T2","T3","T4","T5"]',))
    with pytest.raises(LayoutError, match="wants two nodes without a fault") as error:
        in_the_field(with_trouble(layout))
    assert "\n" not in str(error.value)


def test_the_calibration_drive_counts_in_the_duration(tmp_path):
    left = calibrated_field(RunRequest(0, tmp_path, duration=0.5), load_layout())
    assert left == "the calibration drive was broken off"
    assert list(tmp_path.iterdir()) == []


PLACES = ((1.8, 0.42), (3.6, 0.42), (3.6, 1.42), (1.8, 1.42), (2.97, 1.42), (2.43, 0.42))


@pytest.mark.parametrize(
    ("facing", "x", "dy", "dz"),
    [
        (3.14159, -0.94, 0.0, 0.0),  # to the wall
        (0.0, 60.0, 0.0, 0.0),
        (0.0, -0.94, 30.0, 0.0),
        (0.0, -0.94, 0.0, -2.0),
        (0.0, 1.5, 0.0, 0.0),  # behind some stops
        (0.0, -12.0, 0.0, 0.0),
    ],
)
def test_a_truss_out_of_sight_is_refused(facing, x, dy, dz, tmp_path, capsys):
    nodes = ", ".join(
        f'{{name="T{i}", position=[{x}, {y + dy}, {z + dz}], facing={facing}}}'
        for i, (y, z) in enumerate(PLACES)
    )
    run = ["run", "beacon_repeat", "--out", str(tmp_path / "out")]
    assert main([*run, "--set", f"site.beacons.nodes=[{nodes}]"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "of 6 in range and view of the head at" in said


def test_a_network_that_misses_every_pulse_is_refused():
    with pytest.raises(LayoutError, match="leaves no light pulse") as error:
        in_the_field(load_layout(None, ("world.beacons.missed=1",)))
    assert "\n" not in str(error.value)


def test_a_calibration_that_hears_nothing_ends_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(beacon_field, "STOPS", ((2.3, 2.6, WEST),))
    monkeypatch.setattr(beacon_field, "DWELL", 0.2)
    layout = load_layout(None, ("world.beacons.missed=0.97",))
    left = calibrated_field(RunRequest(0, tmp_path), layout)
    assert isinstance(left, str) and left.startswith("the calibration drive found nothing")
    assert "\n" not in left and list(tmp_path.iterdir()) == []

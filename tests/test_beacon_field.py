"""Layouts that the photoelectric network's scenarios refuse, in one line."""

import pytest

from evaluation.beacon_field import DOCK, calibrated_field, in_the_field
from evaluation.run import RunRequest
from scenarios.beacon_faults import HELD, with_trouble
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
    assert calibrated_field(RunRequest(0, tmp_path, duration=0.5), load_layout()) is None
    assert list(tmp_path.iterdir()) == []

"""Layouts that the photoelectric network's scenarios refuse, in one line."""

import pytest

from evaluation.beacon_field import in_the_field
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

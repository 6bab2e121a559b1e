"""Layouts: the default cell, overrides, and what cannot be built."""

import pytest

from twin.geometry import rectangle, rectangles_overlap
from twin.layout import SHORT_NAMES, Faults, LayoutError, load_layout, models_dir
from twin.messages import PART_CLASSES


def test_default_cell_is_the_one_of_the_issue():
    layout = load_layout()
    assert layout.world.line.speed == 0.15
    assert sum(layout.world.order.values()) == 20
    assert layout.options.arms == 2 and layout.options.grasp_timing
    assert abs(layout.site.pick[0] - layout.site.dock[0]) >= 4.0
    assert len(layout.site.racks) == 8 and layout.site.goods_in is not None
    assert layout.world.faults == Faults()


def test_short_names_lead_somewhere():
    for short in SHORT_NAMES:
        value = {"order": "5", "grasp_timing": "off", "arms": "1"}.get(short, "0.2")
        load_layout(None, (f"{short}={value}",))


def test_later_overrides_win():
    assert load_layout(None, ("belt_speed=0.1", "belt_speed=0.2")).world.line.speed == 0.2


@pytest.mark.parametrize("total", [1, 7, 20, 28])
def test_an_order_by_number_is_spread_evenly(total):
    order = load_layout(None, (f"order={total}",)).world.order
    assert sum(order.values()) == total
    assert max(order.values()) - min(order.values()) <= 1


def test_an_order_by_class():
    order = load_layout(None, ("order=sma_f_n_m:3,n_tee_fff:2",)).world.order
    assert order == {"sma_f_n_m": 3, "n_tee_fff": 2}


def test_another_file(tmp_path):
    text = (models_dir() / "cell" / "default.toml").read_text()
    path = tmp_path / "fast.toml"
    path.write_text(text.replace("speed = 0.15", "speed = 0.3"))
    assert load_layout(path).world.line.speed == 0.3


@pytest.mark.parametrize("name", ["dock", "pick", "receiving", "goods_in", "rack 3"])
def test_a_place_cannot_take_the_name_of_a_stop(name):
    """Expected: refused; it would silently send the vehicle elsewhere."""
    place = f'site.places=[{{name="{name}", pose=[1.0, 1.0, 0.0]}}]'
    with pytest.raises(LayoutError, match=f"place '{name}': there is another stop of that name"):
        load_layout(None, (place,))


def test_a_place_is_named_once():
    place = '{name="corner", pose=[1.0, 1.0, 0.0]}'
    assert load_layout(None, (f"site.places=[{place}]",)).site.places[0].name == "corner"
    with pytest.raises(LayoutError, match="place 'corner': there is another stop"):
        load_layout(None, (f"site.places=[{place}, {place}]",))


@pytest.mark.parametrize(
    "override, said",
    [
        ("belt_speed=-0.1", "world.line.speed"),
        ("belt_speed=nan", "nan"),
        ("belt_speed=inf", "inf"),
        ("belt_speed=quick", "quick"),
        ("arms=3", "options.arms"),
        ("order=0", "1 to 28"),
        ("order=29", "1 to 28"),
        ("order=bnc:1", ", ".join(PART_CLASSES)),
        ("nonsense=1", ", ".join(SHORT_NAMES)),
        ("world.line.sped=1", "choose from speed, friction"),
        ("site.line.origin.x=1", "origin"),
        ("belt_speed", "key=value"),
        ("site.pick=[3.6, 3.2, 1.57]", "pick: the vehicle would stand in the belt"),
        ("site.dock=[-0.9, 0.0, 0.0]", "dock post: reaches outside the hall"),
        ("site.line.origin=[3.55, 8.0]", "outside the hall"),
        ("site.hall.x=[5, 1]", "low to high"),
        ("site.dock=[nan, 0.0, 0.0]", "finite"),
    ],
)
def test_what_cannot_be_built_is_told_in_one_line(override, said):
    with pytest.raises(LayoutError) as error:
        load_layout(None, (override,))
    assert said in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("content", [b"[site", b"\xff\xfe", b"", b"site = 3"])
def test_malformed_files_are_named(content, tmp_path):
    path = tmp_path / "odd.toml"
    path.write_bytes(content)
    with pytest.raises(LayoutError, match=r"odd\.toml") as error:
        load_layout(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("path", ["nowhere.toml", "."])
def test_a_file_that_cannot_be_read_is_named(path, tmp_path):
    with pytest.raises(LayoutError, match="cannot be read"):
        load_layout(tmp_path / path)


def rack(number: int, x: float) -> str:
    return f"{{number = {number}, pose = [{x}, 0.5, 0.0]}}"


def test_overlap_of_turned_rectangles():
    """Expected: boxes whose upright bounds overlap may still be apart."""
    first = rectangle(0, 0, 0.785398, 2.0, 0.1)
    assert not rectangles_overlap(first, rectangle(0.5, -0.5, 0.785398, 2.0, 0.1))
    assert rectangles_overlap(first, rectangle(0.5, 0.5, -0.785398, 2.0, 0.1))


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("site.line.origin=[3.55, 0.9]", "belt: reaches outside the hall"),
        ("site.pick=[4.1, 3.2, 1.5707963]", "0.45 m to the left"),
        ("site.pick=[4.0, 4.2, 1.5707963]", "ahead of the vehicle"),
        ("site.pick_approach=[2.5, 3.2, 1.5707963]", "would run into the belt"),
        ("site.pick_approach=[3.5, 1.9, 1.5707963]", "stand in the belt"),
        ("site.receiving=[14.7, 3.2, 1.57]", "receiving table: reaches outside the hall"),
        ("site.receiving=[6.0, 3.2, 1.57]", "receiving table and partition 0 overlap"),
        ("site.pick_leave=[6.1, 1.4, 1.5707963]", "would run into the receiving table"),
        ("site.goods_in=[5.2, 7.3, 0.0]", "goods-in stand: reaches outside the hall"),
        ("site.hall.partitions=[[4.0, 0.0, 4.0, 3.0]]", "would stand in the partition 0"),
        (f"site.racks=[{rack(1, 9.3)}, {rack(1, 12.7)}]", "rack 1: stands there twice"),
        (f"site.racks=[{rack(1, 9.3)}, {rack(2, 11.6)}]", "rack 1 and rack 2 overlap"),
        (f"site.racks=[{rack(1, 14.2)}]", "rack 1: reaches outside the hall"),
        ('site.tags=[{name = "A1", pose = [1, 1, 0], next = ["A2"]}]', "'?A2'? does not exist"),
        ('world.faults.tags=[{tag = "Z9", kind = "damaged"}]', "no tag 'Z9'"),
        (
            'world.faults.tags=[{tag = "M1", kind = "damaged"}, {tag = "M1", kind = "foreign"}]',
            "two faults of tag 'M1'",
        ),
        ("world.faults.wet=[{x = [4.0, 1.6], y = [-1.0, 1.0]}]", "x: .4.0, 1.6. must go from low"),
        ("world.faults.wet=[{x = [1.6, 4.0], y = [1.0, 1.0]}]", "y: .* must go from low to high"),
        ('options.motion_model="diff"', "'omni' or 'turn_path_turn'"),
        ('world.faults.obstacles=[{kind = "bus", pose = [1, 1, 0]}]', "carton"),
        (
            'world.faults.obstacles=[{kind = "table", pose = [1, 1, 0], size = 3}]',
            "choose from kind, pose",
        ),
        ("world.faults.movers=[{path = [[1, 1]]}]", "at least 2 items"),
        ("site.hall.x=[-1, 1e308]", "less than or equal to 1000"),
        ("order=sma_f_n_m:3,sma_f_n_m:2", "twice"),
        ("belt_speed=0", "greater than or equal to 0.05"),
        ("world.feeder.lateral=0.07", "takes at most 0.060"),
    ],
)
def test_a_cell_that_could_not_work_is_refused(override, words):
    with pytest.raises(LayoutError, match=words):
        load_layout(None, (override,))


def test_a_belt_that_runs_with_the_vehicle_is_refused():
    """Expected result: refused, since the mast camera would see parts only when they are past."""
    overrides = ("site.line.direction=1.5707963", "site.line.origin=[3.55, 2.0]")
    with pytest.raises(LayoutError, match="must run against the vehicle's heading"):
        load_layout(None, overrides)

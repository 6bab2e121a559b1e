"""Scenarios in a hall that they were not drawn for: they follow its drawing or refuse it."""

import numpy as np
import pytest

from evaluation.run import RunRequest
from scenarios import kidnap, mapping, navigate, odometry, warehouse_qr
from twin.cli import main
from twin.floor_plan import FOOTPRINT, stops
from twin.geometry import rectangle, rectangles_overlap
from twin.layout import LayoutError, load_layout, models_dir
from twin.plant.fault_plan import check_faults
from twin.plant.obstacles import OUTLINE

SHORT = models_dir() / "cell" / "short.toml"
NO_TAGS = "site.tags=[]"
ONE_TAG = 'site.tags=[{name="A", pose=[7.35, 1.55, 0.0]}]'


def test_the_short_hall_can_be_built_and_holds_fewer_racks():
    short, whole = load_layout(SHORT).site, load_layout().site
    assert short.hall.x[1] < whole.hall.x[1] and len(short.racks) < len(whole.racks)
    assert {"pick", "receiving", "goods_in", "rack 3"} <= set(stops(short))


def test_a_route_drawn_for_another_hall_is_refused_before_anything_runs(tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["run", "mapping", "--layout", str(SHORT), "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and said.startswith("twin: mapping: its route")
    assert "outside the hall" in said and not out.exists()


def test_the_course_follows_the_walls_of_the_short_hall():
    site = load_layout(SHORT).site
    course = odometry.drawn_course(site)
    assert course.east == pytest.approx((site.hall.x[1] - 0.65, site.hall.y[0] + 0.85))
    for patch in odometry.patches(course, np.random.default_rng([0, 1])):
        assert patch.x[1] < site.hall.x[1] + 1e-9


@pytest.mark.parametrize("scenario, y", [(odometry, 0.0), (mapping, -0.6)])
def test_a_machine_on_the_way_is_named(scenario, y, tmp_path):
    wall = f"site.hall.partitions=[[14.5, -1.5, 14.5, {y}]]"
    with pytest.raises(LayoutError, match="stand in the partition 0"):
        scenario.run(RunRequest(seed=0, out=tmp_path), load_layout(None, (wall,)))


@pytest.mark.parametrize("rack", [1, 2, 3, 4])
@pytest.mark.parametrize("file", [None, SHORT])
def test_transport_follows_the_drawing_to_any_rack(file, rack):
    layout = load_layout(file, (f"world.parcel.rack={rack}",))
    way = warehouse_qr.tag_way(layout)
    assert way[0].name == "G0" and way[-1].name == f"R{rack}"
    for seed in range(5):
        drawn = warehouse_qr.with_faults(layout, np.random.default_rng([seed, 2]))
        check_faults(drawn)  # what stands in the way finds room
        assert drawn.world.faults.tags[0].tag in [tag.name for tag in way[:-1]]


@pytest.mark.parametrize("file", [None, SHORT])
def test_hazards_stand_clear_of_where_the_vehicle_must_stand(file):
    """Expected: all can be built, and whatever stands leaves every goal and each other free."""
    layout = load_layout(file)
    for seed in range(20):
        drawn = navigate.with_faults(layout, np.random.default_rng([seed, 1]))
        check_faults(drawn)
        faults = drawn.world.faults
        assert sum(o.near > 0 for o in faults.obstacles) == navigate.SUDDEN
        assert len(faults.obstacles) == 7 and len(faults.movers) == 2
        boxes = [rectangle(*o.pose, *OUTLINE[o.kind]) for o in faults.obstacles]
        for i, box in enumerate(boxes):
            others = [rectangle(*pose, *FOOTPRINT) for pose in stops(layout.site).values()]
            assert not any(rectangles_overlap(box, other) for other in (*boxes[:i], *others))


@pytest.mark.parametrize(
    "overrides, said",
    [
        (("site.racks=[]",), "navigate: the drawing has no racks"),
        (("world.hazards.mouths=[]",), "navigate: nothing can appear before the vehicle"),
    ],
)
def test_a_plant_in_which_navigate_could_never_pass_is_refused(overrides, said, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["run", "navigate", "--out", str(out), "--set", *overrides]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and said in error and not out.exists()


def test_obstacles_of_the_layouts_own_may_appear_in_place_of_the_hazards():
    near = 'world.faults.obstacles=[{kind="carton", pose=[8.5, 1.95, 0.0], near=2.0}]'
    navigate.check_layout(load_layout(None, ("world.hazards.mouths=[]", near)))


SCENARIOS = ("pick_line", "odometry", "navigate", "warehouse_qr", "kidnap")


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_the_scenarios_begin_in_the_short_hall(scenario, tmp_path):
    """Without tags where they are not the point: for what leans on them there is another way."""
    run = ["run", scenario, "--layout", str(SHORT), "--duration", "0.3", "--out", str(tmp_path)]
    tags = [] if scenario == "warehouse_qr" else ["--set", NO_TAGS]
    assert main([*run, *tags]) == 1  # cut short
    assert (tmp_path / "report.json").exists() and not (tmp_path / "error.txt").exists()


def test_a_tag_has_one_fault_alone():
    fault = 'world.faults.tags=[{tag="W4", kind="damaged"}, {tag="W3", kind="foreign"}]'
    for seed in range(8):
        layout = load_layout(None, (fault,))
        faults = warehouse_qr.with_faults(layout, np.random.default_rng([seed, 2])).world.faults
        assert len({f.tag for f in faults.tags}) == len(faults.tags) == 3


@pytest.mark.parametrize(
    "overrides, said",
    [
        (("world.parcel.rack=9",), "no rack 9; choose from 1, 2, 3, 4, 5, 6, 7, 8"),
        (("site.racks=[]",), "the drawing has no racks"),
        ((NO_TAGS,), "no floor tags"),
        ((ONE_TAG,), "no 1.5 m from tag to tag"),
    ],
)
def test_a_transport_that_cannot_be_is_refused_before_anything_runs(
    overrides, said, tmp_path, capsys
):
    out = tmp_path / "out"
    run = ["run", "warehouse_qr", "--out", str(out), "--set", *overrides]
    assert main(run) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and said in error and not out.exists()


@pytest.mark.parametrize("overrides", [(), (NO_TAGS,), (ONE_TAG,), ("site.racks=[]", NO_TAGS)])
@pytest.mark.parametrize("file", [None, SHORT])
def test_kidnappings_find_goals_and_places_in_any_hall(file, overrides):
    site = load_layout(file, overrides).site
    rng = np.random.default_rng(0)
    floor = kidnap.Floor(site)
    goals = kidnap.draw_goals(site, rng)
    assert len(goals) == kidnap.GOALS and all(floor.is_free(goal.pose) for goal in goals)
    assert floor.is_free(floor.anywhere(rng))


def test_a_hall_without_room_is_refused(monkeypatch):
    floor = kidnap.Floor(load_layout().site)
    monkeypatch.setattr(floor, "is_free", lambda pose: False)
    with pytest.raises(LayoutError, match="no free floor"):
        floor.anywhere(np.random.default_rng(0))

"""The transport order: way from tag to tag, the arm's part of it, and what is counted."""

from dataclasses import dataclass, field, replace
from itertools import pairwise, permutations
from types import SimpleNamespace

import numpy as np
import pytest
from parcel_bench import PARCEL, ParcelBench
from py_trees.common import Status

from evaluation.run import RunRequest
from evaluation.transport import STRIP, TransportMonitor
from scenarios import warehouse_qr
from twin.floor_plan import RACK
from twin.geometry import pose2_to_transform, rot_x, transform
from twin.layout import load_layout
from twin.loop import Tick
from twin.messages import Commands, Goal, StackState, TagSight
from twin.plant.grips import Grip
from twin.plant.world import Truth
from twin.site import Tag
from twin.stack.config import nominal_config
from twin.stack.detection.goods import GoodsSight
from twin.stack.grasping.tray import TrayBook
from twin.stack.planning.tag_route import nearest_tag, tag_route
from twin.stack.tasks.porter import Place
from twin.stack.tasks.transport_mission import PATIENCE, SIGHTS, TagDrive, Transport, goals_along

LAYOUT = load_layout()
CONFIG = nominal_config(LAYOUT.site, LAYOUT.options)
TAGS = LAYOUT.site.tags
RACK7 = next(rack for rack in LAYOUT.site.racks if rack.number == 7)


# --- from tag to tag -----------------------------------------------------------------------------


def graph(**edges: str) -> list[Tag]:
    """Tags on the corners of a unit grid; `A="BC"` leads from A to B and C."""
    at = {name: (i % 3, i // 3) for i, name in enumerate("ABCDEF")}
    return [Tag(name=n, pose=(*at[n], 0.0), next=tuple(edges.get(n, ""))) for n in at]


def length(route) -> float:
    xy = np.array([tag.pose[:2] for tag in route])
    return float(np.hypot(*np.diff(xy, axis=0).T).sum())


def test_route_by_hand():
    tags = graph(A="BD", B="C", D="E", E="F", F="C", C="")
    assert [t.name for t in tag_route(tags, "A", "C")] == ["A", "B", "C"]
    assert [t.name for t in tag_route(tags, "A", "A")] == ["A"]
    with pytest.raises(ValueError, match="no way leads from tag C to tag A"):
        tag_route(tags, "C", "A")  # one way
    with pytest.raises(ValueError, match="no tag 'Z9'"):
        tag_route(tags, "A", "Z9")


def test_route_is_shortest():
    """Against all ways without a repeat, on random graphs of six tags."""
    rng = np.random.default_rng(0)
    for _ in range(30):
        names = "ABCDEF"
        edges = {n: "".join(m for m in names if m != n and rng.random() < 0.4) for n in names}
        tags = {t.name: t for t in graph(**edges)}
        ways = []
        for k in range(5):
            for middle in permutations("BCDE", k):
                way = ["A", *middle, "F"]
                if all(b in edges[a] for a, b in pairwise(way)):
                    ways.append(length([tags[n] for n in way]))
        if not ways:
            with pytest.raises(ValueError, match="no way"):
                tag_route(list(tags.values()), "A", "F")
            continue
        assert length(tag_route(list(tags.values()), "A", "F")) == pytest.approx(min(ways))


def test_drawn_graph_leads_from_goods_in_to_every_rack():
    start = nearest_tag(TAGS, LAYOUT.site.goods_in)
    for rack in LAYOUT.site.racks:
        route = tag_route(TAGS, start.name, f"R{rack.number}")
        for a, b in pairwise(route):
            assert b.name in a.next


def test_no_tags_no_route():
    with pytest.raises(ValueError, match="no floor tags"):
        nearest_tag((), (0.0, 0.0))


# --- what the mission does with them --------------------------------------------------------------


@dataclass
class FakeNavigator:
    """Ends each drive at once, as told."""

    bad: tuple[str, ...] = ()
    active: bool = False
    outcome: str = ""
    went: list[str] = field(default_factory=list)

    def go(self, now: float, goal: Goal) -> None:
        self.went.append(goal.name)
        self.outcome = "gave up" if goal.name in self.bad else "reached"


def fake_stack(pose=(5.2, 7.05, 0.0), bad=(), config=CONFIG):
    arm = SimpleNamespace(config=config, events=[])
    history = SimpleNamespace(at=lambda stamp: np.zeros(3))
    return SimpleNamespace(
        config=config,
        now=0.0,
        pose=np.array(pose),
        arms=(arm, arm),
        navigator=FakeNavigator(bad),
        localiser=SimpleNamespace(fused=SimpleNamespace(history=history), sights=[]),
        on_picture=None,
    )


def drive(stack, rack: int) -> tuple[Status, list[str]]:
    job = Transport(stack)
    job.rack = rack
    leaf = TagDrive("drive", job)
    for _ in range(20):
        leaf.tick_once()
        if leaf.status is not Status.RUNNING:
            break
    return leaf.status, stack.navigator.went


def test_drives_to_each_tag_of_the_route():
    status, went = drive(fake_stack(), 7)
    route = tag_route(TAGS, "G0", "R7")[1:]  # it stands on the first
    tags = [name for name in went if name.startswith("tag")]
    assert status is Status.SUCCESS and tags == [f"tag {t.name}" for t in route]


def test_faces_the_way_and_steps_sideways_to_the_rack():
    route = tag_route(TAGS, "M3", "R7")  # M3 M2 Q2 R7: south, east, and 0.39 m north
    goals = goals_along(np.array(route[0].pose), route[1:])
    south = -np.pi / 2
    assert [(g.name, round(g.pose[2], 6)) for g in goals] == [
        ("turn at start", round(south, 6)),
        ("tag M2", round(south, 6)),
        ("turn at tag M2", 0.0),
        ("tag Q2", 0.0),
        ("tag R7", 0.0),
    ]
    assert goals[2].pose[:2] == goals[1].pose[:2] == route[1].pose[:2]


def test_a_tag_out_of_reach_is_left_out_but_not_the_last():
    status, went = drive(fake_stack(bad=("tag W4",)), 7)
    assert status is Status.SUCCESS and went[-1] == "tag R7"
    status, _ = drive(fake_stack(bad=("tag R7",)), 7)
    assert status is Status.FAILURE


def closed(stack, tag: str, next_nodes: tuple[str, ...], action="fused"):
    """From when the vehicle stands on a tag, that is read and says where ways lead."""
    go = stack.navigator.go
    at = {f"tag {t.name}": t.pose for t in TAGS}

    def arrive(now, goal):
        go(now, goal)
        stack.pose = np.array(goal.pose)
        read = goal.name == f"tag {tag}"
        sight = TagSight(0.0, tag, action, np.array(at[f"tag {tag}"]), next_nodes)
        stack.localiser.sights = [sight] if read else []

    stack.navigator.go = arrive


def test_a_tag_that_says_that_its_way_is_closed_is_believed():
    """Expected: W3 leads to W2 alone now, not to P3: the way goes by the aisle further south."""
    stack = fake_stack()
    closed(stack, "W3", ("W2", "NEW"))
    status, went = drive(stack, 7)
    tags = [name.removeprefix("tag ") for name in went if name.startswith("tag")]
    assert status is Status.SUCCESS
    assert tags == ["W4", "W3", "W2", "P2", "M2", "Q2", "R7"]
    assert "a tag says that no way leads on as drawn" in stack.arms[0].events


@pytest.mark.parametrize(
    "how", [{"next_nodes": ("P3", "W2")}, {"next_nodes": (), "action": "refused"}]
)
def test_hints_that_agree_or_are_not_believed_change_nothing(how):
    stack = fake_stack()
    closed(stack, "W3", **how)
    status, went = drive(stack, 7)
    route = [f"tag {t.name}" for t in tag_route(TAGS, "G0", "R7")[1:]]
    assert status is Status.SUCCESS and [n for n in went if n.startswith("tag")] == route


def test_a_tag_from_which_nothing_leads_on_ends_it_with_a_reason():
    stack = fake_stack()
    closed(stack, "W3", ())
    status, _ = drive(stack, 7)
    assert status is Status.FAILURE
    assert "no way leads from tag W3" in stack.arms[0].events[-1]


def test_a_graph_without_a_way_fails_with_a_reason():
    tags = tuple(t.model_copy(update={"next": ()}) for t in TAGS)
    config = replace(CONFIG, site=CONFIG.site.model_copy(update={"tags": tags}))
    stack = fake_stack(config=config)
    status, went = drive(stack, 7)
    assert status is Status.FAILURE and went == []
    assert "no way leads" in stack.arms[0].events[-1]


def hear(job: Transport, *sights: GoodsSight) -> None:
    """As the camera would bring them."""
    told = iter(sights)
    job._reader = SimpleNamespace(read=lambda frame, about: next(told), refused="")
    for sight in sights:
        job.stack.on_picture(SimpleNamespace(stamp=sight.stamp))


def sight(rack: int, x: float = 0.4) -> GoodsSight:
    return GoodsSight(1.0, rack, np.array([x, 0.45, 0.0]))


def test_a_goods_code_must_be_read_often_and_agree():
    job = Transport(fake_stack())
    job.look()
    hear(job, *[sight(7)] * (SIGHTS - 1))
    assert not job.read()
    hear(job, sight(7, 0.41))  # 10 mm away: something moves
    assert not job.read()
    hear(job, *[sight(7)] * SIGHTS)
    assert job.read() and job.rack == 7 and job.stack.on_picture is None


def test_sights_of_two_codes_are_not_mixed():
    job = Transport(fake_stack())
    job.look()
    hear(job, *[sight(7)] * (SIGHTS - 1), sight(3))
    assert not job.read() and not job.unread()


@pytest.mark.parametrize(("seen", "why"), [(0, "no goods code read"), (SIGHTS, "rack 99")])
def test_an_unread_or_unknown_code_ends_the_order_with_a_reason(seen, why):
    stack = fake_stack()
    job = Transport(stack)
    job.look()
    hear(job, *[sight(99)] * seen)
    assert not job.read() and not job.unread()
    stack.now = PATIENCE
    assert job.unread() and why in stack.arms[0].events[-1] and stack.on_picture is None


# --- the arm --------------------------------------------------------------------------------------


def test_loads_and_unloads_by_friction():
    """Expected: in the slot within its walls, then on the face within 5 mm, nothing touched."""
    bench = ParcelBench(4)
    slot = Place(tuple(TrayBook(bench.config, 2).take(0)), np.pi / 2)
    for _ in range(10):
        bench.step()
    bench.carry(bench.place(), slot)
    (x, y, _), z = bench.parcel_in_base()
    assert bench.porter.failure == "" and z == pytest.approx(0.556, abs=0.002)
    assert np.hypot(x - slot.position[0], y - slot.position[1]) < 0.004
    goal = Place((0.12, 0.45, 0.70), np.pi / 2)
    bench.carry(slot, goal)
    (x, y, _), z = bench.parcel_in_base()
    assert bench.porter.failure == "" and z == pytest.approx(0.70, abs=0.002)
    assert np.hypot(x - 0.12, y - 0.45) < 0.005
    assert bench.plant.world.collisions == []
    # What is not there cannot be taken; nor can anything be set down beyond the arm's reach.
    bench.carry(slot, goal)
    assert bench.porter.failure == "closed on nothing" and bench.porter.idle
    bench.carry(Place((1.5, 0.45, 0.70), 0.0), goal)
    assert "out of reach" in bench.porter.failure
    bench.close()


def test_a_parcel_taken_out_of_the_hand_is_noticed():
    bench = ParcelBench(5)
    slot = Place(tuple(TrayBook(bench.config, 2).take(0)), np.pi / 2)
    bench.porter.start(bench.now, bench.place(), slot)
    while bench.porter.step_name.value != "carrying":
        bench.step()
    for _ in range(20):
        bench.step()
    bench.plant.world.place_part(PARCEL, (6.0, 6.2, 0.1), (1, 0, 0, 0))  # somebody takes it
    for _ in range(600):
        bench.step()
        if bench.porter.idle:
            break
    bench.close()
    assert bench.porter.failure == "lost on the way" and bench.porter.idle


# --- what is counted ------------------------------------------------------------------------------


def told(position, R=None, speed=0.0, held=False, layout=LAYOUT) -> TransportMonitor:
    """The monitor after one tick with the parcel at x, y, z in the rack's frame."""
    T = pose2_to_transform(RACK7.pose) @ transform(np.eye(3) if R is None else R, position)
    quat = np.zeros(4)
    half = 0.5 * np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1))
    quat[0], quat[1] = np.cos(half), np.sin(half)  # tilted about x alone, if at all
    truth = Truth(
        stamp=1.0,
        pose=np.zeros(3),
        T_world_base=np.eye(4),
        velocity=np.zeros(3),
        joint_position=np.zeros((2, 6)),
        T_world_tcp=np.tile(np.eye(4), (2, 1, 1)),
        finger_width=np.zeros(2),
        grips=(Grip(PARCEL, 20.0) if held else Grip(None, 0.0), Grip(None, 0.0)),
        part_names=(PARCEL,),
        part_position=T[None, :3, 3],
        part_quat=quat[None],
        part_velocity=np.array([[speed, 0.0, 0.0]]),
    )
    z3 = np.zeros(3)
    state = StackState(1.0, z3, np.eye(3), z3, z3, z3, "")
    monitor = TransportMonitor(layout, CONFIG)
    monitor.observe(Tick(1.0, (), Commands(), state, truth))
    return monitor


FRONT = -RACK[1] / 2
GOOD = (0.12, FRONT + 0.09, 0.70)


def test_a_parcel_in_its_place_is_delivered():
    monitor = told(GOOD)
    assert monitor.delivered
    assert monitor.metrics() == {"delivered": 1.0, "placement_error_mm": pytest.approx(0, abs=1e-6)}
    assert told((0.12, FRONT + 0.10, 0.70)).placement_error() == pytest.approx(0.010)


@pytest.mark.parametrize(
    "how",
    [
        {"position": (0.12, FRONT + 0.01, 0.70)},  # half over the edge
        {"position": (0.12, FRONT + STRIP, 0.70)},  # on what stands there
        {"position": (RACK[0] / 2, FRONT + 0.09, 0.70)},
        {"position": (0.12, FRONT + 0.09, 0.72)},  # in the air
        {"position": (0.12, FRONT + 0.09, 0.0)},  # below
        {"position": GOOD, "R": rot_x(np.pi / 2)},
        {"position": GOOD, "speed": 0.1},
        {"position": GOOD, "held": True},
    ],
    ids=["edge", "too far", "end", "air", "floor", "tipped", "moving", "held"],
)
def test_what_is_not_delivered(how):
    monitor = told(**how)
    assert not monitor.delivered and np.isnan(monitor.metrics()["placement_error_mm"])


def test_what_is_told_again_and_again_is_noted_once():
    monitor = told(GOOD)
    for k in range(40):
        monitor._note(2.0 + 0.05 * k, f"tag P3: 0.0{k} m off, where the scan does not fit")
    monitor._note(4.0, "tag P3: reached")
    monitor._note(6.0, "tag P3: 0.1 m off, where the scan does not fit")
    assert [stamp for stamp, _ in monitor.events] == [2.0, 4.0, 6.0]


def test_another_racks_parcel_is_not_delivered_here():
    parcel = LAYOUT.world.parcel.model_copy(update={"rack": 3})
    world = LAYOUT.world.model_copy(update={"parcel": parcel})
    assert not told(GOOD, layout=LAYOUT.model_copy(update={"world": world})).delivered


# --- the scenario ---------------------------------------------------------------------------------


def test_seeds_draw_different_faults_that_can_be_built():
    drawn = []
    for seed in range(20):
        layout = warehouse_qr.with_faults(LAYOUT, np.random.default_rng([seed, 2]))
        again = warehouse_qr.with_faults(LAYOUT, np.random.default_rng([seed, 2]))
        assert layout == again
        drawn.append(layout.world.faults)
    assert {f.tags[0].kind for f in drawn} == {"misplaced", "damaged", "foreign"}
    assert len({f.obstacles[0].pose for f in drawn}) == 20
    assert {f.obstacles[0].near == 0.0 for f in drawn} == {True, False}
    names = {tag.name for tag in TAGS}
    assert {f.tags[0].tag for f in drawn} <= names - {"G0", "R7"}


@pytest.mark.slow
def test_the_whole_order(tmp_path):
    """Expected: delivered with and without tags; with them the pose is as exact as they lie."""
    result = warehouse_qr.run(RunRequest(seed=0, out=tmp_path), LAYOUT)
    m = result.metrics
    assert result.complete and m["delivered"] == m["delivered_lidar"] == 1
    assert m["collisions"] == m["collisions_lidar"] == 0
    assert m["qr_pose_error_p95_mm"] <= 10 and m["tags_read"] > 100
    assert m["placement_error_mm"] < 15

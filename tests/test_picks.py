"""Pick metrics on made-up ticks: what counts as an attempt, a drop, a miss, a delivery."""

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import pytest

from evaluation.picks import PickMonitor, part_class
from twin.geometry import pose2_to_transform, transform
from twin.layout import load_layout
from twin.loop import Tick
from twin.messages import Commands, GripperCommand, StackState
from twin.plant.grips import Grip
from twin.plant.world import Truth
from twin.stack.config import nominal_config

LAYOUT = load_layout(None, ("order=sma_f_n_m:2,n_tee_fff:1", "belt_speed=0.1"))
CONFIG = nominal_config(LAYOUT.site, LAYOUT.options)
PICK, RECEIVING = LAYOUT.site.pick, LAYOUT.site.receiving
SMA, SECOND, TEE, OTHER = (
    "part_sma_f_n_m_0",
    "part_sma_f_n_m_1",
    "part_n_tee_fff_0",
    "part_tnc_m_sma_f_0",
)
BELT = LAYOUT.site.line.height
STORE = (0.0, 0.0, -1.0)  # parts that are not in play
NOTHING = Grip(None, 0.0)


@dataclass
class Story:
    """A run told tick by tick; what is not said stays as it was."""

    monitor: PickMonitor = field(default_factory=lambda: PickMonitor(LAYOUT, CONFIG))
    now: float = 0.0
    pose: tuple = LAYOUT.site.dock
    speed: float = 0.0
    parts: dict = field(default_factory=lambda: dict.fromkeys((SMA, SECOND, TEE, OTHER), STORE))
    grips: tuple = (NOTHING, NOTHING)
    tcp: tuple = ((0.0, 0.0, 2.0), (0.0, 0.0, 2.0))  # in base
    moving: set = field(default_factory=set)

    def tick(self, *gripper: GripperCommand, seconds: float = 0.01) -> "Story":
        """Let time pass; parts are given in base coordinates."""
        self.now = round(self.now + seconds, 6)
        T = pose2_to_transform(np.array(self.pose))
        names, n = tuple(self.parts), len(self.parts)
        world = [T @ (*self.parts[p], 1.0) for p in names]
        truth = Truth(
            stamp=self.now,
            pose=np.array(self.pose),
            T_world_base=T,
            velocity=np.array([self.speed, 0.0, 0.0]),
            joint_position=np.zeros((2, 6)),
            T_world_tcp=np.array([T @ transform(np.eye(3), p) for p in self.tcp]),
            finger_width=np.full(2, 0.05),
            grips=self.grips,
            part_names=names,
            part_position=np.array(world)[:, :3],
            part_quat=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
            part_velocity=np.array([[0.1 * (p in self.moving), 0.0, 0.0] for p in names]),
        )
        state = StackState(
            self.now, np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3), task="made up"
        )
        self.monitor.observe(Tick(self.now, (), Commands(grippers=gripper), state, truth))
        return self

    def at_line(self) -> "Story":
        self.pose, self.speed = PICK, 0.0
        return self.tick()

    def pick(self, part: str, slot: int, arm: int = 0) -> "Story":
        """Close on a part on the belt, lift it, lay it into a slot."""
        self.parts[part] = (0.1, 0.45, BELT)
        self.close(arm)
        self.hold(part, (0.1, 0.45, BELT + 0.1), arm)
        self.parts[part] = tuple(CONFIG.tray.slots()[slot])
        return self.release(arm)

    def close(self, arm: int = 0) -> "Story":
        self.tick(GripperCommand(arm, 0.04, 20.0))
        return self.tick(GripperCommand(arm, 0.0, 20.0))

    def hold(self, part: str, position, arm: int = 0, force: float = 20.0) -> "Story":
        self.parts[part] = position
        self.grips = tuple(Grip(part, force) if i == arm else g for i, g in enumerate(self.grips))
        return self.tick()

    def release(self, arm: int = 0) -> "Story":
        self.grips = tuple(NOTHING if i == arm else g for i, g in enumerate(self.grips))
        self.tick(GripperCommand(arm, 0.04, 20.0))
        return self.tick(seconds=0.2)  # by now the fingers have let go for good

    def deliver(self, offset: float = 0.0, speed: float = 0.0) -> dict[str, float]:
        self.pose, self.speed = (RECEIVING[0] + offset, *RECEIVING[1:]), speed
        return self.tick().monitor.metrics()


def test_class_of_a_part_by_its_name():
    assert part_class("part_n_tee_m_mm_12") == "n_tee_m_mm"


def test_a_whole_order():
    """Expected: three parts over 10 s at the line, each picked at the first attempt."""
    story = Story().at_line()
    for part, slot in ((SMA, 0), (SECOND, 9), (TEE, 20)):
        story.pick(part, slot, arm=slot % 2)
    story.tick(seconds=10.0 - (story.now - story.monitor.stopped_at))
    metrics = story.deliver()
    assert metrics["ordered"] == metrics["delivered"] == metrics["attempts"] == 3
    assert metrics["pick_success"] == 1.0
    assert metrics["time_at_line_s"] == pytest.approx(10.01)
    assert metrics["pick_rate_per_hour"] == pytest.approx(3 * 3600 / 10.01)
    assert metrics["cycle_time_s"] == pytest.approx(10.01 / 3)
    assert metrics["dropped"] == metrics["missed"] == metrics["wrong_class"] == 0
    assert metrics["grip_force_max_n"] == 20.0
    assert metrics["placement_error_max_mm"] == pytest.approx(0.0, abs=1e-9)


def test_an_attempt_is_a_command_to_close():
    """Expected: opening, a narrower opening and a repeated command are none."""
    story = Story().at_line()
    for width in (0.05, 0.034, 0.0, 0.0, 0.05, 0.034, 0.0):
        story.tick(GripperCommand(0, width, 20.0))
    assert story.deliver()["attempts"] == 2
    assert story.monitor.metrics()["pick_success"] == 0.0


def test_each_hand_has_attempts_of_its_own():
    story = Story().at_line().close(0).close(1)
    assert story.deliver()["attempts"] == 2


def test_delivered_only_when_stopped_at_the_receiving_point():
    story = Story().at_line().pick(SMA, 0)
    assert story.deliver(offset=0.11)["delivered"] == 0
    assert story.deliver(offset=0.09, speed=0.02)["delivered"] == 0
    assert story.deliver(offset=0.09)["delivered"] == 1


def test_delivered_only_when_at_rest_in_a_slot():
    story = Story().at_line().pick(SMA, 0)
    story.moving = {SMA}
    assert story.deliver()["delivered"] == 0
    story.moving = set()
    story.parts[SMA] = (0.30, 0.0, CONFIG.tray.floor)  # on the deck beside the tray
    metrics = story.deliver()
    assert metrics["delivered"] == 0 and metrics["dropped"] == 1


def test_a_part_in_the_hand_is_neither_delivered_nor_dropped():
    story = Story().at_line().close()
    story.hold(SMA, (*CONFIG.tray.slots()[0][:2], CONFIG.tray.floor + 0.03))
    story.hold(SMA, (0.1, 0.45, BELT + 0.1))
    metrics = story.deliver()
    assert metrics["delivered"] == 0 and metrics["dropped"] == 0
    story.parts[SMA] = (0.6, 0.6, 0.0)
    story.release()
    assert story.deliver()["dropped"] == 1


def test_a_part_that_never_left_the_belt_is_no_drop():
    story = Story().at_line().close()
    story.hold(SMA, (0.1, 0.45, BELT + 0.01)).release()
    assert story.deliver()["dropped"] == 0


def test_what_was_not_ordered_is_wrong():
    """Expected: an unordered class, and one more of a class than ordered, are both wrong."""
    story = Story().at_line().pick(OTHER, 0).pick(TEE, 1)
    story.parts["part_n_tee_fff_1"] = STORE
    story.pick("part_n_tee_fff_1", 2)
    metrics = story.deliver()
    assert metrics["delivered"] == 1 and metrics["wrong_class"] == 2
    assert metrics["pick_success"] == pytest.approx(1 / 3)


def test_a_drop_counts_even_if_the_part_is_delivered_in_the_end():
    story = Story().at_line().close()
    story.hold(SMA, (0.1, 0.45, BELT + 0.1))
    story.parts[SMA] = (0.1, 0.45, BELT)
    story.release().pick(SMA, 0)
    metrics = story.deliver()
    assert metrics["delivered"] == 1 and metrics["dropped"] == 1 and metrics["attempts"] == 2


def test_a_moment_without_contact_is_no_drop():
    story = Story().at_line().close()
    story.hold(SMA, (0.1, 0.45, BELT + 0.1))
    story.grips = (NOTHING, NOTHING)
    story.tick(seconds=0.05)
    story.hold(SMA, (0.05, 0.3, BELT + 0.1))
    story.parts[SMA] = tuple(CONFIG.tray.slots()[0])
    assert story.release().deliver()["dropped"] == 0


def test_two_parts_in_one_slot_are_one_delivery():
    story = Story().at_line().pick(SMA, 0).pick(SECOND, 0)
    assert story.deliver()["delivered"] == 1


def ride(story: Story, part: str) -> Story:
    """A part rides past the end of the pick window."""
    for x in np.linspace(0.4, -0.8, 13):
        story.parts[part] = (x, 0.45, BELT)
        story.tick()
    return story


def test_a_wanted_part_that_leaves_the_window_is_missed():
    story = Story().at_line()
    assert ride(story, SMA).deliver()["missed"] == 1


def test_what_is_not_wanted_is_not_missed():
    """Expected: neither an unordered class nor one of which there is enough, in tray and hand."""
    story = Story().at_line()
    ride(story, OTHER)
    story.pick(TEE, 0)
    story.parts["part_n_tee_fff_1"] = STORE
    ride(story, "part_n_tee_fff_1")
    story.pick(SMA, 1).hold(SECOND, (0.1, 0.45, BELT + 0.1))
    story.parts["part_sma_f_n_m_2"] = STORE
    assert ride(story, "part_sma_f_n_m_2").deliver()["missed"] == 0


def test_nothing_is_missed_on_the_way():
    """Expected: parts that pass before the vehicle has stopped, or after it left, do not count."""
    story = Story()
    story.pose, story.speed = PICK, 0.1
    ride(story, SMA)
    story.at_line()
    story.pose = (PICK[0], PICK[1] + 0.2, PICK[2])
    assert ride(story, SECOND).deliver()["missed"] == 0


def test_time_at_the_line_runs_from_the_first_stop_to_leaving():
    story = Story(now=4.99)
    story.pose, story.speed = PICK, 0.02
    story.tick(seconds=1.0)  # in the zone, still rolling
    assert story.monitor.stopped_at is None
    story.at_line()
    story.speed = 0.05
    story.pose = (PICK[0], PICK[1] + 0.05, PICK[2])
    story.tick(seconds=2.0)  # a shuffle is not leaving
    story.pose = (PICK[0], PICK[1] + 0.15, PICK[2])
    story.tick(seconds=3.0)
    assert story.monitor.metrics()["time_at_line_s"] == pytest.approx(5.0)


def test_first_grip_is_counted_from_the_stop():
    story = Story().at_line()
    story.tick(seconds=1.5)
    story.hold(SMA, (0.1, 0.45, BELT)).release()
    assert story.deliver()["first_grip_delay_s"] == pytest.approx(1.51)


def test_errors_of_intercept_and_time_are_taken_when_closing_begins():
    """Expected: 3 mm along the belt at 0.1 m/s are 30 ms; 4 mm across add to the distance only."""
    story = Story().at_line()
    drawing = CONFIG.parts["n_tee_fff"]  # grasped at its origin
    assert (drawing.grasp_x, drawing.grasp_y) == (0.0, 0.0)
    story.parts[TEE] = (0.1, 0.45, BELT)
    story.tcp = ((0.103, 0.454, BELT), (0.0, 0.0, 2.0))
    metrics = story.close().deliver()
    assert metrics["intercept_error_p95_mm"] == pytest.approx(5.0)
    assert metrics["close_time_error_p95_ms"] == pytest.approx(30.0)


def test_what_was_not_measured_is_not_a_number():
    assert PickMonitor(LAYOUT, CONFIG).metrics() == {}
    metrics = Story().tick().monitor.metrics()
    unknown = ("time_at_line_s", "pick_rate_per_hour", "cycle_time_s", "pick_success")
    assert all(np.isnan(metrics[name]) for name in (*unknown, "first_grip_delay_s"))
    assert metrics["delivered"] == metrics["attempts"] == 0


def test_counts_only_grow():
    story = Story().at_line()
    seen = [story.monitor.counts()]
    for part, slot in ((SMA, 0), (TEE, 1)):
        seen.append(story.pick(part, slot).monitor.counts())
    assert all(a[k] <= b[k] for a, b in pairwise(seen) for k in a)
    assert seen[-1] == {"attempts": 2.0, "lifted": 2.0, "missed": 0.0}

"""Tracker: belt velocity, prediction, class votes, coasting, a moving vehicle."""

import numpy as np
import pytest

from twin.geometry import between2, wrap_angle
from twin.layout import load_layout
from twin.messages import PART_CLASSES, Detection
from twin.stack.config import nominal_config
from twin.stack.detection.tracker import Tracker

layout = load_layout()
config = nominal_config(layout.site, layout.options)
LINE = layout.site.line
SPEED = 0.15
VELOCITY = SPEED * np.array([np.cos(LINE.direction), np.sin(LINE.direction)])
PICK = np.array(layout.site.pick)


class Belt:
    """Parts at rest on an ideal belt, and the noisy detections of a window."""

    def __init__(self, seed: int, velocity=VELOCITY, spacing: float = 0.16):
        self.rng = np.random.default_rng(seed)
        self.velocity = np.asarray(velocity)
        along = np.array([np.cos(LINE.direction), np.sin(LINE.direction)])
        across = np.array([-along[1], along[0]])
        start = np.array(LINE.origin) + 0.6 * along
        self.start = np.array(
            [
                start - k * spacing * along + self.rng.uniform(-0.04, 0.04) * across
                for k in range(20)
            ]
        )
        self.yaw = self.rng.uniform(-np.pi, np.pi, 20)
        self.kind = self.rng.integers(0, 5, 20)

    def position(self, k: int, t: float):
        return self.start[k] + self.velocity * t

    def detect(self, t, pose, noise=3e-4, wrong=0.05, flip=0.0, miss=0.0):
        found = []
        for k in range(len(self.start)):
            x, y, yaw = between2(pose, (*self.position(k, t), self.yaw[k]))
            if not (0.35 < x < 0.78 and 0.3 < y < 0.6) or self.rng.random() < miss:
                continue
            kind = self.kind[k] if self.rng.random() > wrong else self.rng.integers(0, 5)
            yaw += self.rng.normal(0, 0.02) + np.pi * (self.rng.random() < flip)
            dx, dy = self.rng.normal(0, noise, 2)
            p_base = np.array([x + dx, y + dy, LINE.height])
            found.append(
                Detection(
                    PART_CLASSES[kind], 0.9, p_base, yaw, np.zeros((0, 2)), np.zeros(2), False
                )
            )
        return tuple(found)


def follow(belt: Belt, duration: float, pose_at=lambda t: PICK, tracker=None, **noise) -> Tracker:
    tracker = tracker or Tracker(config)
    for i in range(int(duration / 0.05)):
        t = 0.05 * i
        tracker.update(t, belt.detect(t, pose_at(t), **noise), pose_at(t))
    return tracker


def match(belt: Belt, part, t: float) -> tuple[int, float]:
    distance = [np.hypot(*(part.p_odom[:2] - belt.position(k, t))) for k in range(len(belt.start))]
    k = int(np.argmin(distance))
    return k, float(distance[k])


@pytest.mark.parametrize("speed", [0.0, 0.05, 0.15, 0.5])
def test_belt_velocity(speed):
    velocity = VELOCITY / SPEED * speed
    tracker = follow(Belt(0, velocity, spacing=0.2), 4.0)
    assert tracker.belt_velocity is not None
    np.testing.assert_allclose(tracker.belt_velocity, velocity, atol=5e-4)


def test_predicts_place_yaw_and_class_ahead():
    belt = Belt(1)
    tracker = follow(belt, 6.0)
    parts = tracker.predict(7.0)
    assert len(parts) >= 4
    for part in parts:
        k, distance = match(belt, part, 7.0)
        assert distance < 1e-3
        assert part.part_class == PART_CLASSES[belt.kind[k]]
        assert abs(wrap_angle(part.yaw - belt.yaw[k])) < np.radians(2)
        assert part.p_odom[2] == LINE.height


def test_one_track_a_part_with_missed_frames_and_wrong_classes():
    belt = Belt(2)
    tracker = follow(belt, 6.0, wrong=0.25, miss=0.3)
    parts = tracker.predict(6.0)
    found = [match(belt, part, 6.0)[0] for part in parts]
    assert len(found) == len(set(found))
    sure = [p for p in parts if p.hits >= 15]
    right = [p.part_class == PART_CLASSES[belt.kind[match(belt, p, 6.0)[0]]] for p in sure]
    assert np.mean(right) == 1.0


def test_turned_frames_do_not_turn_the_track():
    belt = Belt(3)
    for part in follow(belt, 6.0, flip=0.2).predict(6.0):
        k, _ = match(belt, part, 6.0)
        if part.hits >= 10:
            assert abs(wrap_angle(part.yaw - belt.yaw[k])) < np.radians(3)


def test_track_coasts_out_of_sight_and_ends_with_the_belt():
    belt = Belt(4)
    tracker = follow(belt, 6.0)
    for i in range(60):  # nothing is seen any more
        tracker.update(6.0 + 0.05 * i, (), np.array(layout.site.dock))
    t = 9.0
    parts = tracker.predict(t)
    assert parts
    for part in parts:
        assert match(belt, part, t)[1] < 3e-3
    tracker.update(60.0, (), np.array(layout.site.dock))
    assert tracker.predict(60.0) == ()


def test_part_that_vanished_in_full_view_is_dropped():
    belt = Belt(5, velocity=(0.0, 0.0))
    tracker = follow(belt, 2.0)
    assert tracker.predict(2.0)
    for i in range(30):
        tracker.update(2.0 + 0.05 * i, (), PICK)
    inside = [0.40 < between2(PICK, (*p.p_odom[:2], 0))[0] < 0.73 for p in tracker.predict(3.5)]
    assert not any(inside)


def test_moving_vehicle():
    """The vehicle rolls up along the belt at 0.3 m/s; tracks stay put in odom."""
    belt = Belt(6)

    def pose_at(t):
        return PICK + np.array([0.0, -0.5 + 0.3 * min(t, 1.5), 0.02 * np.sin(t)])

    tracker = follow(belt, 5.0, pose_at)
    assert tracker.belt_velocity is not None
    np.testing.assert_allclose(tracker.belt_velocity, VELOCITY, atol=1e-3)
    for part in tracker.predict(5.5):
        assert match(belt, part, 5.5)[1] < 2e-3


def test_follows_a_change_of_the_belt_speed():
    belt = Belt(8, spacing=0.2)
    tracker = follow(belt, 4.0)
    belt.start = belt.start + belt.velocity * 4.0
    belt.velocity = 2 * VELOCITY
    for i in range(80):
        t = 0.05 * i
        tracker.update(4.0 + t, belt.detect(t, PICK), PICK)
    assert tracker.belt_velocity is not None
    np.testing.assert_allclose(tracker.belt_velocity, 2 * VELOCITY, atol=2e-3)
    in_view = [
        p for p in tracker.predict(8.0) if 0.36 < between2(PICK, (*p.p_odom[:2], 0))[0] < 0.7
    ]
    assert in_view and all(match(belt, p, 4.0)[1] < 2e-3 for p in in_view)


def test_drop_forgets():
    tracker = follow(Belt(7), 4.0)
    first = tracker.predict(4.0)[0].track_id
    tracker.drop(first)
    assert first not in [p.track_id for p in tracker.predict(4.0)]

"""Figures of localisation and kidnapping on runs made by hand."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from evaluation.kidnaps import KidnapMonitor
from evaluation.localisation import LocalisationMonitor
from twin.layout import load_layout
from twin.messages import TagSight

SITE = load_layout().site


@dataclass
class Truth:
    pose: np.ndarray
    velocity: np.ndarray


@dataclass
class State:
    pose: np.ndarray
    lost: bool = False
    particles: int = 500
    sights: tuple = ()


@dataclass
class FakeTick:
    stamp: float
    truth: Truth
    state: State
    rest: dict = field(default_factory=dict)


def tick(stamp, pose, off=(0.0, 0.0, 0.0), speed=0.5, **state):
    pose = np.array(pose, dtype=float)
    truth = Truth(pose, np.array([speed, 0.0, 0.0]))
    return FakeTick(stamp, truth, State(pose + np.array(off), **state))


def test_aisles_count_while_moving_alone():
    monitor = LocalisationMonitor(SITE)
    monitor.observe(tick(0.0, (2.0, 1.0, 0.0), (0.5, 0.0, 0.0)))  # in the cell
    monitor.observe(tick(0.1, (9.0, 1.55, 0.0), (0.03, 0.04, 0.0)))  # in an aisle
    monitor.observe(tick(0.2, (9.0, 1.55, 0.0), (0.3, 0.0, 0.0), speed=0.0))  # standing there
    found = monitor.metrics()
    assert found["ape_aisle_rmse_m"] == pytest.approx(0.05)
    assert found["ape_rmse_m"] == pytest.approx(np.sqrt((0.25 + 0.0025 + 0.09) / 3))


def test_error_at_a_tag_is_taken_at_its_exposure():
    monitor = LocalisationMonitor(SITE)
    sight = TagSight(0.05, "P1", "fused", np.array([9.304, 1.553, 0.0]))
    refused = TagSight(0.05, "P1", "refused", np.zeros(3))
    monitor.observe(tick(0.0, (9.2, 1.55, 0.0)))
    monitor.observe(tick(0.1, (9.4, 1.55, 0.0), (0.02, 0.0, 0.0), sights=(sight, refused)))
    np.testing.assert_allclose(monitor.at_sights(), [0.005], atol=1e-12)
    assert monitor.metrics()["qr_pose_error_p95_mm"] == pytest.approx(5.0)
    assert monitor.refused == 1
    assert len(monitor.over_tags()) == 0  # no tick came within reach of the tag
    monitor.observe(tick(0.2, (9.31, 1.55, 0.0), (0.0, 0.007, 0.0)))
    np.testing.assert_allclose(monitor.over_tags(), [0.007], atol=1e-12)


def test_particle_ratio_is_of_a_lost_start():
    monitor = LocalisationMonitor(SITE)
    assert np.isnan(monitor.particle_ratio())
    for k in range(100):
        monitor.observe(tick(0.1 * k, (9, 1.55, 0), lost=k < 5, particles=9000 if k < 2 else 600))
    assert monitor.particle_ratio() == pytest.approx(15.0)


def follow(monitor, start, seconds, off=(0, 0, 0), lost=False):
    for k in range(round(seconds / 0.1)):
        monitor.observe(tick(start + 0.1 * k, (5.0, 0.0, 0.0), off, lost=lost))


def test_found_when_it_is_near_and_says_so():
    monitor = KidnapMonitor()
    follow(monitor, 0.0, 1.0)
    monitor.kidnapped(1.0, (5.0, 0.0, 0.0), alike=True)
    follow(monitor, 1.0, 2.0, off=(4.0, 0.0, 0.0))  # not aware of it
    follow(monitor, 3.0, 3.0, off=(0.1, 0.0, 0.0), lost=True)  # right, and not sure
    follow(monitor, 6.0, 2.0, off=(0.1, 0.0, 0.0))
    found = monitor.metrics()
    assert found["relocalised"] == 1.0 and found["relocalise_median_s"] == pytest.approx(5.0)
    assert found["wrong_places"] == 0 and found["false_alarms"] == 0


@pytest.mark.parametrize("off", [(0.31, 0, 0), (0, 0, 0.27)])
def test_near_is_not_near_enough(off):
    monitor = KidnapMonitor()
    monitor.kidnapped(0.0, (5.0, 0.0, 0.0), alike=False)
    follow(monitor, 0.0, 10.0, off=off)
    assert monitor.metrics()["relocalised"] == 0.0


def test_sure_of_a_wrong_place():
    monitor = KidnapMonitor()
    monitor.kidnapped(0.0, (5.0, 0.0, 0.0), alike=True)
    follow(monitor, 0.0, 4.0, off=(0.0, 2.1, 0.0))
    assert monitor.metrics()["wrong_places"] == 0
    follow(monitor, 4.0, 2.0, off=(0.0, 2.1, 0.0))
    assert monitor.metrics()["wrong_places"] == 1


def test_too_late_is_not_found_in_time():
    monitor = KidnapMonitor()
    monitor.kidnapped(0.0, (5.0, 0.0, 0.0), alike=False)
    follow(monitor, 0.0, 61.0, lost=True)
    follow(monitor, 61.0, 2.0)
    found = monitor.metrics()
    assert found["relocalised"] == 0.0 and found["relocalise_max_s"] == pytest.approx(61.0)


def test_lost_without_reason_is_counted():
    monitor = KidnapMonitor()
    follow(monitor, 0.0, 1.0, lost=True)  # switched on without knowing: no alarm
    follow(monitor, 1.0, 1.0)
    follow(monitor, 2.0, 1.0, lost=True)
    assert monitor.metrics()["false_alarms"] == 1

"""What floor tags may do to the pose: fuse, reset, and nothing when they lie."""

from dataclasses import replace

import numpy as np
import pytest
from localisation_world import MOUNT, drive, free_cells, odometry_of, scan_at, world_field

from twin.geometry import between2, compose2
from twin.stack.detection.qr import TagFix
from twin.stack.estimation.amcl import Amcl
from twin.stack.estimation.qr_fusion import QrFusion, TagPolicy
from twin.tag_text import TagText

TAGS = {"A1": (3.0, 1.0, 0.0), "B2": (6.0, 1.0, np.pi / 2)}
SIGHT = np.diag([0.004, 0.004, 0.006]) ** 2
ESTIMATE = np.diag([0.02, 0.01, 0.01]) ** 2


def fix_of(vehicle, tag="A1", stamp=1.0, placed=None, **changes):
    """What the camera sees of a tag that lies at `placed` (by default where it was surveyed)."""
    placed = TAGS[tag] if placed is None else placed
    text = TagText(tag, TAGS[tag])
    return replace(
        TagFix(stamp, text, between2(vehicle, placed), np.zeros((3, 2)), SIGHT), **changes
    )


def test_below_tau_it_is_fused_by_hand():
    vehicle = np.array([3.2, 1.0, 0.0])
    pose = vehicle + np.array([0.02, 0.01, 0.0])
    found = QrFusion(TAGS).update(fix_of(vehicle), pose, ESTIMATE)
    assert found.action == "fused"
    # Scalar Kalman filters: the axes do not mix.
    kx, ky = 4e-4 / (4e-4 + 1.6e-5), 1e-4 / (1e-4 + 1.6e-5)
    np.testing.assert_allclose(found.pose, pose - (0.02 * kx, 0.01 * ky, 0.0), atol=1e-12)
    np.testing.assert_allclose(np.diag(found.covariance)[:2], [1.6e-5 * kx, 1.6e-5 * ky])


@pytest.mark.parametrize("off", [(0.5, 0, 0), (0, -0.11, 0), (0, 0, 0.2), (8, 3, 3.0)])
def test_beyond_tau_it_replaces(off):
    vehicle = np.array([3.1, 1.1, 0.4])
    found = QrFusion(TAGS).update(fix_of(vehicle), vehicle + off, ESTIMATE)
    assert found.action == "reset"
    np.testing.assert_allclose(found.pose, vehicle, atol=1e-12)
    assert np.trace(found.covariance) == pytest.approx(np.trace(SIGHT))


def test_covariance_is_turned_to_world():
    vehicle = np.array([6.0, 1.0, np.pi / 2])
    sight = np.diag([0.001, 0.01, 0.001]) ** 2
    found = QrFusion(TAGS).update(fix_of(vehicle, "B2", covariance=sight), vehicle + 1, ESTIMATE)
    np.testing.assert_allclose(np.diag(found.covariance), np.diag(sight)[[1, 0, 2]], atol=1e-12)


REFUSED = {
    "not in the survey": {"text": TagText("Z9", (3.0, 1.0, 0.0))},
    "survey otherwise": {"text": TagText("A1", (3.1, 1.0, 0.0))},
    "the survey": {"text": TagText("A1", (3.0, 1.0, 0.1))},
    "not finite": {"pose_base_tag": np.array([np.nan, 0, 0])},
    "is not finite": {"stamp": np.inf},
}


@pytest.mark.parametrize("why", REFUSED)
def test_wrong_tags_do_no_harm(why):
    vehicle = np.array([3.2, 1.0, 0.0])
    fusion = QrFusion(TAGS)
    found = fusion.update(fix_of(vehicle, **REFUSED[why]), vehicle + 1, ESTIMATE)
    assert found.action == "refused" and why in found.reason and "\n" not in found.reason
    np.testing.assert_array_equal(found.pose, vehicle + 1)
    np.testing.assert_array_equal(found.covariance, ESTIMATE)
    # The next good one counts in full.
    assert fusion.update(fix_of(vehicle, stamp=0.5), vehicle + 1, ESTIMATE).action == "reset"


def test_late_and_duplicated_fixes_are_refused():
    vehicle = np.array([3.2, 1.0, 0.0])
    fusion = QrFusion(TAGS)
    fusion.update(fix_of(vehicle, stamp=2.0), vehicle, ESTIMATE)
    for stamp in (2.0, 1.9):
        found = fusion.update(fix_of(vehicle, stamp=stamp), vehicle, ESTIMATE)
        assert found.action == "refused" and "not newer" in found.reason


def test_many_sights_of_one_tag_are_not_many_tags():
    vehicle, fusion = np.array([3.2, 1.0, 0.0]), QrFusion(TAGS)
    pose, covariance = vehicle, ESTIMATE
    for i in range(100):
        found = fusion.update(fix_of(vehicle, stamp=1 + 0.05 * i), pose, covariance)
        pose, covariance = found.pose, found.covariance
    # Sum of 1 / k^2 is 1.64: together they are worth that many sights.
    assert covariance[0, 0] > SIGHT[0, 0] / 1.7
    later = fusion.update(fix_of(vehicle, stamp=60.0), pose, covariance)
    assert later.covariance[0, 0] < 0.7 * covariance[0, 0]  # a new pass


class TestWithScan:
    """The lidar's last scan as judge, in the small warehouse."""

    def setup_method(self):
        rng = np.random.default_rng(0)
        self.poses = drive()[:25]
        self.amcl = Amcl(world_field(), free_cells(), MOUNT, 30.0, rng)
        self.amcl.initialise(self.poses[0], np.diag([0.1, 0.1, 0.05]) ** 2)
        self.odometry = odometry_of(self.poses, rng)
        for i, (pose, reckoned) in enumerate(zip(self.poses, self.odometry, strict=True)):
            self.amcl.update(scan_at(pose, rng, 0.1 * (i + 1)), reckoned)

    def judge(self, fix, pose=None):
        amcl, now = self.amcl, self.odometry[-1]
        pose = amcl.pose if pose is None else pose
        fit = lambda p: amcl.fit(p, now)  # noqa: E731
        return QrFusion(TAGS).update(fix, pose, amcl.covariance, fit)

    @pytest.mark.parametrize("off", [(0.3, 0.0), (0.0, 0.15), (0.06, -0.05)])
    def test_a_misplaced_tag_is_refused(self, off):
        placed = np.array(TAGS["A1"]) + np.array([*off, 0.0])
        found = self.judge(fix_of(self.poses[-1], placed=placed))
        assert found.action == "refused" and "scan does not fit" in found.reason
        assert np.hypot(*between2(self.poses[-1], found.pose)[:2]) < 0.02

    def test_a_lost_estimate_is_replaced(self):
        found = self.judge(fix_of(self.poses[-1]), self.poses[-1] + (0.4, 0.2, 0.1))
        assert found.action == "reset"
        self.amcl.initialise(found.pose, found.covariance, self.odometry[-1], stamp=2.5)
        np.testing.assert_allclose(self.amcl.pose, self.poses[-1], atol=1e-9)
        assert self.amcl.update(scan_at(self.poses[-1], None, 2.4), self.odometry[-1]) is not None

    def test_the_scan_is_carried_to_the_exposure(self):
        step = np.array([0.2, 0.1, 0.3])
        later, reckoned = compose2(self.poses[-1], step), compose2(self.odometry[-1], step)
        here, there = self.amcl.fit(self.poses[-1]), self.amcl.fit(later, reckoned)
        assert here is not None and there == pytest.approx(here, rel=1e-3)

    def test_a_good_tag_is_fused(self):
        assert self.judge(fix_of(self.poses[-1])).action == "fused"


def test_before_any_scan_the_source_holds():
    amcl = Amcl(world_field(), free_cells(), MOUNT, 30.0, np.random.default_rng(0))
    vehicle = np.array([3.2, 1.0, 0.0])
    found = QrFusion(TAGS, TagPolicy()).update(fix_of(vehicle), vehicle + 1, ESTIMATE, amcl.fit)
    assert found.action == "reset"


def test_further_sights_hold_the_vehicle_against_drift():
    """Expected: a misplaced tag tells nothing new when seen again, but drift while over it goes.

    The tag lies 3 mm off. The belief after its first sight keeps what is left of that error while
    vehicle and belief drift apart by 1 mm a sight, and it is never surer than it was then.
    """
    placed, fusion = compose2(TAGS["A1"], (0.003, 0.0, 0.0)), QrFusion(TAGS)
    vehicle = np.array([3.05, 1.02, 0.1])
    growth = np.diag([0.003, 0.003, 0.002]) ** 2
    first = fusion.update(
        fix_of(vehicle, placed=placed), vehicle + np.array([0.01, 0, 0]), ESTIMATE
    )
    error, pose, covariance = first.pose - vehicle, first.pose, first.covariance
    for k in range(1, 30):
        vehicle = compose2(vehicle, (0.001, -0.0005, 0.02))
        pose = compose2(pose, (0.002, -0.0005, 0.02))  # reckoned
        sight = fix_of(vehicle, placed=placed, stamp=1.0 + 0.05 * k)
        found = fusion.update(sight, pose, covariance + growth)
        assert found.action == "fused"
        np.testing.assert_allclose(found.pose - vehicle, error, atol=2e-4)
        np.testing.assert_allclose(found.covariance, first.covariance)
        pose, covariance = found.pose, found.covariance


def test_a_further_sight_leaves_alone_what_is_known_better():
    vehicle, fusion = np.array([3.05, 1.02, 0.1]), QrFusion(TAGS)
    fusion.update(fix_of(vehicle), vehicle, ESTIMATE)
    pose, better = vehicle + np.array([0.001, 0, 0]), 0.01 * SIGHT
    found = fusion.update(fix_of(vehicle, stamp=1.05), pose, better)
    np.testing.assert_array_equal(found.pose, pose)
    np.testing.assert_array_equal(found.covariance, better)

"""Localisation on synthetic drives: tracking, global start, kidnapping, bad readings."""

from dataclasses import replace

import numpy as np
import pytest
from localisation_world import LOOP, MOUNT, drive, free_cells, odometry_of, scan_at, world_field

from twin.geometry import between2, compose2
from twin.messages import LidarScan
from twin.stack.estimation.amcl import Amcl, AmclSettings
from twin.stack.estimation.clusters import heaviest, mean_and_covariance
from twin.stack.estimation.kld import count_bins
from twin.stack.estimation.motion_models import turn_path_turn

FIELD, FREE = world_field(), free_cells()
START = np.diag([0.3, 0.3, 0.1]) ** 2


def make(seed=0, settings=None):
    return Amcl(FIELD, FREE, MOUNT, 30.0, np.random.default_rng(seed), settings)


def follow(amcl, poses, seed=0, every=1, visible=lambda p: p):
    """Errors (m, rad) and particle counts along a drive."""
    rng = np.random.default_rng(100 + seed)
    odometry = odometry_of(poses, rng)
    first = np.zeros(3) if amcl._odometry is None else amcl._odometry
    errors, counts = [], []
    for pose, reckoned in list(zip(poses, odometry, strict=True))[::every]:
        stamp = max(amcl.stamp, 0.0) + 0.1
        assert amcl.update(scan_at(visible(pose), rng, stamp), compose2(first, reckoned)) is None
        off = between2(pose, amcl.pose)
        errors.append((np.hypot(off[0], off[1]), abs(off[2])))
        counts.append(len(amcl.particles))
    return np.array(errors), np.array(counts)


@pytest.mark.parametrize("motion", [None, turn_path_turn])
def test_tracks_a_drive_and_needs_fewer_particles(motion):
    settings = AmclSettings() if motion is None else replace(AmclSettings(), motion=motion)
    poses = drive()
    amcl = make(settings=settings)
    amcl.initialise(poses[0] + (0.2, -0.1, 0.05), START)
    start = len(amcl.particles)
    errors, counts = follow(amcl, poses)
    settled = errors[30:]
    assert np.sqrt(np.mean(settled[:, 0] ** 2)) < 0.015
    assert np.max(settled[:, 0]) < 0.04 and np.max(settled[:, 1]) < np.radians(1.5)
    assert start / np.median(counts[30:]) >= 5


def test_covariance_covers_the_error():
    poses = drive()
    amcl = make(3)
    amcl.initialise(poses[0], START)
    inside = []
    rng = np.random.default_rng(3)
    for i, (pose, reckoned) in enumerate(zip(poses, odometry_of(poses, rng), strict=True)):
        amcl.update(scan_at(pose, rng, 0.1 * (i + 1)), reckoned)
        off = amcl.pose - pose
        off[2] = (off[2] + np.pi) % (2 * np.pi) - np.pi
        inside.append(off @ np.linalg.solve(amcl.covariance, off) < 11.34)  # 99 %
    assert np.mean(inside[10:]) > 0.95


@pytest.mark.parametrize("seed", range(4))
def test_finds_itself_without_a_start(seed):
    amcl = make(seed)
    assert len(amcl.particles) == 10_000
    errors, counts = follow(amcl, drive()[20 * seed : 20 * seed + 40], seed)
    assert errors[-1, 0] < 0.05 and errors[-1, 1] < np.radians(2.0)
    assert counts[-1] <= 2000


@pytest.mark.parametrize("seed", range(6))
def test_kidnapped_and_recovered(seed):
    amcl = make(seed)
    here = drive()[:30]
    amcl.initialise(here[0], START)
    errors, _ = follow(amcl, here, seed)
    assert errors[-1, 0] < 0.05
    there = drive(LOOP[::-1], start=seed)[40 + 45 * seed :][:40]
    errors, _ = follow(amcl, there, seed + 50)
    assert errors[0, 0] > 1.0 or seed  # it was carried away
    assert np.all(errors[20:, 0] < 0.3) and np.all(errors[20:, 1] < np.radians(15))
    assert not amcl.lost


def test_kidnapped_while_standing():
    """Carried at rest: no odometry moves, yet scans that no longer fit are taken."""
    rng = np.random.default_rng(0)
    amcl = make()
    poses = drive()
    amcl.initialise(poses[0], START)
    for i in range(3):
        amcl.update(scan_at(poses[0], rng, 0.1 * (i + 1)), np.zeros(3))
    for i in range(15):
        amcl.update(scan_at(poses[150], rng, 1.0 + 0.1 * i), np.zeros(3))
    assert np.hypot(*between2(poses[150], amcl.pose)[:2]) < 0.1


def test_without_recovery_it_stays_lost():
    """The recovery is what brings it back: with none allowed the same carry is not survived."""
    amcl = make(0, replace(AmclSettings(), most_recovery=0.0))
    here = drive()[:30]
    amcl.initialise(here[0], START)
    follow(amcl, here)
    errors, _ = follow(amcl, drive(LOOP[::-1])[40:80], 50)
    assert errors[-1, 0] > 1.0 and amcl._recovery() == 0


def test_at_rest_nothing_is_learnt_twice():
    rng = np.random.default_rng(0)
    amcl, pose = make(), drive()[0]
    amcl.initialise(pose, np.diag([0.02, 0.02, 0.01]) ** 2)
    amcl.update(scan_at(pose, rng, 0.1), np.zeros(3))
    particles, weights = amcl.particles, amcl.weights
    for i in range(20):
        assert amcl.update(scan_at(pose, rng, 0.2 + 0.1 * i), np.zeros(3)) is None
    assert amcl.particles is particles and amcl.weights is weights


def good_scan(stamp=5.0):
    return scan_at(drive()[0], None, stamp)


BAD = {
    "empty": (LidarScan(5.0, 0.0, 0.1, np.zeros(0), 30.0), np.zeros(3)),
    "all NaN": (LidarScan(5.0, 0.0, 0.1, np.full(9, np.nan), 30.0), np.zeros(3)),
    "no return": (LidarScan(5.0, 0.0, 0.1, np.full(9, np.inf), 30.0), np.zeros(3)),
    "NaN stamp": (replace(good_scan(), stamp=np.nan), np.zeros(3)),
    "late": (good_scan(0.5), np.zeros(3)),
    "duplicated": (good_scan(1.0), np.zeros(3)),
    "NaN odometry": (good_scan(), np.array([0.0, np.nan, 0.0])),
    "short odometry": (good_scan(), np.zeros(2)),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_readings_leave_the_state(kind):
    rng = np.random.default_rng(0)
    amcl, pose = make(), drive()[0]
    amcl.initialise(pose, START)
    amcl.update(scan_at(pose, rng, 1.0), np.zeros(3))
    before = (amcl.particles.copy(), amcl.weights.copy(), amcl.pose, amcl.covariance, amcl.stamp)
    state = amcl._rng.bit_generator.state
    said = amcl.update(*BAD[kind])
    assert said is not None and "dropped" in said and "\n" not in said
    after = (amcl.particles, amcl.weights, amcl.pose, amcl.covariance, amcl.stamp)
    for a, b in zip(before, after, strict=True):
        np.testing.assert_array_equal(a, b)
    assert amcl._rng.bit_generator.state == state and amcl.dropped == 1


def test_map_and_mask_must_match():
    with pytest.raises(ValueError, match="free cells"):
        Amcl(FIELD, FREE[:-1], MOUNT, 30.0, np.random.default_rng(0))
    with pytest.raises(ValueError, match="free cells"):
        Amcl(FIELD, np.zeros_like(FREE), MOUNT, 30.0, np.random.default_rng(0))


def test_start_that_is_not_finite_is_refused():
    amcl = make()
    before = amcl.particles
    with pytest.raises(ValueError, match="refused"):
        amcl.initialise(np.array([0, np.nan, 0]), START)
    assert amcl.particles is before


def test_same_seed_same_bits():
    ends = []
    for _ in range(2):
        amcl = make(7)
        follow(amcl, drive()[:25], 7)
        ends.append((amcl.particles, amcl.weights, amcl.pose))
    for a, b in zip(*ends, strict=True):
        np.testing.assert_array_equal(a, b)


def test_pose_between_scans_follows_the_odometry():
    amcl, pose = make(), drive()[0]
    amcl.initialise(pose, START, odometry=np.array([5.0, 5.0, 1.0]))
    moved = compose2((5.0, 5.0, 1.0), (0.3, 0.1, 0.2))
    np.testing.assert_allclose(amcl.pose_at(moved), compose2(pose, (0.3, 0.1, 0.2)))


def test_heaviest_of_two_clusters():
    rng = np.random.default_rng(0)
    a = rng.normal((1, 1, np.pi), (0.05, 0.05, 0.05), (300, 3))  # across the seam of the yaw
    b = rng.normal((4, 1, 0), (0.05, 0.05, 0.02), (600, 3))
    poses = np.concatenate([a, b])
    poses[:, 2] = (poses[:, 2] + np.pi) % (2 * np.pi) - np.pi
    weights = np.concatenate([np.full(300, 2.0), np.full(600, 0.5)])
    inside = heaviest(poses, weights)
    assert inside[:300].all() and not inside[300:].any()
    mean, covariance = mean_and_covariance(poses[inside], weights[inside])
    assert abs(abs(mean[2]) - np.pi) < 0.02 and np.hypot(*(mean[:2] - 1)) < 0.02
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), 0.05, rtol=0.15)


def test_recovery_takes_as_many_particles_as_its_places_ask_for():
    """A scan of few beams fits in many places, and their bins ask for a larger cloud."""
    amcl = make(1)
    amcl.initialise(drive()[0], 1e-4 * START)
    assert len(amcl.particles) == amcl.settings.kld.least
    scan = scan_at(drive()[40], np.random.default_rng(0), 1.0)
    few = np.where(np.arange(len(scan.ranges)) % 120 == 0, scan.ranges, np.nan)
    points, silent = amcl.likelihood.choose(replace(scan, ranges=few), MOUNT)
    cloud = amcl._mixed(500, 0.7, points, silent)
    kld = amcl.settings.kld
    assert len(cloud) > 1000 and kld.count(count_bins(cloud, kld.bin_size)) <= len(cloud)
    all_beams = amcl._mixed(500, 0.7, *amcl.likelihood.choose(scan, MOUNT))
    assert len(all_beams) < len(cloud)

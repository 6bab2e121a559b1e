"""Localiser on scans and tags of the drawn site: tracking, carried off, switched on anywhere."""

from dataclasses import replace

import numpy as np
import pytest
from flat_world import cast

from twin.geometry import between2, compose2
from twin.layout import load_layout
from twin.messages import ImuReading, LidarScan, WheelState
from twin.stack.config import StackConfig
from twin.stack.detection.qr import TagFix
from twin.stack.estimation.amcl import AmclSettings
from twin.stack.estimation.kld import Kld
from twin.stack.estimation.localiser import CONFIRM, LOST_AFTER, Localiser
from twin.stack.estimation.map_file import save_map
from twin.stack.estimation.occupancy_grid import OccupancyGrid
from twin.stack.estimation.site_map import lidar_map
from twin.tag_text import TagText

LAYOUT = load_layout()
CONFIG = StackConfig(site=LAYOUT.site, options=LAYOUT.options)
SURFACES = lidar_map(LAYOUT.site, CONFIG.T_base_lidar).surfaces.reshape(-1, 2, 2)
LIDAR = (CONFIG.T_base_lidar[0, 3], 0.0, 0.0)
TICK, LATENCY = 0.01, 0.03
ANGLES = np.radians(np.arange(-135.0, 135.5, 1.0))  # every fourth beam of the lidar
STEP = (
    CONFIG.wheels.radius * 2 * np.pi / (CONFIG.wheels.gear_ratio * CONFIG.wheels.counts_per_turn)
)  # m a count, driving straight


class Rig:
    """A vehicle that drives straight ahead and tells what its sensors would."""

    def __init__(self, start=LAYOUT.site.dock, seed=0, config=CONFIG, localiser=None):
        self.rng = np.random.default_rng(seed)
        self.truth, self.now, self.way = np.array(start, dtype=float), 0.0, 0.0
        self.speed = 0.0
        self.localiser = localiser or Localiser(config, LAYOUT.site.dock)
        self.trail: list[tuple[float, np.ndarray]] = []

    def scan(self, stamp=None):
        stamp = self.now - LATENCY if stamp is None else stamp
        past = [pose for t, pose in self.trail if t <= stamp + 1e-9]
        x, y, yaw = compose2(past[-1] if past else self.truth, LIDAR)
        ranges = cast(SURFACES, (x, y, yaw), ANGLES) + self.rng.normal(0, 0.01, len(ANGLES))
        return LidarScan(stamp, ANGLES[0], ANGLES[1] - ANGLES[0], ranges, 30.0)

    def run(self, seconds, speed=0.0, with_scans=True):
        """Drive; the speed is reached at 0.8 m/s^2. Distances of the believed pose, one a tick."""
        off, events = [], []
        for _ in range(round(seconds / TICK)):
            self.now += TICK
            change = float(np.clip(speed - self.speed, -0.8 * TICK, 0.8 * TICK))
            step = (self.speed + 0.5 * change) * TICK
            self.speed += change
            self.way += step
            self.truth = compose2(self.truth, (step, 0.0, 0.0))
            self.trail.append((self.now, self.truth.copy()))
            ticks = np.full(4, round(self.way / STEP))
            readings = [
                WheelState(self.now, ticks, np.zeros(4), np.array([self.speed, 0.0, 0.0])),
                ImuReading(self.now, np.array([change / TICK, 0.0, 9.81]), np.zeros(3)),
            ]
            if with_scans and round(self.now / TICK) % 10 == 3 and self.now > 0.05:
                readings.append(self.scan())
            self.localiser.step(self.now, readings)
            events += self.localiser.events
            off.append(np.hypot(*(self.localiser.pose(self.now) - self.truth)[:2]))
        self.events = events
        return np.array(off)

    def state(self):
        amcl = self.localiser.amcl
        return (
            *self.localiser.pose(self.now), *self.localiser.covariance.flat, *amcl.pose,
            *amcl.particles.flat, *amcl.weights, amcl.stamp, amcl.updates, self.localiser.lost,
        )  # fmt: skip


def test_follows_a_drive_smoothly():
    rig = Rig()
    rig.truth = np.array([0.008, -0.006, 0.003])  # as the dock leaves it
    rig.run(0.5)
    off = rig.run(6.0, speed=0.7)
    assert np.sqrt(np.mean(off[200:] ** 2)) < 0.012
    assert not rig.localiser.lost and rig.localiser.amcl.quality > 0.9
    assert np.max(np.abs(np.diff(off))) < 0.004  # no jumps: it can be controlled by
    error = rig.localiser.pose(rig.now) - rig.truth
    assert error @ np.linalg.solve(rig.localiser.covariance, error) < 16.27  # 99.9 %


def test_pose_of_a_past_exposure():
    rig = Rig()
    rig.run(3.0, speed=0.5)
    np.testing.assert_allclose(
        rig.localiser.pose_at(rig.now - 0.5)[0], rig.localiser.pose(rig.now)[0] - 0.25, atol=0.005
    )
    assert rig.localiser.pose_at(rig.now - 60.0) is None
    assert rig.localiser.pose_at(rig.now + 1.0) is None
    there = compose2(rig.localiser.world_from_odom, rig.localiser.fused.pose(rig.now))
    np.testing.assert_allclose(there, rig.localiser.pose(rig.now), atol=1e-12)


BROKEN = {
    "late": lambda r: r.scan(r.now - 0.35),
    "older than the history": lambda r: replace(r.scan(), stamp=r.now - 30.0),
    "duplicated": lambda r: r.last,
    "without ranges": lambda r: replace(r.scan(), ranges=np.zeros(0)),
    "NaN": lambda r: replace(r.scan(), ranges=np.full(271, np.nan)),
    "no return": lambda r: replace(r.scan(), ranges=np.full(271, np.inf)),
    "stamp NaN": lambda r: replace(r.scan(), stamp=np.nan),
    "of the future": lambda r: replace(r.scan(), stamp=r.now + 5.0),
    "two-dimensional": lambda r: replace(r.scan(), ranges=np.ones((3, 4))),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_a_bad_scan_is_dropped_and_changes_nothing(kind):
    rig = Rig()
    rig.run(1.0, speed=0.5)
    rig.now += TICK
    rig.last = rig.scan()
    rig.localiser.step(rig.now, [rig.last])
    before, dropped = rig.state(), rig.localiser.dropped
    rig.localiser.step(rig.now, [BROKEN[kind](rig)])
    assert rig.state() == before
    assert rig.localiser.dropped == dropped + 1
    assert len(rig.localiser.events) == 1 and "dropped" in rig.localiser.events[0]
    assert "\n" not in rig.localiser.events[0]


def test_reordered_scans_keep_the_newer():
    rig = Rig()
    rig.run(1.0, speed=0.5)
    newer, older = rig.scan(rig.now - 0.01), rig.scan(rig.now - 0.04)
    rig.localiser.step(rig.now, [newer, older])
    assert rig.localiser.amcl.stamp == newer.stamp and rig.localiser.dropped == 1


def test_carried_off_it_is_lost_then_found_by_driving():
    rig = Rig()
    rig.run(1.0)
    rig.run(1.0, speed=0.5)
    rig.run(1.0)
    rig.truth = np.array([8.4, 3.65, 0.0])
    off = rig.run(LOST_AFTER + 0.5)
    assert rig.localiser.lost and off[-1] > 1.0
    assert any("lost" in event for event in rig.events)
    rig.run(0.8 * CONFIRM / 0.4, speed=0.4)
    assert rig.localiser.lost  # it fits already, and yet it is not believed
    off = rig.run(2.5, speed=0.4)
    assert not rig.localiser.lost and off[-1] < 0.05


def test_carried_to_the_place_alike_in_the_next_aisle():
    """From before rack 2 to the same spot before rack 3: no odometry tells, the scan must."""
    rig = Rig((8.4, 1.55, 0.0))
    rig.localiser.amcl.initialise(rig.truth, np.diag([0.01, 0.01, 0.01]) ** 2, LAYOUT.site.dock)
    rig.localiser._take_over()
    off = rig.run(2.0, speed=0.4)
    assert off[-1] < 0.05
    rig.truth = compose2(rig.truth, (0.0, 2.1, 0.0))
    rig.run(1.2, speed=0.4)
    assert rig.localiser.lost
    off = rig.run(4.5, speed=0.4)
    assert not rig.localiser.lost and off[-1] < 0.05


def test_something_before_the_lidar_is_no_kidnapping():
    rig = Rig()
    rig.run(0.5)
    rig.run(1.5, speed=0.5)
    plain = rig.scan

    def blocked(stamp=None):
        reading = plain(stamp)
        ranges = np.array(reading.ranges)
        ranges[108:163] = np.minimum(ranges[108:163], 0.8)  # a box of 55 degrees, a fifth of all
        return replace(reading, ranges=ranges)

    rig.scan = blocked
    off = rig.run(4.0, speed=0.4)
    assert not rig.localiser.lost and off.max() < 0.05


def test_switched_on_anywhere():
    options = LAYOUT.options.model_copy(update={"start_known": False})
    config = replace(CONFIG, options=options)
    rig = Rig((9.0, 5.75, 0.0), config=config)
    assert rig.localiser.lost and rig.localiser.particles == Kld().most
    rig.run(1.0)
    off = rig.run(5.0, speed=0.4)
    assert not rig.localiser.lost and off[-1] < 0.05
    assert Kld().most / rig.localiser.particles >= 5


# --- tags -------------------------------------------------------------------------------------


def fix(rig, tag="C0", pose=None, placed=None):
    """What the camera reads at the exposure that the localiser is told of."""
    surveyed = next(t.pose for t in LAYOUT.site.tags if t.name == tag)
    vehicle = rig.truth if pose is None else pose
    seen = between2(vehicle, surveyed if placed is None else placed)
    return TagFix(rig.now, TagText(tag, surveyed), seen, np.zeros((3, 2)), np.diag([4e-3] * 3) ** 2)


def test_a_tag_below_tau_is_fused():
    rig = Rig()
    rig.run(1.0, speed=0.5)
    before = rig.localiser.pose(rig.now)
    rig.localiser._tag(fix(rig, "D0"))
    assert rig.localiser.sights[-1].action == "fused"
    assert np.hypot(*(rig.localiser.pose(rig.now) - rig.truth)[:2]) < 0.006
    assert np.hypot(*(rig.localiser.pose(rig.now) - before)[:2]) < 0.03


def test_a_tag_ends_being_lost_at_once():
    rig = Rig()
    rig.run(1.0, speed=0.3)
    rig.run(1.0)
    rig.truth = np.array([9.25, 3.65, 0.0])
    rig.run(1.2)
    assert rig.localiser.lost
    rig.localiser._tag(fix(rig, "P2"))
    assert not rig.localiser.lost and rig.localiser.sights[-1].action != "refused"
    assert np.hypot(*(rig.localiser.pose(rig.now) - rig.truth)[:2]) < 0.01
    off = rig.run(1.5, speed=0.4)
    assert off.max() < 0.03 and not rig.localiser.lost


def test_a_tag_laid_elsewhere_does_no_harm():
    rig = Rig()
    rig.run(2.0, speed=0.5)
    before = rig.localiser.pose(rig.now)
    placed = (*rig.truth[:2], 0.0)  # C0 lies here, 4 m off its place
    rig.localiser._tag(fix(rig, "C0", placed=placed))
    assert rig.localiser.sights[-1].action == "refused"
    np.testing.assert_array_equal(rig.localiser.pose(rig.now), before)
    assert any("C0" in event for event in rig.localiser.events)


def test_a_wrong_tag_while_lost_is_not_believed():
    rig = Rig()
    rig.run(1.0)
    rig.truth = np.array([9.25, 3.65, 0.0])
    rig.run(1.5)
    assert rig.localiser.lost
    rig.localiser._tag(fix(rig, "G0", placed=(9.25, 3.65, 0.0)))
    assert rig.localiser.lost and rig.localiser.sights[-1].action == "refused"


def test_tags_can_be_switched_off():
    options = LAYOUT.options.model_copy(update={"tags": False})
    assert Localiser(replace(CONFIG, options=options), LAYOUT.site.dock)._tags is None


# --- maps -------------------------------------------------------------------------------------


def test_drives_by_a_map_file(tmp_path):
    drawn = lidar_map(LAYOUT.site, CONFIG.T_base_lidar)
    log_odds = np.where(drawn.occupied, 3.0, np.where(drawn.free, -3.0, 0.0)).astype(np.float32)
    save_map(OccupancyGrid(drawn.origin, drawn.resolution, log_odds), tmp_path / "lidar.yaml")
    options = LAYOUT.options.model_copy(update={"map": str(tmp_path)})
    rig = Rig(config=replace(CONFIG, options=options))
    rig.run(0.5)
    off = rig.run(4.0, speed=0.7)
    assert np.sqrt(np.mean(off[100:] ** 2)) < 0.03


def test_a_missing_map_file_is_one_line(tmp_path):
    options = LAYOUT.options.model_copy(update={"map": str(tmp_path / "none")})
    with pytest.raises(ValueError, match="none") as error:
        Localiser(replace(CONFIG, options=options), LAYOUT.site.dock)
    assert "\n" not in str(error.value)


def test_same_seed_same_bits():
    first, second = Rig(), Rig()
    first.run(1.5, speed=0.5)
    second.run(1.5, speed=0.5)
    assert first.state() == second.state()


def test_fewer_particles_are_as_exact_as_many():
    """KLD's count against a fixed greatest one, on the same drive."""
    errors = []
    for settings in (AmclSettings(), AmclSettings(kld=Kld(least=10_000, most=10_000))):
        rig = Rig(localiser=Localiser(CONFIG, LAYOUT.site.dock, settings))
        rig.run(0.5)
        errors.append(np.sqrt(np.mean(rig.run(4.0, speed=0.7)[100:] ** 2)))
    assert errors[0] < errors[1] + 0.002


def test_particles_that_stray_to_a_place_that_looks_alike_are_called_back():
    start = np.array([8.6, 1.55, 0.0])
    alone = AmclSettings(most_recovery=0.0)  # the filter does not find back by itself
    rig = Rig(start, localiser=Localiser(CONFIG, start, alone))
    rig.run(2.0, speed=0.5)
    amcl = rig.localiser.amcl
    alike = compose2(rig.truth, (0.0, 2.1, 0.0))  # the next aisle
    amcl.initialise(alike, 0.001 * np.eye(3), rig.localiser.fused.pose(rig.now))
    off = rig.run(2.0, speed=0.5)
    assert not rig.localiser.lost and off.max() < 0.03
    assert np.hypot(*(amcl.pose - rig.truth)[:2]) < 0.1

"""Where the vehicle is: dead reckoning, corrected by the lidar on the map and by floor tags.

Wheels and inertial unit carry the pose from tick to tick; AMCL and tags correct the frame that they
count in. Nobody knows where the vehicle is after it was carried away: then `lost` holds until a tag
says so, or until the scan has fitted one place alone over some way.
"""

from collections.abc import Iterable

import numpy as np

from twin.geometry import Array, between2, pose2_to_transform
from twin.messages import BeaconSight, BeaconStamps, FloorFrame, LidarScan, TagSight
from twin.stack.config import StackConfig
from twin.stack.detection.qr import TagDrawing, TagFix, TagReader
from twin.stack.estimation.amcl import AmclSettings
from twin.stack.estimation.beacon_fusion import BeaconFusion, pose7
from twin.stack.estimation.fusion import FusedOdometry
from twin.stack.estimation.map_correction import MapCorrection, growth
from twin.stack.estimation.qr_fusion import QrFusion, TagPolicy
from twin.stack.estimation.site_amcl import site_amcl

SEED = 20  # of the particles; any will do
# Scans half a metre apart see the same error of map, mount and range: as many count as one.
SHARED = 10.0
# What all scans share: lidar's mount (2 mm, 3 mrad) and range offset (10 mm, in part cancelled).
SYSTEMATIC = np.diag([0.005, 0.005, 0.003]) ** 2
ELSEWHERE, ELSEWHERE_YAW = 0.5, 0.26  # m, rad from the believed pose: that is another place
BETTER = 0.10  # of a scan's beams that the map must explain more of there to be believed
POOR = 0.5  # of what the map usually explains: less is no place at all, whatever stands around
LOST_AFTER = 0.5  # s of doubt
PATIENCE = 5  # updates in a row outside the gate, after which the map is believed
SURE = 0.95  # share of the particles in one place
SPREAD = 0.15  # m, 1 sigma of that place at most
CONFIRM = 1.2  # m of way over which one place alone must fit before it is believed
TURN_WORTH = 0.2  # m of way that a radian on the spot is worth: it brings new walls into view
GOOD = 0.92  # of what the map explains of scans in known places


class Localiser:
    """Pose of the vehicle in world.

    Args:
        config: the nominal drawing and the options: `tags`, and `map` for a folder of maps.
        start: x, y, yaw believed at the start, in world, within `odometry_start_sigma`.
        settings: of AMCL; those of the options without any.
        policy: of the tags.
        seed: of the particles.

    Raises:
        ValueError: one line, for a map file that cannot be read.
    """

    def __init__(
        self,
        config: StackConfig,
        start: Array,
        settings: AmclSettings | None = None,
        policy: TagPolicy | None = None,
        seed: int = SEED,
    ):
        start = np.array(start, dtype=float)
        self.fused = FusedOdometry(config, start)
        self.amcl = site_amcl(config, np.random.default_rng(seed), settings)
        spread = np.diag(np.square(config.odometry_start_sigma))
        self.amcl.initialise(start, spread, odometry=start)
        self._correction = MapCorrection(start, spread, start)
        self._reckoned = self.fused.covariance  # when the correction was last carried
        self._tags: QrFusion | None = None
        if config.options.tags and config.site.tags:
            self._tags = QrFusion({tag.name: tag.pose for tag in config.site.tags}, policy)
            self._reader = TagReader(config.tag_camera, TagDrawing(side=config.tag_side))
        network = config.options.beacons != "off"
        self._network = BeaconFusion(config) if network else None
        self._heard = ""  # what came of the network's last turn
        self.beacons: list[BeaconSight] = []
        self.sights: list[TagSight] = []
        self.events: list[str] = []
        self.dropped = 0
        self.lost = False
        self._doubted_since: float | None = None  # stamp of a scan
        self._outside = 0  # AMCL's poses in a row outside the gate
        self._confirmed = 0.0  # m of way over which one place alone has fitted
        self._usual = self.amcl.settings.expected  # explained by the map in known places
        if not config.options.start_known:
            self.relocate()

    # --- what others ask -------------------------------------------------------------------------

    def pose(self, now: float) -> Array:
        """x, y, yaw in world. Shape (3,)."""
        return self._correction.at(self.fused.pose(now))

    def pose_at(self, stamp: float) -> Array | None:
        """x, y, yaw in world at a past exposure; None where the history does not reach."""
        reckoned = self.fused.history.at(stamp)
        return None if reckoned is None else self._correction.at(reckoned)

    def pose6(self, now: float) -> Array | None:
        """x, y, z, qw, qx, qy, qz in world; None without a photoelectric network. Shape (7,)."""
        if self._network is None:
            return None
        if self._network.filter is None or not self._network.alive(now):
            return pose7(pose2_to_transform(self.pose(now)))
        return pose7(self._network.filter.at(self.fused.pose(now)))

    @property
    def world_from_odom(self) -> Array:
        """Pose of the dead reckoning's frame in world. Shape (3,)."""
        return self._correction.world_from_odom

    @property
    def covariance(self) -> Array:
        """Of x, y, yaw in world, when the correction was last carried. Shape (3, 3)."""
        return self._correction.covariance.copy()

    @property
    def velocity(self) -> Array:
        """vx, vy, omega in base. Shape (3,)."""
        return self.fused.velocity

    @property
    def standing(self) -> bool:
        return self.fused.standing

    @property
    def ready(self) -> bool:
        """Whether the gyro bias is known well enough to drive."""
        return self.fused.ready

    @property
    def particles(self) -> int:
        return len(self.amcl.particles)

    def relocate(self) -> None:
        """Give up the pose: search the whole map."""
        self.amcl.scatter()
        self._lose("localisation: asked to search the whole map")

    # --- the tick --------------------------------------------------------------------------------

    def step(self, stamp: float, readings: Iterable) -> None:
        """Take what has arrived since the last tick; `sights` and `events` are new in each.

        Readings that are broken, late or come twice change nothing and are counted in `dropped`,
        with an event that says why.
        """
        readings = list(readings)
        self.sights, self.events, self.beacons = [], [], []
        self.fused.step(readings)
        for reading in readings:
            if isinstance(reading, LidarScan):
                self._scan(reading)
            elif isinstance(reading, FloorFrame) and self._tags is not None:
                for fix in self._reader.read(reading):
                    self._tag(fix)
            elif isinstance(reading, BeaconStamps) and self._network is not None:
                self._beacon(reading, self._network)

    def _drop(self, why: str) -> None:
        self.dropped += 1
        self.events.append(why)

    def _carry(self, reckoned: Array) -> None:
        """Bring the correction to a pose of the dead reckoning."""
        covariance = self.fused.covariance
        way = reckoned[:2] - self._correction.odometry[:2]
        self._correction.carry(reckoned, growth(self._reckoned, covariance, way))
        self._reckoned = covariance

    # --- the lidar -------------------------------------------------------------------------------

    def _scan(self, scan: LidarScan) -> None:
        reckoned = self.fused.history.at(scan.stamp) if np.isfinite(scan.stamp) else None
        if reckoned is None:
            self._drop(f"scan at {scan.stamp:.3f} s dropped: where it was taken is not known")
            return
        amcl = self.amcl
        updates, before = amcl.updates, amcl.pose_odometry
        fault = amcl.update(scan, reckoned)
        if fault is not None:
            self._drop(fault)
            return
        news = amcl.updates > updates
        if self.lost:
            self._carry(reckoned)
            if news and before is not None:
                self._confirm(between2(before, reckoned))
            return
        if news:
            self._carry(reckoned)
        if self._told(scan.stamp):
            return
        if not self._doubt(scan.stamp, reckoned) and news and not amcl.lost:
            self._correct()

    def _doubt(self, stamp: float, reckoned: Array) -> bool:
        """Whether the vehicle may not be where it is believed to be; after a while it is lost.

        Something that stands before the lidar hides part of the map, and what is left may seem to
        fit elsewhere too; particles that stray there are called back. A vehicle that was carried
        off fits clearly better elsewhere, or nowhere.

        Args:
            stamp: of the scan, s.
            reckoned: pose of the dead reckoning at its exposure. Shape (3,).
        """
        amcl = self.amcl
        here, there = self._correction.at(reckoned), amcl.pose_at(reckoned)
        off = between2(here, there)
        elsewhere = np.hypot(*off[:2]) > ELSEWHERE or abs(off[2]) > ELSEWHERE_YAW
        if elsewhere:
            gain = amcl.explained(there, reckoned) - amcl.explained(here, reckoned)
            if gain < BETTER:
                amcl.initialise(here, self.covariance + SYSTEMATIC, reckoned, stamp)
                elsewhere = False
        doubtful = bool(elsewhere or amcl.quality < POOR * self._usual)
        if not doubtful:
            self._doubted_since = None
            if not amcl.lost:
                self._usual += 0.02 * (amcl.quality - self._usual)
        elif self._doubted_since is None:
            self._doubted_since = stamp
        elif stamp - self._doubted_since >= LOST_AFTER:
            self._lose(f"localisation: lost, the map explains {amcl.quality:.0%} of the scan")
        return doubtful

    def _correct(self) -> None:
        amcl = self.amcl
        if self._correction.update(amcl.pose, SHARED * amcl.covariance + SYSTEMATIC):
            self._outside = 0
            return
        self._outside += 1
        if self._outside >= PATIENCE and self._one_place():
            self.events.append("localisation: taken over from the map, which has differed")
            self._take_over()

    def _confirm(self, step: Array) -> None:
        """Found, when one place alone has fitted over some way, of which this is a step (3,)."""
        way = float(np.hypot(*step[:2])) + TURN_WORTH * abs(float(step[2]))
        amcl = self.amcl
        good = not amcl.lost and amcl.quality >= GOOD * self._usual and self._one_place()
        self._confirmed = self._confirmed + way if good else 0.0
        if self._confirmed >= CONFIRM:
            self.events.append("localisation: found, one place alone fits the scans")
            self._take_over()

    def _one_place(self) -> bool:
        amcl = self.amcl
        return amcl.dominance >= SURE and float(np.trace(amcl.covariance[:2, :2])) < SPREAD**2

    def _lose(self, why: str) -> None:
        self.lost = True
        self._confirmed = 0.0
        self.events.append(why)

    def _believe(self, pose: Array, covariance: Array, odometry: Array) -> None:
        """Start the correction anew from a pose that is sure."""
        self._correction.reset(pose, covariance, odometry)
        self._reckoned = self.fused.covariance
        self._outside, self._doubted_since = 0, None
        self.lost = False

    def _take_over(self) -> None:
        """The pose is AMCL's from now on."""
        amcl = self.amcl
        assert amcl.pose_odometry is not None
        self._believe(amcl.pose, amcl.covariance + SYSTEMATIC, amcl.pose_odometry)

    # --- tags ------------------------------------------------------------------------------------

    def _tag(self, fix: TagFix) -> None:
        assert self._tags is not None
        if self._told(fix.stamp):
            return
        reckoned = self.fused.history.at(fix.stamp) if np.isfinite(fix.stamp) else None
        if reckoned is None:
            self._drop(f"tag {fix.text.tag_id} dropped: where it was seen is not known")
            return
        self._carry(reckoned)
        believed, covariance = self._correction.pose, self._correction.covariance
        if self.lost:  # then what the map says so far is all that a tag can contradict
            believed = self.amcl.pose_at(reckoned)
            covariance = self.amcl.covariance + SYSTEMATIC
        decision = self._tags.update(
            fix, believed, covariance, lambda pose: self.amcl.fit(pose, reckoned)
        )
        text = fix.text
        self.sights.append(
            TagSight(fix.stamp, text.tag_id, decision.action, decision.pose, text.next_nodes)
        )
        if decision.action == "refused":
            self.events.append(decision.reason)
            return
        if decision.action == "fused" and not self.lost:
            self._correction.reset(decision.pose, decision.covariance, reckoned)
        else:
            self.events.append(f"localisation: pose taken from tag {fix.text.tag_id}")
            self.amcl.initialise(decision.pose, decision.covariance, reckoned, fix.stamp)
            self._believe(decision.pose, decision.covariance, reckoned)

    # --- the photoelectric network ---------------------------------------------------------------

    def _told(self, stamp: float) -> bool:
        """Whether the network tells the pose, to which scan and tags can add nothing."""
        return self._network is not None and self._network.alive(stamp)

    def _beacon(self, reading: BeaconStamps, network: BeaconFusion) -> None:
        c = self._correction
        believed = c.pose, c.covariance, c.odometry
        sight = network.hear(reading, self.fused.history, self.fused.covariance, believed)
        self.beacons.append(sight)
        if sight.reason != self._heard:
            self._heard = sight.reason
            self.events.append(f"photoelectric network: {sight.reason}")
        if sight.reason != "fused":
            return
        assert network.filter is not None
        pose, covariance = network.filter.planar
        if self.lost or self._doubted_since is not None:
            self.amcl.initialise(pose, covariance, network.filter.odometry, sight.stamp)
        self._believe(pose, covariance, network.filter.odometry)

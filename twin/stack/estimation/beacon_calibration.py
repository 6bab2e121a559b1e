"""Calibration of the scanning head, and the file that keeps it.

At several stops the vehicle gathers turns of the head. Their mean gives the planes' angles by
bundle adjustment (Liu et al. 2022, Eqs. 29-33), then the head's pose at each stop; those and the
dead reckoning in between give the head's mount on the vehicle.
"""

import json
import math
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, ValidationError, model_validator

from twin.geometry import Array, between2, quat_wxyz, rotation_from_quat, transform
from twin.messages import BeaconStamps
from twin.site import Strict
from twin.stack.config import BeaconHead, StackConfig
from twin.stack.estimation.beacon_receiver import locator, stamp_batch
from twin.stack.estimation.beacons.angles import Crossings
from twin.stack.estimation.beacons.calibration import Calibration, average, calibrate
from twin.stack.estimation.beacons.mount import Mount, Stop, calibrate_mount
from twin.stack.estimation.beacons.stamps import HeadParameters, NoFix
from twin.stack.estimation.map_correction import growth

# By which the dead reckoning of a way may be off beyond what it says of itself: wheels of a radius
# other than drawn, by path (per m) and by turn (per rad). m, m, rad; guess.
WAY, WAY_TURN = np.array([0.002, 0.002, 0.0005]), np.array([0.0005, 0.0005, 0.0005])
WAY_FLOOR = np.array([2e-4, 2e-4, 1e-4])  # m, m, rad

FAR = 0.1  # rad and m from the drawing, thirty sigmas and more of how a head is built and bolted on
DRAWN = BeaconHead().planes.as_array().tolist()
MOUNT = BeaconHead().T_base_head

Number = Annotated[float, Field(allow_inf_nan=False)]
Three = tuple[Number, Number, Number]
Nine = Annotated[list[Number], Field(min_length=9, max_length=9)]


class BeaconCalibration(Strict):
    """The file. Angles in rad, lengths in m.

    `covariance` is what the residuals leave open: of the planes, of the mount's shift in base and
    its turn in head axes.
    """

    version: Literal[2] = 2
    planes: Three  # phi_1, phi_2, phi_r
    mount_position: Three  # of the head in base
    mount_quat_wxyz: tuple[Number, Number, Number, Number]
    covariance: Annotated[list[Nine], Field(min_length=9, max_length=9)]
    stops: Annotated[int, Field(gt=0)]
    turns: Annotated[int, Field(gt=0)]  # of the head, over all stops

    @model_validator(mode="after")
    def _can_be_a_head(self):
        if abs(math.hypot(*self.mount_quat_wxyz) - 1.0) > 1e-3:
            raise ValueError("mount_quat_wxyz: not of unit length")
        if any(abs(p - q) > FAR for p, q in zip(self.planes, DRAWN, strict=True)):
            raise ValueError(f"planes: more than {FAR} rad from those of the drawing")
        if np.abs(np.subtract(self.mount_position, MOUNT[:3, 3])).max() > FAR:
            raise ValueError(f"mount_position: more than {FAR} m from that of the drawing")
        if np.abs(rotation_from_quat(self.mount_quat_wxyz) - MOUNT[:3, :3]).max() > FAR:
            raise ValueError(f"mount_quat_wxyz: more than {FAR} rad from that of the drawing")
        C = np.array(self.covariance)
        off = np.abs(C - C.T).max() > 1e-6 * np.abs(C).max()
        if off or not np.all(np.diag(C) > 0.0) or np.linalg.eigvalsh(C)[0] < -1e-6 * C.max():
            raise ValueError("covariance: not symmetric and positive")
        return self

    @property
    def sigma(self) -> Array:
        """Standard deviations of planes, shift and turn of the mount. Shape (9,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)), dtype=np.float64)

    def applied(self, config: StackConfig) -> StackConfig:
        """The belief with the head as it was found."""
        R = rotation_from_quat(self.mount_quat_wxyz)
        T = transform(R, self.mount_position)
        planes = HeadParameters(*self.planes)
        C = np.array(self.covariance)
        head = replace(config.beacons, planes=planes, T_base_head=T, covariance=C)
        return replace(config, beacons=head)


def save_beacon_calibration(calibration: BeaconCalibration, path: Path) -> None:
    """Write the file, complete or not at all."""
    part = path.with_name(path.name + ".part")
    part.write_text(calibration.model_dump_json(indent=2) + "\n", encoding="utf-8")
    part.replace(path)


def load_beacon_calibration(path: Path) -> BeaconCalibration:
    """Read the file.

    Raises:
        ValueError: one line, for a file that is missing, of another version or malformed.
    """
    try:
        tree = json.loads(Path(path).read_text(encoding="utf-8"))
        return BeaconCalibration.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise ValueError(f"beacon calibration {path}: {where}: {first['msg']}") from None
    except (OSError, ValueError) as error:
        raise ValueError(f"beacon calibration {path}: cannot be read ({error})") from None


class BeaconCalibrationRun:
    """Gathers turns of the head at stops, and solves for planes and mount.

    Args:
        config: the drawing, which gives the start.
    """

    def __init__(self, config: StackConfig):
        self._config, self._locator = config, locator(config)
        self.stops: list[list[Crossings]] = []
        self.times: list[float] = []  # at which the vehicle began to listen at each
        self._ways: list[tuple[Array, Array]] = []  # dead reckoning at each stop, its covariance
        self.gathering = False

    @property
    def turns(self) -> int:
        """Gathered so far."""
        return sum(map(len, self.stops))

    def begin(self, now: float, odometry: Array, covariance: Array) -> None:
        """The vehicle stands at the next stop: pose (3,) and covariance of the dead reckoning."""
        self.stops.append([])
        self.times.append(now)
        self._ways.append((np.array(odometry, dtype=float), np.array(covariance, dtype=float)))
        self.gathering = True

    def end(self) -> None:
        """The vehicle is about to leave."""
        self.gathering = False

    def hear(self, reading: BeaconStamps) -> None:
        """Take a turn, if the vehicle stands at a stop."""
        if not self.gathering:
            return
        found = self._locator.crossings(stamp_batch(reading))
        if isinstance(found, NoFix):
            return
        index = self._locator.survey.index
        to_survey = np.array([index[name] for name in reading.nodes], dtype=np.int64)
        seen = found[0]
        self.stops[-1].append(replace(seen, node=to_survey[seen.node]))

    def solve(self) -> BeaconCalibration:
        """Planes and mount from the stops so far.

        Raises:
            ValueError: one line, if what was gathered does not determine them.
        """
        means = [average(complete(stop)) for stop in self.stops]
        found = calibrate(means, self._locator.survey, self._config.beacons.planes)
        mount, covariance = self._mount(means, found)
        T = mount.T_base_head
        return BeaconCalibration(
            planes=tuple(found.head.as_array().tolist()),
            mount_position=tuple(T[:3, 3].tolist()),
            mount_quat_wxyz=tuple(quat_wxyz(T[:3, :3]).tolist()),
            covariance=covariance.tolist(),
            stops=len(self.stops),
            turns=self.turns,
        )

    def _mount(self, means: list[Crossings], found: Calibration) -> tuple[Mount, Array]:
        """The mount, and the covariance of planes and mount together, (9, 9)."""
        place = replace(self._locator, head=found.head)
        stops, by_planes = [], []
        for k, (seen, (odometry, covariance)) in enumerate(zip(means, self._ways, strict=True)):
            pairs = zip(seen.node.tolist(), seen.plane.tolist(), strict=True)
            trusted = [(k, place.survey.names[n], m + 1) not in found.rejected for n, m in pairs]
            rows = np.nonzero(np.array(trusted))[0]
            T, sure, shifts = place.refined(seen, found.R[k], found.p[k], rows)
            way = way_covariance = None
            if k:
                before, covariance_before = self._ways[k - 1]
                way = between2(before, odometry)
                grown = growth(covariance_before, covariance, odometry[:2] - before[:2])
                grown = np.diag(np.diag(grown))  # axes of base and dead reckoning may differ
                path, turn = float(np.hypot(*way[:2])), abs(float(way[2]))
                more = (WAY * path) ** 2 + (WAY_TURN * turn) ** 2 + WAY_FLOOR**2
                way_covariance = grown + np.diag(more)
            stops.append(Stop(T, sure, way, way_covariance))
            by_planes.append(shifts)
        mount = calibrate_mount(stops, self._config.beacons.T_base_head)
        # Wrong planes move the head's poses at all stops, and the mount with them.
        moved = mount.by_stops @ np.concatenate(by_planes)
        cross = moved @ found.covariance
        own = mount.covariance + cross @ moved.T
        return mount, np.block([[found.covariance, cross.T], [cross, own]])


def complete(turns: list[Crossings]) -> list[Crossings]:
    """Turns with exactly those crossings that most turns have, each once.

    Raises:
        ValueError: there are no turns.
    """
    if not turns:
        raise ValueError("beacon calibration: a stop at which no turn of the head was heard")
    sets = [tuple(sorted((2 * turn.node + turn.plane).tolist())) for turn in turns]
    usual = Counter(sets).most_common(1)[0][0]
    return [turn for turn, found in zip(turns, sets, strict=True) if found == usual]

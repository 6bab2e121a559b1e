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
from twin.stack.estimation.beacons.fix import Fix
from twin.stack.estimation.beacons.mount import Mount, Stop, calibrate_mount
from twin.stack.estimation.beacons.stamps import HeadParameters, NoFix
from twin.stack.estimation.map_correction import growth

# By which the dead reckoning of a way may be off beyond what it says of itself: wheels of a radius
# other than drawn, by path (per m) and by turn (per rad). m, m, rad; guess.
WAY, WAY_TURN = np.array([0.002, 0.002, 0.0005]), np.array([0.0005, 0.0005, 0.0005])
WAY_FLOOR = np.array([2e-4, 2e-4, 1e-4])  # m, m, rad

FAR = 0.1  # rad from the drawn planes, thirty sigmas of how they are built: another head
DRAWN = BeaconHead().planes.as_array().tolist()

Number = Annotated[float, Field(allow_inf_nan=False)]
Three = tuple[Number, Number, Number]


class BeaconCalibration(Strict):
    """The file. Angles in rad, lengths in m; sigmas are what the residuals leave open."""

    version: Literal[1] = 1
    planes: Three  # phi_1, phi_2, phi_r
    planes_sigma: Three
    mount_position: Three  # of the head in base
    mount_quat_wxyz: tuple[Number, Number, Number, Number]
    mount_sigma: tuple[Number, Number, Number, Number, Number, Number]  # shift, turn in head
    stops: Annotated[int, Field(gt=0)]
    turns: Annotated[int, Field(gt=0)]  # of the head, over all stops

    @model_validator(mode="after")
    def _can_be_a_head(self):
        if abs(math.hypot(*self.mount_quat_wxyz) - 1.0) > 1e-3:
            raise ValueError("mount_quat_wxyz: not of unit length")
        if any(abs(p - q) > FAR for p, q in zip(self.planes, DRAWN, strict=True)):
            raise ValueError(f"planes: more than {FAR} rad from those of the drawing")
        return self

    def applied(self, config: StackConfig) -> StackConfig:
        """The belief with the head as it was found."""
        R = rotation_from_quat(self.mount_quat_wxyz)
        T = transform(R, self.mount_position)
        planes = HeadParameters(*self.planes)
        return replace(config, beacons=replace(config.beacons, planes=planes, T_base_head=T))


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
        mount = self._mount(means, found)
        T, sigma = mount.T_base_head, np.sqrt(np.diag(mount.covariance))
        return BeaconCalibration(
            planes=tuple(found.head.as_array().tolist()),
            planes_sigma=tuple(np.sqrt(np.diag(found.covariance)).tolist()),
            mount_position=tuple(T[:3, 3].tolist()),
            mount_quat_wxyz=tuple(quat_wxyz(T[:3, :3]).tolist()),
            mount_sigma=tuple(sigma.tolist()),
            stops=len(self.stops),
            turns=self.turns,
        )

    def _mount(self, means: list[Crossings], found: Calibration) -> Mount:
        place, stops = replace(self._locator, head=found.head), []
        for k, (seen, (odometry, covariance)) in enumerate(zip(means, self._ways, strict=True)):
            fix = place.solve(seen, 0.0, place.survey.names, np.zeros(6))
            if not isinstance(fix, Fix):
                raise ValueError(f"mount: stop {k} has no pose: {fix.reason}, {fix.detail}")
            way = way_covariance = None
            if k:
                before, covariance_before = self._ways[k - 1]
                way = between2(before, odometry)
                grown = growth(covariance_before, covariance, odometry[:2] - before[:2])
                grown = np.diag(np.diag(grown))  # axes of base and dead reckoning may differ
                path, turn = float(np.hypot(*way[:2])), abs(float(way[2]))
                more = (WAY * path) ** 2 + (WAY_TURN * turn) ** 2 + WAY_FLOOR**2
                way_covariance = grown + np.diag(more)
            stops.append(Stop(fix.T_world_head, fix.head_covariance, way, way_covariance))
        return calibrate_mount(stops, self._config.beacons.T_base_head)


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

"""Ten thousand turns of the head with one node blocked and another one reflecting.

The vehicle is carried to twenty places before the truss and stands there; every 20 turns the lot
makes another node blocked and another one see the head by way of a mirror as well, or only so.
Each turn is a trial of its own, without memory. A fix counts as wrong if it is more than five sigma
off along an axis, by the Cramer-Rao bound of the nodes that are neither blocked nor reflect. While
the vehicle stands, physics is not stepped on. All metrics come from plant truth.
"""

import time
from dataclasses import dataclass

import numpy as np

from evaluation.beacon_field import WEST, calibrated_field, without_network
from evaluation.beacons import rms, true_mount, true_setting
from evaluation.belief import belief
from evaluation.run import Criterion, RunRequest, RunResult
from twin.geometry import Array
from twin.layout import BeaconFaults, Layout
from twin.messages import BeaconStamps, CourseOrder
from twin.plant.plant import Plant
from twin.plant.sensors.beacons import fitted_network
from twin.site import Pose2
from twin.stack.estimation.beacon_receiver import locator, stamp_batch
from twin.stack.estimation.beacons.bound import pose_bound, position_sigma
from twin.stack.estimation.beacons.fix import Fix, Locator
from twin.stack.estimation.beacons.stamps import NoFix, StampBatch
from twin.stack.tasks.arm_worker import ArmWorker

TRIALS, PLACES = 10_000, 20
HELD = 20  # turns after which other nodes are blocked and reflect
X, Y, YAW = (1.2, 2.3), (1.4, 3.8), 0.4  # m, rad about facing the truss: where the vehicle stands
SETTLE = 0.4  # s until it stands still after it was put down
STEP = 0.004  # s between looks at the turning head, an eighth of a turn
BEYOND = 5.0  # sigma

CRITERIA = [
    Criterion("wrong_fixes", "==", 0.0),
    Criterion("fix_availability", ">=", 0.95),
    Criterion("trials", "==", float(TRIALS)),
]


@dataclass
class Trial:
    """What came of one turn: error in sigma of the bound, (3,) of x, y, z; or why there is none."""

    off: Array | None
    reason: str = ""


def run(request: RunRequest, layout: Layout) -> RunResult:
    """Calibration drive, then the trials."""
    field = calibrated_field(request, layout)
    if field is None:
        return RunResult(notes=["the calibration drive was broken off"])
    field = without_network(with_trouble(field))
    begun, trials = time.perf_counter(), []
    config = belief(field)
    plant = Plant(field, request.seed, CourseOrder(0.0, ()))
    place, bench = locator(config), Bench(plant, request.seed)
    complete, rng = False, np.random.default_rng([request.seed, 6])
    try:
        plant.park([ArmWorker(i, config).motion.rest for i in range(2)])
        for k in range(PLACES):
            x, y, yaw = (float(rng.uniform(*span)) for span in (X, Y, (-YAW, YAW)))
            bench.carry((x, y, WEST + yaw))
            for _ in range(TRIALS // PLACES):
                if bench.time < (request.duration or np.inf):
                    trials.append(bench.trial(place))
            request.progress(bench.time, TRIALS * (k + 1) / PLACES / 30.0, f"place {k + 1}")
        complete = len(trials) == TRIALS
    except KeyboardInterrupt:
        pass  # what was measured so far is reported, marked incomplete
    finally:
        plant.close()
    spent = time.perf_counter() - begun
    reasons = sorted({t.reason for t in trials if t.off is None})
    notes = [f"{reason}: {sum(t.reason == reason for t in trials)}" for reason in reasons]
    if request.record or request.log:
        notes.append("nothing is recorded: the vehicle stands, and the stack is not driven")
    return RunResult(
        metrics=metrics(trials),
        criteria=CRITERIA,
        sim_time=bench.time,
        wall_time=spent,
        rtf=bench.time / spent,
        complete=complete,
        notes=notes,
    )


def with_trouble(layout: Layout) -> Layout:
    """The layout with other nodes blocked and reflecting every so many turns."""
    assert layout.site.beacons is not None
    trouble = BeaconFaults(shuffle=HELD / layout.site.beacons.spin_rate)
    faults = layout.world.faults.model_copy(update={"beacons": trouble})
    world = layout.world.model_copy(update={"faults": faults})
    return layout.model_copy(update={"world": world})


class Bench:
    """A plant whose vehicle stands, and a photoelectric network that goes on.

    Args:
        plant: with the network fitted.
        seed: of the run.
    """

    def __init__(self, plant: Plant, seed: int):
        self._plant, self._seed, self._places = plant, seed, 0
        self._here = 0.0  # s of the network's clocks since the vehicle was put down
        self._before = 0.0  # s at earlier places
        self._T = np.eye(4)  # true pose of the head
        self._sigmas: dict[tuple[str, ...], Array] = {}

    @property
    def time(self) -> float:
        """For which the network has run, s."""
        return self._before + self._here

    def carry(self, pose: Pose2) -> None:
        """Put the vehicle down elsewhere, let it come to rest, and switch the network on."""
        plant, wheels = self._plant, np.zeros(4)
        plant.faults.carry_off(pose)
        for _ in range(round(SETTLE / 0.002)):
            plant.step(wheels)
        self._T = plant.truth().T_world_base @ true_mount(plant)
        self._sigmas.clear()
        self._before, self._here, self._places = self.time, 0.0, self._places + 1
        rng, lot = np.random.default_rng([self._seed, 7, self._places]).spawn(2)
        model = plant.world.model
        (self._sensor,) = fitted_network(model, plant.layout, plant.as_built, rng, lot)

    def trial(self, place: Locator) -> Trial:
        """The next turn of the head, and what the estimator makes of it."""
        bad = self._bad()  # the lot may be drawn in the middle of the turn
        batch = stamp_batch(self._turn())
        fix = place.fix(batch)
        if not isinstance(fix, Fix):
            return Trial(None, fix.reason)
        bad |= self._bad()
        # The bound of this turn: a node whose clock missed its light has told nothing.
        timed = _timed(place, batch)
        good = tuple(name for name in self._sensor.names if name in timed and name not in bad)
        if good not in self._sigmas:
            bound = pose_bound(self._T, true_setting(self._plant, good))
            self._sigmas[good] = position_sigma(bound)
        return Trial((fix.T_world_head[:3, 3] - self._T[:3, 3]) / self._sigmas[good])

    def _bad(self) -> set[str]:
        trouble = self._sensor.trouble
        return {*trouble.blocked, *(r.node for r in trouble.reflections)}

    def _turn(self) -> BeaconStamps:
        world = self._plant.world
        while True:
            self._here += STEP
            reading = self._sensor.sample(self._here, world.model, world.data)
            if reading is not None:
                return reading


def _timed(place: Locator, batch: StampBatch) -> set[str]:
    """Nodes of which both planes' crossings could be timed in a turn."""
    measured = place.crossings(batch)
    if isinstance(measured, NoFix):
        return set()
    node, plane = measured[0].node, measured[0].plane
    return {name for n, name in enumerate(batch.nodes) if len(set(plane[node == n].tolist())) == 2}


def metrics(trials: list[Trial]) -> dict[str, float]:
    """All figures of the report."""
    off = np.array([t.off for t in trials if t.off is not None]).reshape(-1, 3)
    worst = np.abs(off).max(axis=1) if len(off) else np.zeros(0)
    return {
        "wrong_fixes": float(np.sum(worst > BEYOND)) if trials else float("nan"),
        "fix_availability": len(off) / len(trials) if trials else float("nan"),
        "trials": float(len(trials)),
        "worst_error_sigma": float(worst.max()) if len(worst) else float("nan"),
        "rms_error_sigma": rms(off),
    }

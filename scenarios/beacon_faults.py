"""Ten thousand turns of the head with one node blocked and another one reflecting.

The vehicle is carried to twenty places before the truss and stands there; at every turn the lot
makes another node blocked and another one see the head by way of a mirror as well, or only so.
Each turn is a trial of its own, without memory. Only turns count in which a reflected crossing was
stamped: mirrors tremble, and some images lie where no light comes. A fix counts as wrong if it is
more than five sigma off along an axis, by the Cramer-Rao bound of what was stamped by nodes that
are neither blocked nor reflect, the planes known as well as the calibration says. What the layout
itself has go wrong goes wrong besides. While the vehicle stands, physics is not stepped on. All
metrics come from plant truth.
"""

import time
from dataclasses import dataclass, replace

import numpy as np

from evaluation.beacon_field import WEST, calibrated_field
from evaluation.beacons import rms, true_mount, true_setting
from evaluation.belief import belief
from evaluation.run import Criterion, RunRequest, RunResult, Trajectory
from evaluation.trajectories import pose7
from twin.geometry import Array
from twin.layout import Layout
from twin.messages import BeaconStamps, CourseOrder
from twin.plant.plant import Plant
from twin.plant.sensors.beacons import fitted_network
from twin.site import Pose2
from twin.stack.estimation.beacon_receiver import BeaconReceiver, Located, stamp_batch
from twin.stack.estimation.beacons.bound import pose_bound, position_sigma
from twin.stack.estimation.beacons.fix import Locator
from twin.stack.estimation.beacons.stamps import NoFix, StampBatch
from twin.stack.tasks.arm_worker import ArmWorker

TRIALS, PLACES = 10_000, 20
HELD = 1  # turn after which other nodes are blocked and reflect, where the layout says nothing
MOST = 3  # turns for each trial at which a place is given up
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
    """What came of one turn.

    Attributes:
        stamp: of its middle, s of the run's clock.
        false: whether a reflected crossing was stamped.
        truth: x, y, z, qw, qx, qy, qz of the base. Shape (7,).
        fix: the same as found; nothing without a fix.
        off: error of the head in sigma of the bound along x, y, z; NaN without one. Shape (3,).
        reason: why there is no fix.
    """

    stamp: float
    false: bool
    truth: Array
    fix: Array | None = None
    off: Array | None = None
    reason: str = ""


def run(request: RunRequest, layout: Layout) -> RunResult:
    """Calibration drive, then the trials."""
    found = calibrated_field(request, with_trouble(layout))
    if isinstance(found, str):
        return RunResult(notes=[found])
    request, field = found
    begun, turns = time.perf_counter(), []
    config = belief(field)
    plant = Plant(field, request.seed, CourseOrder(0.0, ()))
    receiver, bench = BeaconReceiver(config), Bench(plant, request.seed)
    rng = np.random.default_rng([request.seed, 6])
    wanted = TRIALS // PLACES
    try:
        plant.park([ArmWorker(i, config).motion.rest for i in range(2)])
        for k in range(PLACES):
            x, y, yaw = (float(rng.uniform(*span)) for span in (X, Y, (-YAW, YAW)))
            bench.carry((x, y, WEST + yaw))
            here: list[Trial] = []
            while sum(turn.false for turn in here) < wanted and len(here) < MOST * wanted:
                if bench.time >= (request.duration or np.inf):
                    break
                here.append(bench.trial(receiver))
                turns.append(here[-1])
            request.progress(bench.time, bench.time * PLACES / (k + 1), f"place {k + 1}")
    except KeyboardInterrupt:
        pass  # what was measured so far is reported, marked incomplete
    finally:
        plant.close()
    spent = time.perf_counter() - begun
    trials = [turn for turn in turns if turn.false]
    reasons = sorted({t.reason for t in trials if t.off is None})
    notes = [f"{reason}: {sum(t.reason == reason for t in trials)}" for reason in reasons]
    if request.record or request.log:
        notes.append("nothing is recorded: the vehicle stands, and the stack is not driven")
    return RunResult(
        metrics=metrics(trials, len(turns)),
        criteria=CRITERIA,
        sim_time=bench.time,
        wall_time=spent,
        rtf=bench.time / spent,
        complete=len(trials) == TRIALS,
        trajectories=paths(turns),
        notes=notes,
    )


def with_trouble(layout: Layout) -> Layout:
    """The layout with other nodes blocked and reflecting every so many turns, its own or `HELD`."""
    trouble = layout.world.faults.beacons
    trouble = trouble.model_copy(update={"shuffle": trouble.shuffle or HELD})
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
        self._T, self._truth = np.eye(4), np.zeros(7)  # true pose of the head, of the base
        self._sigmas: dict[frozenset[tuple[str, int]], Array] = {}

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
        self._truth = pose7(plant.truth().T_world_base)
        self._sigmas.clear()
        self._before, self._here, self._places = self.time, 0.0, self._places + 1
        rng, lot = np.random.default_rng([self._seed, 7, self._places]).spawn(2)
        model = plant.world.model
        (self._sensor,) = fitted_network(model, plant.layout, plant.as_built, rng, lot)

    def trial(self, receiver: BeaconReceiver) -> Trial:
        """The next turn of the head, and what the stack makes of it."""
        reading, ailing = self._turn(), self._sensor.ailing
        stamp = self._before + reading.stamp - 0.5 / receiver.locator.spin_rate
        turn = Trial(stamp, bool(ailing.false), self._truth)
        found = receiver.locate(reading, lambda _: None)  # the vehicle stands
        if not isinstance(found, Located):
            turn.reason = found.reason
            return turn
        # The bound of this turn: what was not stamped, or cannot be timed, has told nothing.
        ill = ailing.dark | ailing.false
        told = _timed(receiver.locator, stamp_batch(reading))
        good = frozenset(pair for pair in told if pair[0] not in ill)
        if good not in self._sigmas:
            self._sigmas[good] = self._sigma(good, receiver.locator)
        T_world_head = found.T_world_base @ receiver.locator.T_base_head
        turn.fix, sigma = pose7(found.T_world_base), self._sigmas[good]
        sigma = np.where(np.isfinite(sigma), sigma, np.nan)
        turn.off = (T_world_head[:3, 3] - self._T[:3, 3]) / sigma
        return turn

    def _sigma(self, good: frozenset[tuple[str, int]], place: Locator) -> Array:
        """Bound of the head's place by some crossings. Shape (3,)."""
        names = tuple(n for n in self._sensor.names if {(n, 0), (n, 1)} & good)
        if not names:
            return np.full(3, np.inf)
        seen = np.array([[(n, k) in good for k in range(2)] for n in names]).reshape(-1, 2)
        setting = replace(true_setting(self._plant, names), seen=seen)
        planes = place.head_covariance[:3, :3]
        if np.any(planes):
            setting = replace(setting, planes=planes)
        return position_sigma(pose_bound(self._T, setting))

    def _turn(self) -> BeaconStamps:
        world = self._plant.world
        while True:
            self._here += STEP
            reading = self._sensor.sample(self._here, world.model, world.data)
            if reading is not None:
                return reading


def _timed(place: Locator, batch: StampBatch) -> set[tuple[str, int]]:
    """Node and plane, 0 or 1, of the crossings that could be timed in a turn."""
    measured = place.crossings(batch)
    if isinstance(measured, NoFix):
        return set()
    node, plane = measured[0].node.tolist(), measured[0].plane.tolist()
    return {(batch.nodes[n], k) for n, k in zip(node, plane, strict=True)}


def paths(turns: list[Trial]) -> dict[str, Trajectory]:
    """True and measured poses of the base, the latter at the turns with a fix."""
    fixed = [turn for turn in turns if turn.fix is not None]
    return {
        "truth": (_stamps(turns), np.array([t.truth for t in turns]).reshape(-1, 7)),
        "estimate": (_stamps(fixed), np.array([t.fix for t in fixed]).reshape(-1, 7)),
    }


def _stamps(turns: list[Trial]) -> Array:
    return np.array([turn.stamp for turn in turns])


def metrics(trials: list[Trial], turns: int) -> dict[str, float]:
    """All figures of the report; turns: of the head, those without a reflection too."""
    off = np.array([t.off for t in trials if t.off is not None]).reshape(-1, 3)
    worst = np.abs(off).max(axis=1) if len(off) else np.zeros(0)
    judged = np.isfinite(worst)
    return {
        # What has no bound to be judged by is no right fix.
        "wrong_fixes": float(np.sum(~(worst <= BEYOND))) if trials else float("nan"),
        "fix_availability": len(off) / len(trials) if trials else float("nan"),
        "trials": float(len(trials)),
        "turns": float(turns),
        "worst_error_sigma": float(worst[judged].max()) if judged.any() else float("nan"),
        "rms_error_sigma": rms(off[judged]),
    }

"""How well the photoelectric network tells the pose: against truth and against the bound."""

from collections import Counter
from collections.abc import Sequence
from itertools import combinations

import numpy as np

from evaluation.simulation import Simulation
from evaluation.trajectories import pose7
from twin.geometry import Array, rotation_from_quat, transform
from twin.layout import Layout
from twin.loop import Tick
from twin.messages import BeaconSight, BeaconStamps
from twin.plant.beacons import T_BASE_HEAD, node_positions
from twin.plant.plant import Plant
from twin.plant.sensors.beacons import PHI
from twin.stack.estimation.beacons.bound import Setting, pose_bound
from twin.stack.estimation.beacons.rigid import log_rotation
from twin.stack.estimation.beacons.stamps import HeadParameters, NodeSurvey, Noise


class BeaconMonitor:
    """Follows truth, what the network sent, and what the stack made of it."""

    def __init__(self):
        self.stamps: list[float] = []  # of ticks
        self._truth: list[Array] = []  # x, y, z, qw, qx, qy, qz of the base
        self._estimate: list[Array] = []
        self._velocity: list[Array] = []
        self.readings: list[BeaconStamps] = []
        self.sights: list[BeaconSight] = []

    def observe(self, tick: Tick) -> None:
        self.stamps.append(tick.stamp)
        self._truth.append(pose7(tick.truth.T_world_base))
        if tick.state.pose6 is not None:
            self._estimate.append(np.array(tick.state.pose6))
        self._velocity.append(np.array(tick.truth.velocity))
        self.readings += [r for r in tick.readings if isinstance(r, BeaconStamps)]
        self.sights += tick.state.beacons

    def outcomes(self) -> list[str]:
        """What became of the turns of the head, one line each with how many."""
        counts = Counter(sight.reason for sight in self.sights)
        return [f"{count} turns of the head: {reason}" for reason, count in counts.most_common()]

    @property
    def truth(self) -> Array:
        """Poses of the base in world. Shape (n, 7)."""
        return np.array(self._truth).reshape(-1, 7)

    @property
    def estimate(self) -> Array:
        """The same as the stack believes. Shape (n, 7)."""
        return np.array(self._estimate).reshape(-1, 7)

    @property
    def velocity(self) -> Array:
        """True vx, vy, omega in base. Shape (n, 3)."""
        return np.array(self._velocity).reshape(-1, 3)

    def truth_at(self, time: float) -> Array:
        """`T_world_base` at a time, interpolated between ticks. Shape (4, 4)."""
        t = np.array(self.stamps)
        i = int(np.clip(np.searchsorted(t, time), 1, len(t) - 1))
        k = (time - t[i - 1]) / (t[i] - t[i - 1])
        a, b = self._truth[i - 1], self._truth[i]
        quat = (1 - k) * a[3:] + k * (b[3:] if a[3:] @ b[3:] > 0 else -b[3:])
        return transform(rotation_from_quat(quat), (1 - k) * a[:3] + k * b[:3])


def true_mount(plant: Plant) -> Array:
    """`T_base_head` as built. Shape (4, 4)."""
    return T_BASE_HEAD @ plant.as_built.beacon_mount


def true_planes(plant: Plant) -> HeadParameters:
    """The planes' angles as built."""
    return HeadParameters(*(PHI + plant.as_built.beacon_planes))


def true_setting(
    plant: Plant, names: Sequence[str] | None = None, surveyed: bool = True
) -> Setting:
    """What the Cramer-Rao bound needs to know: true geometry and the injected noise.

    Args:
        plant: of the run.
        names: of the nodes that are seen; all of them without.
        surveyed: whether the survey's error counts, which does not scatter within a run.
    """
    layout: Layout = plant.layout
    network, hardware = layout.site.beacons, layout.world.beacons
    assert network is not None
    places = node_positions(network, plant.as_built.floor_seed, layout.world.tolerances.scale)
    wanted = [node.name for node in network.nodes] if names is None else list(names)
    keep = [i for i, node in enumerate(network.nodes) if node.name in wanted]
    tolerance, noise = layout.world.tolerances.scale, layout.world.sensors.noise_scale
    sigma = tolerance * np.array([network.survey_sigma(network.nodes[i]) for i in keep])
    stamped = noise * np.array([hardware.crossing_noise, hardware.sync_noise, hardware.spin_jitter])
    return Setting(
        NodeSurvey(tuple(network.nodes[i].name for i in keep), places[keep], surveyed * sigma),
        true_planes(plant),
        Noise(*stamped.tolist()),
        spin_rate=network.spin_rate,
    )


def best_triple(plant: Plant, T_world_head: Array) -> tuple[tuple[str, ...], Array]:
    """The three nodes with the smallest bound of the position, and that bound. Shape (6, 6)."""
    assert plant.layout.site.beacons is not None
    names = [node.name for node in plant.layout.site.beacons.nodes]
    found = [
        (three, pose_bound(T_world_head, true_setting(plant, three, surveyed=False)))
        for three in combinations(names, 3)
    ]
    return min(found, key=lambda entry: float(np.trace(entry[1][:3, :3])))


def errors6(found: Array, true: Array) -> Array:
    """Shift in world axes (m) and turn in own axes (rad) from a true pose. (4, 4) to (6,)."""
    turn = log_rotation(true[:3, :3].T @ found[:3, :3])
    return np.concatenate([found[:3, 3] - true[:3, 3], turn])


def calibration_errors(sim: Simulation) -> dict[str, float]:
    """Of the head that the stack believes in, against the machine as built."""
    head = sim.stack.config.beacons
    off = head.planes.as_array() - true_planes(sim.plant).as_array()
    mount = errors6(head.T_base_head, true_mount(sim.plant))
    return {
        "planes_error_max_urad": 1e6 * float(np.abs(off).max()),
        "mount_error_mm": 1e3 * float(np.linalg.norm(mount[:3])),
        "mount_error_mrad": 1e3 * float(np.linalg.norm(mount[3:])),
    }


def matrix(pose: Array) -> Array:
    """Transform of x, y, z, qw, qx, qy, qz. Shape (4, 4)."""
    return transform(rotation_from_quat(pose[3:]), pose[:3])


def rms(values) -> float:
    """Root of the mean square; NaN of nothing."""
    values = np.asarray(values, dtype=float)
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else float("nan")

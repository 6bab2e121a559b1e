"""Stamps of the photoelectric network in, pose of the vehicle out, by the option's method.

Ours takes all nodes and compensates for the motion that the dead reckoning saw during the turn; the
source's (Liu et al. 2022) takes three nodes and a fourth to choose, as if the vehicle stood.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from twin.geometry import Array, inverse, rot2, wrap_angle
from twin.messages import BeaconStamps
from twin.stack.config import StackConfig
from twin.stack.estimation.beacons.angles import TAU
from twin.stack.estimation.beacons.fix import Locator
from twin.stack.estimation.beacons.stamps import NodeSurvey, NoFix, StampBatch

# Of the source's pose, which has no covariance: its greatest scatter, Liu et al. 2022, section
# 3.2.1; the angles are a guess.
SOURCE_SIGMA = np.array([0.0028] * 3 + [0.0015] * 3)  # m, rad

# By which the vehicle may stand over or under the level floor, and lean; guess.
HEIGHT, TILT = 0.05, 0.05  # m, rad


@dataclass(frozen=True)
class Located:
    """Pose of the vehicle in the middle of a turn.

    Attributes:
        stamp: of that instant, s of the run's clock.
        T_world_base: shape (4, 4).
        covariance: shift in world axes (m), turn in base axes (rad). Shape (6, 6).
        common: the part of it that all fixes share, see `Fix`. Shape (6, 6).
        nodes: in the fix.
        rejected: (node, plane) that contradicted the others.
    """

    stamp: float
    T_world_base: Array
    covariance: Array
    common: Array
    nodes: tuple[str, ...]
    rejected: tuple[tuple[str, int], ...] = ()


def node_survey(config: StackConfig) -> NodeSurvey:
    """Nodes as the drawing has them, with the tracker's error."""
    network = config.site.beacons
    assert network is not None
    return NodeSurvey(
        tuple(node.name for node in network.nodes),
        np.array([node.position for node in network.nodes]),
        np.array([network.survey_sigma(node) for node in network.nodes]),
    )


def locator(config: StackConfig) -> Locator:
    """Estimator of the network in the drawing, with the head as it is believed to be."""
    network, head = config.site.beacons, config.beacons
    assert network is not None
    return Locator(
        node_survey(config),
        head.planes,
        head.T_base_head,
        head.covariance,
        head.sequence,
        head.counter,
        head.noise,
        network.spin_rate,
        height=HEIGHT,
        tilt=TILT,
    )


def stamp_batch(reading: BeaconStamps) -> StampBatch:
    """The counts of a message."""
    return StampBatch(reading.nodes, reading.channel, reading.kind, reading.ticks)


class BeaconReceiver:
    """Turns stamps into poses.

    Args:
        config: drawing, head and options.
    """

    def __init__(self, config: StackConfig):
        self.locator = locator(config)
        self._source = config.options.beacons == "source"

    def locate(
        self, reading: BeaconStamps, pose_at: Callable[[float], Array | None]
    ) -> Located | NoFix:
        """Pose in the middle of a turn.

        Args:
            reading: of the turn.
            pose_at: x, y, yaw of the dead reckoning at a time; None where it does not reach.
        """
        if not np.isfinite(reading.stamp):
            return NoFix("stamps not finite", "the message's own stamp")
        batch = stamp_batch(reading)
        measured = self.locator.crossings(batch)
        if isinstance(measured, NoFix):
            return measured
        seen, time = measured
        length = TAU / seen.rate
        stamp = reading.stamp - 0.5 * length
        if self._source:
            four = widest_four(self.locator.survey, whole_nodes(reading.nodes, seen))
            if four is None:
                return NoFix("few nodes", "fewer than four nodes with both planes")
            T = self.locator.source_fix(batch, four)
            if isinstance(T, NoFix):
                return T
            T_world_base = T @ inverse(self.locator.T_base_head)
            return Located(stamp, T_world_base, np.diag(SOURCE_SIGMA**2), np.zeros((6, 6)), four)
        found = self.locator.solve(seen, time, batch.nodes, _twist(stamp, length, pose_at))
        if isinstance(found, NoFix):
            return found
        nodes = tuple(dict.fromkeys(name for name, _ in found.used))
        return Located(
            stamp, found.T_world_base, found.covariance, found.common, nodes, found.rejected
        )


def whole_nodes(names: tuple[str, ...], seen) -> list[str]:
    """Nodes that both planes met."""
    return [n for i, n in enumerate(names) if len(set(seen.plane[seen.node == i])) == 2]


def widest_four(survey: NodeSurvey, names: list[str]) -> tuple[str, str, str, str] | None:
    """The three nodes that span the greatest triangle, and of the others the first; or None."""
    if len(names) < 4:
        return None

    def area(three: tuple[str, ...]) -> float:
        a, b, c = (survey.p_world[survey.index[name]] for name in three)
        return float(np.linalg.norm(np.cross(b - a, c - a)))

    a, b, c = max(combinations(names, 3), key=area)
    return a, b, c, next(name for name in names if name not in (a, b, c))


def _twist(stamp: float, length: float, pose_at: Callable[[float], Array | None]) -> Array:
    """Mean motion of the base in its axes over the turn; at rest where nobody knows. Shape (6,)."""
    before, after = pose_at(stamp - 0.5 * length), pose_at(stamp + 0.5 * length)
    if before is None or after is None:
        return np.zeros(6)
    turn = float(wrap_angle(after[2] - before[2]))
    velocity = rot2(before[2] + 0.5 * turn).T @ (after[:2] - before[:2]) / length
    return np.array([velocity[0], velocity[1], 0.0, 0.0, 0.0, turn / length])

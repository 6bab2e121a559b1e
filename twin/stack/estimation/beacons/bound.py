"""Cramer-Rao bounds: what no unbiased estimator can beat, for a geometry and the noise.

Every unknown is in the Fisher information: the head's pose, the turn's phase, speed and its change,
offset and rate of T0's clock and of each node's, and each node's true place, which the survey
tells with an error. Written apart from the estimator: derivatives of the crossings are central
differences of the closed form, and nothing is marginalised but by inverting the whole.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array, transform
from twin.stack.estimation.beacons.angles import angles_of
from twin.stack.estimation.beacons.rigid import exp_rotation
from twin.stack.estimation.beacons.small import scaled_inverse
from twin.stack.estimation.beacons.stamps import (
    Counter,
    HeadParameters,
    NodeSurvey,
    Noise,
    SyncSequence,
)

TAU = 2.0 * np.pi
MARGIN = 6e-3  # s beyond a revolution for which pulses are listened to; guess, as in the plant
STEP = 1e-5  # m and rad of the central differences


@dataclass(frozen=True)
class Setting:
    """Everything but the pose that decides how well it can be known.

    Attributes:
        survey: true places of the nodes that are seen, and the survey's error.
        head: true angles of the planes.
        noise, counter, spin_rate: of stamps and spin.
        sync: times of the synchronising pulses about the middle of the revolution, s. Shape (k,).
        revolutions: averaged, at rest, each with its own noise but the same survey.
        seen: which crossings of each node were stamped; all without. Shape (n, 2).
        planes: covariance of what is believed of phi_1, phi_2, phi_r, rad^2; known without. (3, 3).
    """

    survey: NodeSurvey
    head: HeadParameters = field(default_factory=HeadParameters)
    noise: Noise = field(default_factory=Noise)
    counter: Counter = field(default_factory=Counter)
    spin_rate: float = 30.0
    sync: Array | None = None
    revolutions: int = 1
    seen: NDArray[np.bool_] | None = None
    planes: Array | None = None

    def pulses(self) -> Array:
        """Times of the pulses; without given ones, those that a batch of one turn holds on average.

        A batch reaches `MARGIN` beyond the revolution on either side.
        """
        if self.sync is not None:
            return np.asarray(self.sync, dtype=float)
        half, period = 0.5 / self.spin_rate + MARGIN, SyncSequence().period
        n = int(np.floor(2 * half / period))
        return np.asarray(period * (np.arange(n) - 0.5 * (n - 1)), dtype=np.float64)


def pose_bound(T_world_head: Array, setting: Setting, twist_head: Array | None = None) -> Array:
    """Bound of the head's pose: shift in world axes (m), then turn in head axes (rad). (6, 6).

    Args:
        T_world_head: true pose in the middle of the revolution. Shape (4, 4).
        setting: nodes, noise.
        twist_head: true motion in head axes during the revolution. Shape (6,).
    """
    information, place, turn = _information(T_world_head, setting, twist_head)
    sigma = np.maximum(np.repeat(setting.survey.sigma, 3), 1e-9)
    information[place, place] += np.diag(1.0 / sigma**2)
    information[turn, turn] += np.diag(_speed_prior(setting))
    known = place.stop  # the planes' angles come last
    if setting.planes is not None:
        information[known:, known:] += np.linalg.inv(setting.planes)
        known += 3
    return np.asarray(scaled_inverse(information[:known, :known])[:6, :6], dtype=np.float64)


def calibration_bound(poses: list[Array], setting: Setting) -> Array:
    """Bound of phi_1, phi_2, phi_r from revolutions at several poses. Shape (3, 3), rad^2."""
    n = len(setting.survey.names)
    total = np.zeros((3 + 3 * n, 3 + 3 * n))
    sigma = np.maximum(np.repeat(setting.survey.sigma, 3), 1e-9)
    total[3:, 3:] = np.diag(1.0 / sigma**2)
    for T in poses:
        information, place, turn = _information(T, setting, None)
        information[turn, turn] += np.diag(_speed_prior(setting))
        shared = np.r_[place.stop : place.stop + 3, place.start : place.stop]
        own = np.setdiff1d(np.arange(len(information)), shared)
        A, B = information[np.ix_(shared, shared)], information[np.ix_(shared, own)]
        total += A - B @ scaled_inverse(information[np.ix_(own, own)]) @ B.T
    return scaled_inverse(total)[:3, :3]


def position_sigma(covariance: Array) -> Array:
    """Standard deviations of x, y, z in world, m. Shape (3,)."""
    return np.asarray(np.sqrt(np.diag(covariance)[:3]), dtype=np.float64)


def _information(T: Array, setting: Setting, twist: Array | None):
    """Fisher information without priors, and where places and the turn's terms stand in it.

    Order of the unknowns: pose 6; turn 3 (phase in turns, its rate, bow); clocks 2 (n + 1), T0's
    first; places 3 n; phi 3.
    """
    n, f = len(setting.survey.names), setting.spin_rate
    period = 1.0 / f
    nodes = np.asarray(setting.survey.p_world, dtype=float)
    turn = slice(6, 9)
    clock = 9
    place = slice(clock + 2 * (n + 1), clock + 2 * (n + 1) + 3 * n)
    phi = slice(place.stop, place.stop + 3)
    quantum = setting.counter.tick / np.sqrt(12)
    sigma_crossing = np.hypot(setting.noise.crossing, quantum)
    sigma_sync = np.hypot(setting.noise.sync, quantum)
    rows, weights = [], []

    def stamp(channel: int, t: float, row: Array, sigma: float) -> None:
        row[clock + 2 * channel : clock + 2 * channel + 2] = -1.0, -t
        rows.append(row)
        weights.append(setting.revolutions / sigma**2)

    def turned(row: Array, t: float) -> None:  # how the time at which an angle is met moves
        u = (t + 0.5 * period) / period
        row[turn] = np.array([1.0, t, u * (u - 1.0)]) / -f

    for t in (-0.5 * period, 0.5 * period):
        row = np.zeros(phi.stop)
        turned(row, t)
        stamp(0, t, row, sigma_crossing)
    for channel in range(n + 1):
        for t in setting.pulses():
            stamp(channel, float(t), np.zeros(phi.stop), sigma_sync)
    times = _times(T, nodes, setting, twist)
    J_pose, J_place, J_phi = _derivatives(T, nodes, setting, twist, times)
    for i in range(n):
        for k in range(2):
            missed = setting.seen is not None and not setting.seen[i, k]
            if missed or not np.isfinite(times[i, k]):
                continue
            row = np.zeros(phi.stop)
            turned(row, float(times[i, k]))
            row[:6] = J_pose[:, i, k] / (TAU * f)
            row[place.start + 3 * i : place.start + 3 * i + 3] = J_place[:, i, k] / (TAU * f)
            row[phi] = J_phi[:, i, k] / (TAU * f)
            stamp(i + 1, float(times[i, k]), row, sigma_crossing)
    A = np.array(rows)
    return A.T @ (A * np.array(weights)[:, None]), place, turn


def _speed_prior(setting: Setting) -> Array:
    """Information on the turn's bow: speeds of neighbouring revolutions differ by the jitter."""
    jitter = max(setting.noise.spin_jitter, 1e-9)
    return np.array([0.0, 0.0, 2.0 * setting.revolutions / jitter**2])


def _angles(T: Array, nodes: Array, head: HeadParameters, twist: Array | None, times: Array):
    """Angles of rotation at which the planes meet the nodes, the head moving. Shape (n, 2)."""
    found = np.empty((len(nodes), 2))
    for k in range(2):
        p = (nodes - T[:3, 3]) @ T[:3, :3]
        if twist is not None:
            for i, t in enumerate(np.nan_to_num(times[:, k])):
                R = exp_rotation(twist[3:] * t)
                p[i] = R.T @ (p[i] - exp_rotation(0.5 * twist[3:] * t) @ twist[:3] * t)
        found[:, k] = angles_of(p, head)[:, k]
    return found


def _times(T: Array, nodes: Array, setting: Setting, twist: Array | None) -> Array:
    """Of the crossings, about the middle of the revolution, s. Shape (n, 2)."""
    times = np.zeros((len(nodes), 2))
    for _ in range(1 if twist is None else 3):
        angle = _angles(T, nodes, setting.head, twist, times)
        times = (angle / TAU - 0.5) / setting.spin_rate
    return times


def _derivatives(T: Array, nodes: Array, setting: Setting, twist: Array | None, times: Array):
    """Of the crossings' angles by pose (6), place (3) and phi (3). Each (?, n, 2)."""

    def slope(low: Array, high: Array) -> Array:
        return (np.remainder(high - low + np.pi, TAU) - np.pi) / (2.0 * STEP)

    def angles(T: Array, nodes: Array, phi: Array) -> Array:
        return _angles(T, nodes, HeadParameters(*phi), twist, times)

    phi = setting.head.as_array()
    pose, place, planes = [], [], []
    for i in range(6):
        e = STEP * np.eye(6)[i]
        ends = [
            angles(transform(T[:3, :3] @ exp_rotation(s * e[3:]), T[:3, 3] + s * e[:3]), nodes, phi)
            for s in (-1, 1)
        ]
        pose.append(slope(*ends))
    for i in range(3):
        e = STEP * np.eye(3)[i]
        place.append(slope(angles(T, nodes - e, phi), angles(T, nodes + e, phi)))
        planes.append(slope(angles(T, nodes, phi - e), angles(T, nodes, phi + e)))
    return np.array(pose), np.array(place), np.array(planes)

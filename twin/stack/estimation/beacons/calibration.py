"""Angles of the two laser planes by bundle adjustment (Liu et al. 2022, Eqs. 29-33).

Levenberg-Marquardt over phi_1, phi_2, phi_r, the head's pose at every stop and the places of the
nodes, which the survey tells with an error: with many revolutions averaged that error is no longer
small. Residuals are angles of crossings in units of their noise; those of the source (Eq. 30)
are distances from a plane and grow with range. Poses are eliminated one by one (Schur complement),
so a step costs no more than the number of stops.

Frames: `T_world_head` at each stop; small errors as in `refine`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from twin.geometry import Array
from twin.stack.estimation.beacons.angles import Crossings, normal_derivatives, normals
from twin.stack.estimation.beacons.consensus import find_poses, floor_of
from twin.stack.estimation.beacons.refine import by_planes, linearise, motion, moved
from twin.stack.estimation.beacons.small import scaled_inverse
from twin.stack.estimation.beacons.stamps import HeadParameters, NodeSurvey

LEAST_NODES = 5  # Eq. 32
START_SIGMA = 5e-3  # rad by which the nominal planes may be off when poses are first guessed
OUTLIER = 5.0  # normalised residual of a crossing that is left out
ITERATIONS = 30
LOOSEST = 2e-3  # rad, standard deviation of an angle that is still a calibration


@dataclass(frozen=True)
class Calibration:
    """Result.

    Attributes:
        head: the planes' angles.
        covariance: of phi_1, phi_2, phi_r, rad^2. Shape (3, 3).
        R, p: of T_world_head at each stop. Shapes (k, 3, 3), (k, 3).
        p_world: places of the nodes as adjusted, m. Shape (n, 3).
        cost: sum of squared residuals in sigmas, the survey's included.
        freedom: residuals less unknowns.
        rejected: (stop, node, plane 1 or 2) of crossings left out.
    """

    head: HeadParameters
    covariance: Array
    R: Array
    p: Array
    p_world: Array
    cost: float
    freedom: int
    rejected: tuple[tuple[int, str, int], ...]


def average(revolutions: list[Crossings]) -> Crossings:
    """Mean of revolutions at rest, over the crossings that all of them have exactly once.

    Raises:
        ValueError: if there is none.
    """
    if not revolutions:
        raise ValueError("average: no revolutions")
    keys = [(c.node * 2 + c.plane).tolist() for c in revolutions]
    common = [k for k in keys[0] if all(other.count(k) == 1 for other in keys)]
    if not common:
        raise ValueError("average: no crossing is in every revolution")
    at = [np.array([key.index(k) for k in common]) for key in keys]
    first, n = revolutions[0], len(revolutions)
    base = first.theta[at[0]]
    off = [c.theta[i] - base for c, i in zip(revolutions, at, strict=True)]
    mean = np.mean([np.remainder(d + np.pi, 2 * np.pi) - np.pi for d in off], axis=0)
    covariance = sum(c.covariance[np.ix_(i, i)] for c, i in zip(revolutions, at, strict=True))
    return Crossings(
        first.node[at[0]],
        first.plane[at[0]],
        base + mean,
        first.time[at[0]],
        np.asarray(covariance) / n**2,
        first.rate,
    )


def calibrate(stops: list[Crossings], survey: NodeSurvey, start: HeadParameters) -> Calibration:
    """Bundle adjustment of the planes' angles.

    Args:
        stops: crossings at each stop of the vehicle, node i being the survey's i-th.
        survey: of the nodes.
        start: angles on the drawing.

    Raises:
        ValueError: too few nodes, a stop without a pose, or angles that remain undetermined.
    """
    seen = {int(i) for stop in stops for i in stop.node}
    if len(seen) < LEAST_NODES:
        raise ValueError(f"calibration: {len(seen)} nodes seen, wanted {LEAST_NODES} (Eq. 32)")
    problem = Bundle(stops, survey, start)
    rejected: list[tuple[int, str, int]] = []
    while True:
        state, cost, covariance = problem.solve()
        worst = problem.worst(state)
        if worst is None or worst[0] < OUTLIER:
            break
        _, k, row = worst
        stop = problem.stops[k]
        rejected.append((k, survey.names[int(stop.node[row])], int(stop.plane[row]) + 1))
        problem.drop(k, row)
    sigma = np.sqrt(np.diag(covariance))
    if not np.all(sigma < LOOSEST):
        names = ("phi_1", "phi_2", "phi_r")
        loose = ", ".join(n for n, s in zip(names, sigma, strict=True) if not s < LOOSEST)
        raise ValueError(f"calibration: these stops do not determine {loose}; add other places")
    head, places, R, p = state
    freedom = sum(len(stop.theta) - 6 for stop in problem.stops) - 3
    return Calibration(
        HeadParameters(*head), covariance, R, p, places, cost, freedom, tuple(rejected)
    )


class Bundle:
    """The adjustment's data and its one state: angles (3,), places (n, 3), R and p of the stops."""

    def __init__(self, stops: list[Crossings], survey: NodeSurvey, start: HeadParameters):
        self.stops = list(stops)
        self.surveyed = np.ascontiguousarray(survey.p_world, dtype=float)
        self.sigma = np.maximum(np.asarray(survey.sigma, dtype=float), 1e-7)
        self.whiteners = [np.linalg.inv(np.linalg.cholesky(s.covariance)) for s in stops]
        self.still = [motion(np.zeros(6), stop.time) for stop in stops]
        guesses = [_guess(stop, self.surveyed, start) for stop in stops]
        lost = [k for k, guess in enumerate(guesses) if guess is None]
        if lost:
            raise ValueError(f"calibration: stop {lost[0]} has no pose that fits its crossings")
        found = [guess for guess in guesses if guess is not None]
        R, p = np.array([g[0] for g in found]), np.array([g[1] for g in found])
        self.start = start.as_array(), self.surveyed.copy(), R, p

    def drop(self, k: int, row: int) -> None:
        """Leaves out one crossing of stop k."""
        s = self.stops[k]
        keep = np.delete(np.arange(len(s.theta)), row)
        covariance = s.covariance[np.ix_(keep, keep)]
        self.stops[k] = Crossings(
            s.node[keep], s.plane[keep], s.theta[keep], s.time[keep], covariance, s.rate
        )
        self.whiteners[k] = np.linalg.inv(np.linalg.cholesky(covariance))
        self.still[k] = motion(np.zeros(6), self.stops[k].time)

    def linearised(self, state, k: int):
        """Stop k: whitened residuals (m,), derivatives by the shared unknowns and by its pose."""
        phi, places, R, p = state
        stop, head = self.stops[k], HeadParameters(*phi)
        m = len(stop.theta)
        r, J = np.empty(m), np.empty((m, 6))
        A, s = self.still[k]
        n = normals(head)
        rows, seen = np.arange(m), (stop.node, stop.plane, stop.theta)
        if not linearise(R[k], p[k], rows, places, *seen, n, A, s, r, J):
            return None
        shared = np.zeros((m, 3 + 3 * len(places)))
        seen = stop.node, stop.plane, stop.theta - r
        by_plane = normal_derivatives(head).transpose(1, 0, 2).copy()
        shared[:, :3] = by_planes(R[k], p[k], places, *seen, n, by_plane, A, s)
        shared[rows[:, None], 3 + 3 * stop.node[:, None] + np.arange(3)] = -J[:, :3]
        L = self.whiteners[k]
        return L @ r, L @ shared, L @ J

    @property
    def unknowns(self) -> int:
        """Three angles, three of each place, six of each pose."""
        return 3 + self.surveyed.size + 6 * len(self.stops)

    def residuals(self, step: Array) -> Array:
        """In sigmas, of the survey and then of each stop, a step away from the start."""
        k = 3 + self.surveyed.size
        found = self._residuals(self._moved(self.start, step[:k], step[k:].reshape(-1, 6)))
        if found is None:
            raise ValueError("calibration: a plane cannot meet a node from here")
        return found

    def _residuals(self, state) -> Array | None:
        """None where a plane cannot meet a node."""
        phi, places, R, p = state
        found = [((places - self.surveyed) / self.sigma[:, None]).ravel()]
        n = normals(HeadParameters(*phi))
        for k, stop in enumerate(self.stops):
            m = len(stop.theta)
            r, J = np.empty(m), np.empty((m, 6))
            seen = (stop.node, stop.plane, stop.theta)
            if not linearise(R[k], p[k], np.arange(m), places, *seen, n, *self.still[k], r, J):
                return None
            found.append(self.whiteners[k] @ r)
        return np.concatenate(found)

    def cost(self, state) -> float:
        """Sum of squared residuals in sigmas; infinite where a plane cannot meet a node."""
        found = self._residuals(state)
        return np.inf if found is None else float(found @ found)

    def solve(self):
        """Levenberg-Marquardt. Returns the state, its cost, and the covariance of the angles."""
        state, damping = self.start, 1e-6
        cost = self.cost(state)
        size = 3 + self.surveyed.size
        weight = np.repeat(1.0 / self.sigma**2, 3)
        for _ in range(ITERATIONS):
            parts = [self.linearised(state, k) for k in range(len(self.stops))]
            blocks = []
            H0, b0 = np.zeros((size, size)), np.zeros(size)
            b0[3:] = weight * (self.surveyed - state[1]).ravel()
            H0[np.arange(3, size), np.arange(3, size)] = weight
            for part in parts:
                assert part is not None
                r, G, J = part
                H0 += G.T @ G
                b0 += G.T @ r
                blocks.append((J.T @ J, G.T @ J, J.T @ r))
            while True:
                step, own = _eliminate(H0, b0, blocks, damping)
                trial = self._moved(state, step, own)
                trial_cost = self.cost(trial)
                if trial_cost <= cost * (1.0 + 1e-12) or damping > 1e6:
                    break
                damping = max(10.0 * damping, 1e-4)
            if damping > 1e6:
                break
            change, state, cost = cost - trial_cost, trial, trial_cost
            damping *= 0.1
            if change < 1e-9 * (1.0 + cost):
                break
        return state, cost, self._covariance(state)

    def _covariance(self, state) -> Array:
        """Of the three angles, places and poses unknown as well. Infinite if undetermined."""
        information = np.zeros((3 + self.surveyed.size,) * 2)
        information[3:, 3:] = np.diag(np.repeat(1.0 / self.sigma**2, 3))
        for k in range(len(self.stops)):
            part = self.linearised(state, k)
            if part is not None:
                _, G, J = part
                Q, _ = np.linalg.qr(J)  # what the pose cannot explain away
                G = G - Q @ (Q.T @ G)
                information += G.T @ G
        return scaled_inverse(information)[:3, :3]

    def worst(self, state) -> tuple[float, int, int] | None:
        """Largest whitened residual: its size, stop and row."""
        found = None
        for k in range(len(self.stops)):
            part = self.linearised(state, k)
            if part is not None and len(part[0]) > 8:
                row = int(np.argmax(np.abs(part[0])))
                if found is None or abs(part[0][row]) > found[0]:
                    found = float(abs(part[0][row])), k, row
        return found

    def _moved(self, state, step: Array, own: Sequence[Array] | Array):
        phi, places, R, p = state
        R2, p2, turn = np.empty_like(R), np.empty_like(p), np.empty((3, 3))
        for k, e in enumerate(own):
            moved(R[k], p[k], e, R2[k], p2[k], turn)
        return phi + step[:3], places + step[3:].reshape(-1, 3), R2, p2


def _eliminate(H0: Array, b0: Array, blocks, damping: float) -> tuple[Array, list[Array]]:
    """Step of the shared unknowns and of each pose."""
    H, b = H0 + damping * np.diag(np.diag(H0)), b0
    kept = []
    for own, cross, right in blocks:
        damped = np.linalg.solve(
            own + damping * np.diag(np.diag(own)), np.column_stack([cross.T, right])
        )
        H, b = H - cross @ damped[:, :-1], b - cross @ damped[:, -1]
        kept.append(damped)
    step = np.asarray(np.linalg.solve(H, b), dtype=np.float64)
    return step, [d[:, -1] - d[:, :-1] @ step for d in kept]


def _guess(stop: Crossings, nodes: Array, head: HeadParameters):
    """Pose by consensus with as much noise as the drawing's angles may be wrong."""
    m = len(stop.theta)
    A, s = motion(np.zeros(6), stop.time)
    loose = START_SIGMA**2 * np.eye(m)
    R, p, _, _, found, _, _ = find_poses(
        *(nodes, np.zeros(len(nodes)), stop.node, stop.plane, stop.theta, normals(head), A, s),
        *(loose, True, floor_of(np.eye(4), np.inf, np.inf)),
    )
    return (R[0], p[0]) if found else None

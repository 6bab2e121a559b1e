"""Which nodes to trust: the pose stands only if no other choice of the culprit explains the data.

A node that reflects is wrong as a whole. If all nodes agree, none is left out. If not, nodes that a
plane met twice, which are beside a mirror for sure, are left out; if there are none, or the others
do not agree either, every single node is tried as the culprit. If none can be, and seven nodes or
more are left to check one another, every pair is. The pose is given only if the best choice leaves
an acceptable rest, and all that are not far less likely, by their residuals and by how the vehicle
would stand on the floor, lead to the same place. (That each leaves an acceptable rest must not be
asked: once in 100,000 turns the right one does not, just where a wrong one does.) A choice whose
rest is too small to be tested may be the right one, so then there is no fix. Rejecting the crossing
with the largest residual, as is usual, picks the wrong culprit in about one of a hundred small
reflections.
"""

from dataclasses import dataclass
from itertools import combinations, islice, product

import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array
from twin.stack.estimation.beacons.consensus import upright
from twin.stack.estimation.beacons.refine import (
    ITERATIONS,
    chi_square_limit,
    least_squares,
    linearise,
)
from twin.stack.estimation.beacons.rigid import cross_matrix
from twin.stack.estimation.beacons.stamps import NoFix

LEAST_FREEDOM = 2  # crossings beyond the six that make a pose
LEAST_NODES = 4
Z_LIMIT = 3.7  # normal deviate of the chi-square test: one good fix in 10,000 refused
# Chi-square of two degrees that a node may cost: one in 1000; of five nodes or four one in 250.
# Four good ones and one that is off by just what passes here and pulls the pose five sigma are the
# worst.
BLOCK_LIMIT, BLOCK_LIMIT_OF_FEW, FEW = 13.8, 11.0, 5
REFUTED = 25.0  # chi-square beyond the best choice's at which another is out: four in a million
# m, rad, rad: of a base's height over the floor and its tilt about two axes, 1 sigma. DIN 18202
# lets a floor be off by 3 mm over 1 m (table 3, line 4), taken as 2 sigma; a calibrated head adds
# nothing to speak of.
USUAL = np.array([0.0015, 0.0015, 0.0015])
AGREE = 2.0  # sigmas by which positions of different culprits may differ
TWINS = 60.0  # sigmas between two crossings of a plane below which either may be the true one
MOST_READINGS = 8  # choices among such crossings that are tried
APART = 0.03  # m and rad between starts that may end in different places
MOST_STARTS = 3


@dataclass(frozen=True)
class Settled:
    """A pose R, p of T_world_head, the crossings that made it, and how well they agree.

    `stance` is the chi-square of how the vehicle would stand, see `standing`.
    """

    R: Array
    p: Array
    rows: NDArray[np.int64]
    chi_square: float
    covariance: Array
    blocks: Array
    stance: float

    @property
    def cost(self) -> float:
        """Chi-square of residuals and stance."""
        return self.chi_square + self.stance

    def acceptable(self, strict: bool) -> bool:
        """Whether residuals and stance are those of the noise; strictly, each node's too."""
        limit = chi_square_limit(len(self.rows) - 6, Z_LIMIT)
        few = np.count_nonzero(self.blocks) <= FEW
        each = BLOCK_LIMIT_OF_FEW if few else BLOCK_LIMIT
        stands = self.stance < chi_square_limit(3, Z_LIMIT)
        return stands and self.chi_square < limit and (not strict or self.blocks.max() < each)


def settle(
    starts: list[tuple[Array, Array, float]], data, covariance: Array, floor: Array
) -> Settled | NoFix:
    """Least squares on the crossings that can be trusted.

    Args:
        starts: R, p and cost of poses of `consensus.find_poses`, best first.
        data: nodes, their sigma, node, plane and theta of the crossings, normals, A, s.
        covariance: of theta. Shape (m, m).
        floor: of `consensus.floor_of`. Shape (8,).
    """
    node = data[2]
    readings = _readings(starts[0], data, covariance)
    if fault := _redundancy(readings[0], node):
        return fault
    apart = _apart(starts)

    def fits(culprits: tuple[int, ...], least: int = LEAST_FREEDOM) -> list[Settled]:
        found = []
        for start, rows in product(apart, readings):
            rest = rows[~np.isin(node[rows], culprits)] if culprits else rows
            if not _checked(rest, node, least):
                continue
            fitted = _fitted(start, rest, data, covariance, floor)
            if fitted is not None:
                found.append(fitted)
        return found

    agreeing = [fitted for fitted in fits(()) if fitted.acceptable(True)]
    if agreeing and _one_place(agreeing):
        return _best(agreeing)
    if doubled := _doubled(node, data[3]):
        # Beside a mirror, for sure. The others can do without it, if they check one another.
        agreeing = [fitted for fitted in fits(doubled) if fitted.acceptable(True)] or agreeing
    trusted = np.unique(node).tolist()
    for count in (1, 2):
        if agreeing or len(trusted) - count < LEAST_NODES:
            break
        # What is left must check itself better than those left out could check it.
        least = LEAST_FREEDOM * count
        choices = list(combinations(trusted, count))
        left = [readings[0][~np.isin(node[readings[0]], culprits)] for culprits in choices]
        if not all(_checked(rest, node, least) for rest in left):
            if count == 1:
                return NoFix("no redundancy", "without the node that lies too little may be left")
            break
        others = [fitted for culprits in choices for fitted in fits(culprits, least)]
        if others and _best(others).acceptable(False):
            agreeing = others
    if agreeing:
        agreeing = [f for f in agreeing if f.cost < min(g.cost for g in agreeing) + REFUTED]
        if _one_place(agreeing):
            return _best(agreeing)
        return NoFix("ambiguous", "which crossings are reflections cannot be told")
    if len(trusted) == LEAST_NODES:
        return NoFix("no redundancy", f"{LEAST_NODES} nodes, and they disagree")
    return NoFix("residuals", "no choice of one or two false nodes leaves the others in agreement")


def _doubled(node: NDArray[np.int64], plane: NDArray[np.int64]) -> tuple[int, ...]:
    """Nodes of which a plane has more than one crossing."""
    pairs, counts = np.unique(2 * node + plane, return_counts=True)
    return tuple(np.unique(pairs[counts > 1] // 2).tolist())


def _best(fits: list[Settled]) -> Settled:
    return min(fits, key=lambda fitted: fitted.cost)


def standing(R: Array, p: Array, covariance: Array, floor: Array) -> float:
    """Chi-square of the base's height over the floor and of its tilt; 0 if it need not stand.

    Nothing of this goes into a pose: it only helps to tell which pose is right.

    Args:
        R, p: of T_world_head, m. Shapes (3, 3), (3,).
        covariance: of shift in world and turn in head axes, m and rad. Shape (6, 6).
        floor: of `consensus.floor_of`. Shape (8,).
    """
    up, lever = floor[:3], floor[3:6]
    if not np.isfinite(floor[7]):
        return 0.0
    r = np.array([p[2] + R[2] @ lever, *(R @ up)[:2]])
    J = np.zeros((3, 6))
    J[0, 2] = 1.0
    J[0, 3:] = -(R @ cross_matrix(lever))[2]
    J[1:, 3:] = -(R @ cross_matrix(up))[:2]
    return float(r @ np.linalg.solve(J @ covariance @ J.T + np.diag(USUAL**2), r))


def _fitted(start, rows, data, covariance: Array, floor: Array) -> Settled | None:
    R, p = start[0].copy(), start[1].copy()
    nodes, sigma_node, node, plane, theta, normals, A, s = data
    _, chi, pose_covariance, blocks = least_squares(
        *(R, p, rows, nodes, sigma_node, node, plane, theta, normals, A, s, covariance),
        ITERATIONS,
    )
    if not (np.isfinite(chi) and upright(R, p, floor, 1.0)):
        return None
    stance = standing(R, p, pose_covariance, floor)
    return Settled(R, p, rows, chi, pose_covariance, blocks, stance)


def _readings(start, data, covariance: Array) -> list[NDArray[np.int64]]:
    """Choices of one crossing for each node and plane, the likeliest first.

    Of several crossings the one nearest to the prediction is meant, but one that is close to it
    might be as well.
    """
    nodes, _, node, plane, theta, normals, A, s = data
    rows, met = np.arange(len(node)), {}
    for row, pair in enumerate((2 * node + plane).tolist()):
        met.setdefault(pair, []).append(row)
    if len(met) == len(rows):
        return [rows]
    r, J = np.empty(len(rows)), np.empty((len(rows), 6))
    linearise(start[0], start[1], rows, nodes, node, plane, theta, normals, A, s, r, J)
    off, options = r.tolist(), []
    for here in met.values():
        first = min(here, key=lambda row: abs(off[row]))
        limit = TWINS * float(covariance[first, first]) ** 0.5
        near = [row for row in here if abs(off[row] - off[first]) < limit]
        options.append(sorted(near, key=lambda row: abs(off[row])))
    return [np.array(choice) for choice in islice(product(*options), MOST_READINGS)]


def _redundancy(rows: NDArray[np.int64], node: NDArray[np.int64]) -> NoFix | None:
    count = len(set(node[rows].tolist()))
    if count < LEAST_NODES or len(rows) < 6 + LEAST_FREEDOM:
        return NoFix("no redundancy", f"{len(rows)} crossings of {count} nodes, wanted 8 of 4")
    return None


def _checked(rest: NDArray[np.int64], node: NDArray[np.int64], least: int) -> bool:
    """Whether what is left without the culprits can contradict itself."""
    return len(rest) - 6 >= least and _redundancy(rest, node) is None


def _one_place(fits: list[Settled]) -> bool:
    """Whether the best one's place is that of all."""
    best = _best(fits)
    return all(other is best or _same_place(best, other) for other in fits)


def _same_place(a: Settled, b: Settled) -> bool:
    sigma = np.sqrt(np.minimum(np.diag(a.covariance), np.diag(b.covariance))[:3])
    return bool(np.all(np.abs(a.p - b.p) < AGREE * sigma))


def _apart(starts):
    """Starts that are not near a better one: four flat nodes may fit in two places."""
    kept = []
    for start in starts:
        R, p, _ = start
        if all(np.abs(p - q).max() > APART or np.abs(R - Q).max() > APART for Q, q, _ in kept):
            kept.append(start)
    return kept[:MOST_STARTS]

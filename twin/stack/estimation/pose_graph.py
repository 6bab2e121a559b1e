"""Poses that agree best with all that was measured between them: pose graph in the plane.

Nodes 0 ... n-1 form a chain, each measured from the one before; further edges close loops, and
nodes may be held in world (anchors). The normal equations are then block-tridiagonal but for a few
loops: the chain is solved in linear time and the loops enter by Woodbury's identity, so nothing of
size n x n is ever built.
"""

from dataclasses import dataclass, field

import numpy as np

from twin.geometry import Array, between2, compose2, rot2, wrap_angle


@dataclass(frozen=True)
class Edge:
    """Pose of node `to` measured in node `start`, with its covariance."""

    start: int
    to: int
    pose: Array  # (3,) x, y, yaw
    covariance: Array  # (3, 3), in the axes of `start`


@dataclass
class PoseGraph:
    """Chain with loop closures.

    Args:
        first: pose of node 0 in world.
        first_sigma: its standard deviations, m, m, rad.
    """

    first: Array
    first_sigma: Array
    poses: list[Array] = field(default_factory=list)  # of the nodes, in world
    chain: list[Edge] = field(default_factory=list)  # edge i leads from node i to i + 1
    loops: list[Edge] = field(default_factory=list)
    # Nodes whose pose in world was measured by itself: number, pose, covariance in world axes.
    anchors: list[tuple[int, Array, Array]] = field(default_factory=list)

    def __post_init__(self):
        self.first = np.array(self.first, dtype=float)
        self.first_sigma = np.array(self.first_sigma, dtype=float)
        self.poses = self.poses or [self.first.copy()]

    def append(self, pose: Array, covariance: Array) -> int:
        """Add a node measured from the last one; returns its number."""
        n = len(self.poses)
        self.chain.append(Edge(n - 1, n, np.array(pose, dtype=float), np.array(covariance)))
        self.poses.append(compose2(self.poses[-1], pose))
        return n

    def close(self, edge: Edge, gate: float = 16.27) -> bool:
        """Add a loop closure, unless the chain contradicts it.

        Args:
            edge: the measurement.
            gate: squared Mahalanobis distance from what the chain believes; chi-square, three
                degrees of freedom, 99.9 %.

        Returns:
            False if it lies outside the gate; it is then left out.

        Raises:
            ValueError: for nodes that do not exist or a measurement that is not finite.
        """
        n = len(self.poses)
        if not (0 <= edge.start < n and 0 <= edge.to < n and edge.start != edge.to):
            raise ValueError(f"loop {edge.start} -> {edge.to}: nodes are 0 to {n - 1}")
        if not (np.all(np.isfinite(edge.pose)) and np.all(np.isfinite(edge.covariance))):
            raise ValueError(f"loop {edge.start} -> {edge.to}: measurement is not finite")
        e = edge_error(edge, self.poses)
        S = edge.covariance + self.chain_covariance(edge.start, edge.to)
        if e @ np.linalg.solve(S, e) > gate:
            return False
        self.loops.append(edge)
        return True

    def chain_covariance(self, start: int, to: int) -> Array:
        """Of the pose of `to` in `start` by the chain alone. Shape (3, 3).

        Each link adds its own covariance, and its turn swings all that comes after it.
        """
        low, high = min(start, to), max(start, to)
        total, origin = np.zeros((3, 3)), self.poses[start]
        end = between2(origin, self.poses[to])
        for edge in self.chain[low:high]:
            node = between2(origin, self.poses[edge.start])
            G = np.eye(3)
            G[:2, :2] = rot2(node[2])
            arm = end[:2] - between2(origin, self.poses[edge.to])[:2]
            if start > to:  # the far end is the earlier one
                arm = end[:2] - node[:2]
            G[:2, 2] = -arm[1], arm[0]
            total += G @ edge.covariance @ G.T
        return total

    def optimise(self, iterations: int = 15) -> float:
        """Gauss-Newton over all nodes, at most that many times.

        Returns:
            Root of the mean squared normalised error of the loops; 0 without loops.
        """
        for _ in range(iterations):
            step = self._step()
            self.poses = [
                np.array([*(p[:2] + d[:2]), wrap_angle(p[2] + d[2])])
                for p, d in zip(self.poses, step, strict=True)
            ]
            if np.max(np.abs(step)) < 1e-7:
                break
        if not self.loops:
            return 0.0
        squares = [e @ np.linalg.solve(loop.covariance, e) for loop, e in self._loop_errors()]
        return float(np.sqrt(np.mean(squares)))

    def settle(self, gate: float = 16.27) -> bool:
        """Optimise with the newest loop, and leave it out if the rest must bend too far for it.

        A chain that has drifted far lets a wrong loop pass its own gate; a chain that other loops
        hold does not.

        Args:
            gate: rise of the sum of all squared normalised errors that one true loop may cause;
                chi-square, three degrees of freedom, 99.9 %.

        Returns:
            False if the newest loop was taken out again; the poses are then as before.
        """
        before, newest = [pose.copy() for pose in self.poses], self.loops.pop()
        self.optimise()
        cost = self.cost()
        self.loops.append(newest)
        self.optimise()
        if self.cost() - cost <= gate:
            return True
        self.loops.pop()
        self.poses = before
        return False

    def cost(self) -> float:
        """Sum of the squared normalised errors of prior, anchors, chain and loops."""
        total = 0.0
        for _, offset, W in self._held():
            total += float(offset @ W @ offset)
        for edge in self.chain + self.loops:
            e = edge_error(edge, self.poses)
            total += float(e @ np.linalg.solve(edge.covariance, e))
        return total

    def anchor(self, node: int, pose: Array, covariance: Array) -> None:
        """Hold a node where it was measured in world, as far as its covariance says."""
        self.anchors.append((node, np.array(pose, dtype=float), np.array(covariance)))

    def _held(self):
        """Node, believed less measured pose, and information of the prior and the anchors."""
        prior = (0, self.first, np.diag(self.first_sigma**2.0))
        for node, pose, covariance in (prior, *self.anchors):
            offset = self.poses[node] - pose
            offset[2] = wrap_angle(offset[2])
            yield node, offset, np.linalg.inv(covariance)

    def _loop_errors(self):
        return [(loop, edge_error(loop, self.poses)) for loop in self.loops]

    def _step(self) -> Array:
        """Change of the nodes. Shape (n, 3)."""
        n = len(self.poses)
        diagonal, below = np.zeros((n, 3, 3)), np.zeros((max(n - 1, 0), 3, 3))
        gradient = np.zeros((n, 3))
        for node, offset, W in self._held():
            diagonal[node] += W
            gradient[node] += W @ offset
        for edge in self.chain:
            e, A, B = edge_error(edge, self.poses), *edge_jacobians(edge, self.poses)
            W = np.linalg.inv(edge.covariance)
            i, j = edge.start, edge.to
            diagonal[i] += A.T @ W @ A
            diagonal[j] += B.T @ W @ B
            below[i] += B.T @ W @ A
            gradient[i] += A.T @ W @ e
            gradient[j] += B.T @ W @ e
        # H = T + U U^T, where each loop gives U three columns.
        U = np.zeros((n, 3, 3 * len(self.loops)))
        for k, (edge, e) in enumerate(self._loop_errors()):
            A, B = edge_jacobians(edge, self.poses)
            L = np.linalg.cholesky(np.linalg.inv(edge.covariance))
            columns = slice(3 * k, 3 * k + 3)
            U[edge.start, :, columns] += A.T @ L
            U[edge.to, :, columns] += B.T @ L
            gradient[edge.start] += A.T @ L @ (L.T @ e)
            gradient[edge.to] += B.T @ L @ (L.T @ e)
        solved = _solve_chain(diagonal, below, np.concatenate([gradient[:, :, None], U], axis=2))
        x, V = solved[:, :, 0], solved[:, :, 1:]
        if self.loops:
            flat_U, flat_V = U.reshape(3 * n, -1), V.reshape(3 * n, -1)
            small = np.eye(flat_U.shape[1]) + flat_U.T @ flat_V
            x = x - (flat_V @ np.linalg.solve(small, flat_U.T @ x.reshape(-1))).reshape(n, 3)
        return -x


def edge_error(edge: Edge, poses: list[Array]) -> Array:
    """Believed minus measured pose of `to` in `start`. Shape (3,)."""
    error = between2(poses[edge.start], poses[edge.to]) - edge.pose
    error[2] = wrap_angle(error[2])
    return error


def edge_jacobians(edge: Edge, poses: list[Array]) -> tuple[Array, Array]:
    """Derivatives of the error by the poses of `start` and `to`. Shapes (3, 3)."""
    a, b = poses[edge.start], poses[edge.to]
    R = rot2(a[2]).T
    A, B = np.zeros((3, 3)), np.zeros((3, 3))
    A[:2, :2], B[:2, :2] = -R, R
    x, y = R @ (b[:2] - a[:2])
    A[:2, 2] = y, -x
    A[2, 2], B[2, 2] = -1.0, 1.0
    return A, B


def _solve_chain(diagonal: Array, below: Array, right: Array) -> Array:
    """Solve a symmetric block-tridiagonal system by block elimination.

    Args:
        diagonal: shape (n, 3, 3).
        below: block (i + 1, i). Shape (n - 1, 3, 3).
        right: right-hand sides. Shape (n, 3, m).
    """
    n = len(diagonal)
    pivot, y = diagonal.copy(), right.copy()
    for i in range(1, n):
        factor = np.linalg.solve(pivot[i - 1], below[i - 1].T).T
        pivot[i] -= factor @ below[i - 1].T
        y[i] -= factor @ y[i - 1]
    x = np.empty_like(y)
    x[n - 1] = np.linalg.solve(pivot[n - 1], y[n - 1])
    for i in range(n - 2, -1, -1):
        x[i] = np.linalg.solve(pivot[i], y[i] - below[i].T @ x[i + 1])
    return x

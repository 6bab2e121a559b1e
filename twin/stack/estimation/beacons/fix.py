"""Raw stamps in, 6-DoF pose of the vehicle with its covariance out, or a named reason why not.

`Locator.fix` is our estimator: clocks by a line, all visible nodes at once, each crossing at its
own instant, outliers rejected, never without redundancy. `Locator.source_fix` is the method of
Liu et al. 2022 beside it: neighbouring pulses, three nodes in closed form and a fourth to choose.
Its Eq. 3 takes the speed of the revolution before; a batch of the plant holds one revolution and
the stack keeps none, so what runs there is the speed of the revolution itself.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array, apply, inverse, transform
from twin.stack.estimation.beacons.angles import (
    TAU,
    Crossings,
    measure,
    normal_derivatives,
    normals,
    rays,
    rotation_angle,
)
from twin.stack.estimation.beacons.clocks import GOOD, Aligned, align, spin
from twin.stack.estimation.beacons.consensus import find_poses, floor_of
from twin.stack.estimation.beacons.p3p import (
    DANGER,
    conditioning,
    p3p,
    triple_fault,
    virtual_plane_error,
)
from twin.stack.estimation.beacons.refine import (
    ITERATIONS,
    by_planes,
    head_twist,
    least_squares,
    motion,
    pose_by_angles,
)
from twin.stack.estimation.beacons.rigid import cross_matrix, rigid_fit
from twin.stack.estimation.beacons.settle import Settled, settle
from twin.stack.estimation.beacons.stamps import (
    PLANE_1,
    PLANE_2,
    T0,
    Counter,
    HeadParameters,
    NodeSurvey,
    NoFix,
    Noise,
    Reason,
    StampBatch,
    SyncSequence,
)

STILL = 1e-6  # m/s and rad/s below which a revolution needs no correction for motion


@dataclass(frozen=True)
class Fix:
    """Pose of the vehicle from one revolution.

    Attributes:
        T_world_base: in the middle of the revolution. Shape (4, 4).
        covariance: shift in world axes, m, then turn in base axes, rad. Shape (6, 6).
        common: the part of it that is the calibration's, an error of all fixes alike. Shape (6, 6).
        time: of that instant, s of the synchronising sequence (see `clocks`).
        T_world_head: the same of the head. Shape (4, 4).
        head_covariance: the same for the head, turn in head axes. Shape (6, 6).
        used: (node, plane 1 or 2) of the crossings in the fix.
        rejected: those that contradicted it: reflections.
        chi_square, freedom: of the residuals.
    """

    T_world_base: Array
    covariance: Array
    common: Array
    time: float
    T_world_head: Array
    head_covariance: Array
    used: tuple[tuple[str, int], ...]
    rejected: tuple[tuple[str, int], ...]
    chi_square: float
    freedom: int


@dataclass(frozen=True)
class Locator:
    """Estimator for one head and one network.

    Attributes:
        survey: of the nodes.
        head: angles of the planes, nominal or calibrated.
        T_base_head: mount of the head. Shape (4, 4).
        head_covariance: of `head` (rad) and of the mount's shift in base (m) and turn in head axes
            (rad), with what they have in common: errors of all fixes alike. Shape (9, 9).
        sequence, counter, noise: of the network.
        spin_rate: nominal turns per second, within a few percent.
        loosest: standard deviation of the position, along the worst axis, that is still a fix, m.
        height, tilt: of the base over the level floor z = 0 at most, m and rad; inf if unknown.
    """

    survey: NodeSurvey
    head: HeadParameters = field(default_factory=HeadParameters)
    T_base_head: Array = field(default_factory=lambda: np.eye(4))
    head_covariance: Array = field(default_factory=lambda: np.zeros((9, 9)))
    sequence: SyncSequence = field(default_factory=SyncSequence)
    counter: Counter = field(default_factory=Counter)
    noise: Noise = field(default_factory=Noise)
    spin_rate: float = 30.0
    loosest: float = 0.03
    height: float = float("inf")
    tilt: float = float("inf")

    @cached_property
    def _planes(self) -> tuple[Array, Array]:
        """Normals, and their derivatives by the angles, planes first. Shapes (2, 3), (2, 3, 3)."""
        derivatives = np.ascontiguousarray(normal_derivatives(self.head).transpose(1, 0, 2))
        return normals(self.head), derivatives

    @cached_property
    def _floor(self) -> Array:
        return floor_of(self.T_base_head, self.height, self.tilt)

    @cached_property
    def _T_head_base(self) -> Array:
        return inverse(self.T_base_head)

    @cached_property
    def _by_mount(self) -> Array:
        return base_from_mount(self.T_base_head)

    def crossings(self, stamps: StampBatch) -> tuple[Crossings, float] | NoFix:
        """Angles of the last whole revolution, and the time of its middle."""
        if fault := self._names_fault(stamps):
            return fault
        aligned = align(stamps, self.sequence, self.counter, self.noise)
        if isinstance(aligned, NoFix):
            return aligned
        if fault := _disorder(stamps, aligned):
            return fault
        turn = spin(stamps, aligned, self.spin_rate, self.counter, self.noise)
        if isinstance(turn, NoFix):
            return turn
        found = measure(stamps, aligned, turn, self.counter, self.noise)
        return found, turn.start + 0.5 * turn.length

    def fix(self, stamps: StampBatch, body_twist: Array | None = None) -> Fix | NoFix:
        """Pose from all nodes.

        Args:
            stamps: a batch that holds a whole revolution.
            body_twist: of the base in its own axes during it: velocity (m/s), rate of turn
                (rad/s), from the vehicle's filter. Shape (6,). Standing if none is given.
        """
        measured = self.crossings(stamps)
        if isinstance(measured, NoFix):
            return measured
        twist = np.zeros(6) if body_twist is None else np.asarray(body_twist, dtype=float)
        if twist.shape != (6,) or not np.all(np.isfinite(twist)):
            return NoFix("malformed stamps", "the twist is not six finite numbers")
        return self.solve(measured[0], measured[1], stamps.nodes, twist)

    def solve(
        self, seen: Crossings, time: float, names: tuple[str, ...], body_twist: Array
    ) -> Fix | NoFix:
        """Pose from measured crossings; see `fix`."""
        listed = np.array([self.survey.index[name] for name in names], dtype=np.int64)
        nodes = np.ascontiguousarray(self.survey.p_world[listed], dtype=np.float64)
        sigma_node = np.asarray(self.survey.sigma, dtype=np.float64)[listed]
        twist = head_twist(body_twist, self.T_base_head)
        A, s = motion(twist, seen.time)
        still = bool(np.abs(twist).max() < STILL)
        data = nodes, sigma_node, seen.node, seen.plane, seen.theta, self._planes[0], A, s
        floor = self._floor
        R, p, cost, _, found, visible, triples = find_poses(*data, seen.covariance, still, floor)
        if visible < 3:
            return NoFix("few nodes", f"{visible} nodes with both planes, wanted 4")
        if not triples:
            return NoFix("collinear nodes", f"no three of {visible} nodes off a line")
        if visible < 4:
            return NoFix("no redundancy", "3 nodes fit any pose that they propose, wanted 4")
        if not found:
            return NoFix("no solution", f"no pose agrees with more than three of {visible} nodes")
        start = [(R[k], p[k], cost[k]) for k in range(found)]
        at = R[0], p[0], nodes, seen.node, seen.plane, seen.theta
        D = by_planes(*at, *self._planes, A, s)  # hardly another one at the other starts
        planes = self.head_covariance[:3, :3]
        whole = seen.covariance + D @ planes @ D.T
        settled = settle(start, data, whole, floor)
        if isinstance(settled, NoFix):
            return settled
        rows, chi, covariance = settled.rows, settled.chi_square, settled.covariance
        sigma = float(np.linalg.eigvalsh(covariance[:3, :3])[-1]) ** 0.5
        if not sigma < self.loosest:
            return self._loose(settled, nodes[np.unique(seen.node[rows])], sigma)
        T_world_head = transform(settled.R, settled.p)
        T_head_base = self._T_head_base
        T_world_base = T_world_head @ T_head_base
        gain = pose_by_angles(settled.R, settled.p, rows, *data, whole, covariance)
        shifts = -gain @ D[rows]
        J = base_from_head(T_world_head, T_head_base)
        by_head = np.empty((6, 9))
        by_head[:, :3], by_head[:3, 3:] = J @ shifts, T_world_base[:3, :3] @ self._by_mount[:3]
        by_head[3:, 3:] = self._by_mount[3:]
        common = by_head @ self.head_covariance @ by_head.T
        own = covariance - shifts @ planes @ shifts.T
        label = [(names[n], int(k) + 1) for n, k in zip(seen.node, seen.plane, strict=True)]
        used = set(rows.tolist())
        return Fix(
            T_world_base,
            J @ own @ J.T + common,
            common,
            time,
            T_world_head,
            covariance,
            tuple(label[i] for i in rows),
            tuple(label[i] for i in range(len(label)) if i not in used),
            chi,
            len(rows) - 6,
        )

    def refined(
        self, seen: Crossings, R: Array, p: Array, rows: NDArray[np.int64]
    ) -> tuple[Array, Array, Array]:
        """The head's pose at rest by crossings that are to be trusted, near a given one.

        Args:
            seen: node i is the survey's i-th.
            R, p: of T_world_head, about. Shapes (3, 3), (3,).
            rows: the crossings.

        Returns:
            T_world_head (4, 4), its covariance with the planes as known (6, 6), and its derivative
            by what is believed of the planes (6, 3).
        """
        nodes = np.ascontiguousarray(self.survey.p_world, dtype=np.float64)
        sigma = np.asarray(self.survey.sigma, dtype=np.float64)
        A, s = motion(np.zeros(6), seen.time)
        R, p, n = R.copy(), p.copy(), self._planes[0]
        data = nodes, sigma, seen.node, seen.plane, seen.theta, n, A, s
        _, _, covariance, _ = least_squares(R, p, rows, *data, seen.covariance, ITERATIONS)
        D = by_planes(R, p, nodes, seen.node, seen.plane, seen.theta, *self._planes, A, s)
        gain = pose_by_angles(R, p, rows, *data, seen.covariance, covariance)
        return transform(R, p), covariance, -gain @ D[rows]

    def _loose(self, settled: Settled, nodes: Array, sigma: float) -> NoFix:
        """Why the position is loose: the head near the cylinder through the nodes, or not."""
        triples = [nodes[k : k + 3] for k in range(len(nodes) - 2)]
        best = max(conditioning((three - settled.p) @ settled.R) for three in triples)
        reason: Reason = "danger cylinder" if best < DANGER else "loose geometry"
        return NoFix(reason, f"position known to {sigma:.3f} m, wanted {self.loosest} m")

    def source_fix(self, stamps: StampBatch, four: tuple[str, str, str, str]) -> Array | NoFix:
        """`T_world_head` by the source's method: three nodes, and a fourth to choose. (4, 4).

        Angles by Eqs. 2 and 3 with the speed of the revolution before; where the batch holds but
        one revolution, as the plant's do, by its own.
        """
        if fault := self._names_fault(stamps) or self._four_fault(stamps, four):
            return fault
        aligned = align(stamps, self.sequence, self.counter, self.noise, interpolate=True)
        if isinstance(aligned, NoFix):
            return aligned
        if fault := _disorder(stamps, aligned):
            return fault
        if aligned.status[T0] != GOOD:
            return NoFix("no reference", "T0's clock cannot be aligned to the synchronising light")
        zeros = aligned.time[(stamps.channel == T0) & (stamps.kind == PLANE_1)]
        if len(zeros) < 2 or not np.all(np.abs(np.diff(zeros) * self.spin_rate - 1.0) < 0.05):
            return NoFix("no reference", f"T0 saw plane 1 {len(zeros)} times, no whole revolution")
        start, before = (zeros[-2], zeros[-3]) if len(zeros) > 2 else (zeros[-2], None)
        before = 2 * zeros[-2] - zeros[-1] if before is None else before
        theta = np.full((4, 2), np.nan)
        for i, name in enumerate(four):
            channel = stamps.nodes.index(name) + 1
            for j, kind in enumerate((PLANE_1, PLANE_2)):
                times = aligned.time[(stamps.channel == channel) & (stamps.kind == kind)]
                times = times[(times >= start) & (times < zeros[-1])]
                if len(times):
                    theta[i, j] = rotation_angle(times[0], start, before) % TAU
        if not np.all(np.isfinite(theta)):
            return NoFix("few nodes", "one of the four nodes missed a plane")
        nodes = self.survey.p_world[[self.survey.index[name] for name in four]]
        if fault := triple_fault(nodes[:3]):
            return fault
        directions = rays(theta[:, 0], theta[:, 1], self.head)
        T_head_world, psi = np.eye(4), np.inf
        for d in p3p(directions[:3], nodes[:3]).distances[0]:
            if np.isfinite(d).all():
                T = rigid_fit(nodes[:3], d[:, None] * directions[:3])  # Eqs. 14, 17-22
                error = virtual_plane_error(directions[3], apply(T, nodes[3]))  # Eqs. 23-26
                if error < psi:
                    T_head_world, psi = T, error
        if not np.isfinite(psi):
            return NoFix("no solution", "no pose with the fourth node ahead")
        if conditioning(apply(T_head_world, nodes[:3])) < DANGER:
            return NoFix("danger cylinder", "the head stands on the cylinder through three nodes")
        return inverse(T_head_world)  # Eqs. 27, 28

    def _names_fault(self, stamps: StampBatch) -> NoFix | None:
        unknown = [name for name in stamps.nodes if name not in self.survey.index]
        if unknown:
            known = ", ".join(self.survey.names)
            return NoFix("unknown node", f"{unknown[0]} is not in the survey; it has {known}")
        if len(set(stamps.nodes)) < len(stamps.nodes):
            return NoFix("malformed stamps", "a node stands in the batch twice")
        return None

    def _four_fault(self, stamps: StampBatch, four: tuple[str, ...]) -> NoFix | None:
        for name in four:
            if name not in self.survey.index:
                return NoFix("unknown node", f"{name} is not in the survey")
            if name not in stamps.nodes:
                return NoFix("few nodes", f"{name} sent nothing")
        if len(set(four)) < 4:
            return NoFix("few nodes", "the four nodes must differ")
        return None


def base_from_head(T_world_head: Array, T_head_base: Array) -> Array:
    """Derivative of the base's small error by the head's, see `refine`. Shape (6, 6)."""
    R, lever = T_world_head[:3, :3], T_head_base[:3, 3]
    J = np.eye(6)
    J[:3, 3:] = -R @ cross_matrix(lever)
    J[3:, 3:] = T_head_base[:3, :3].T
    return J


def base_from_mount(T_base_head: Array) -> Array:
    """Derivative of the base's small error in its own axes by the mount's. Shape (6, 6)."""
    J = -np.eye(6)
    J[3:, 3:] = -T_base_head[:3, :3]
    J[:3, 3:] = cross_matrix(T_base_head[:3, 3]) @ J[3:, 3:]
    return J


def _disorder(stamps: StampBatch, aligned: Aligned) -> NoFix | None:
    """A channel that counts backwards spoils the batch: something is wrong with its order."""
    if np.any(aligned.status == 1):
        bad = int(np.nonzero(aligned.status == 1)[0][0])
        name = "T0" if bad == T0 else stamps.nodes[bad - 1]
        return NoFix("stamps out of order", f"{name} counts backwards")
    return None

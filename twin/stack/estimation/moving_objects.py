"""What moves among what the lidar sees off the map: clusters followed at constant velocity.

Scan points are cut into clusters where neighbouring beams jump; a Kalman filter follows each. A
cluster's middle wanders as the vehicle sees another side of it, so an object counts as moving only
when it is fast enough and has come some way.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array

POSITION, VELOCITY = slice(0, 2), slice(2, 4)  # m, m/s in world


@dataclass(frozen=True)
class MovingOptions:
    """Not tuned, but where a reason is given."""

    gap: float = 0.25  # m between neighbouring points that belong together
    fewest: int = 4  # points of a cluster
    longest: float = 1.6  # m: larger ones are no carts
    gate: float = 0.5  # m from where it is expected: 0.1 s of 2 m/s and the middle's wander
    noise: float = 0.04  # m, 1 sigma of a cluster's middle
    push: float = 0.5  # m/s^2, 1 sigma of an object's acceleration
    start_speed: float = 1.0  # m/s, 1 sigma at birth
    speed: float = 0.15  # m/s from which it moves
    way: float = 0.20  # m that it must have come
    hits: int = 4  # scans that must have seen it
    rest: float = 0.06  # m/s below which it has stopped
    memory: float = 1.0  # s for which one that should be seen is expected to go on
    unseen: float = 4.0  # s likewise where the lidar does not look
    deep: float = 0.40  # m at least that it reaches behind what is seen of it; a cart's width
    margin: float = 0.08  # m by which it is taken larger
    late: float = 0.25  # s of its way by which it is taken larger: speed and place are estimates
    resume: float = 20.0  # s for which one that has stopped, or is lost from sight, may go on
    about: float = 2.0  # s after its last move within which it may just be turning about
    braking: float = 0.15  # m that it needs to stop before a vehicle that stands
    lane: float = 4.0  # s of its way that others had better leave free


@dataclass
class MovingObject:
    """A cluster that is followed."""

    mean: Array  # (4,)
    covariance: Array  # (4, 4)
    stamp: float  # of the mean
    born: Array  # (2,) where it was first seen
    points: Array = field(default_factory=lambda: np.zeros((0, 2)))  # last seen, about the middle
    hits: int = 1
    seen: float = 0.0  # s, when last
    moves: bool = False
    last_way: Array = field(default_factory=lambda: np.zeros(2))  # velocity when it last moved
    last_moved: float = -np.inf  # s
    top: float = 0.0  # m/s, fastest that it was

    @property
    def speed(self) -> float:
        return float(np.hypot(*self.mean[VELOCITY]))

    def predict(self, stamp: float, push: float) -> None:
        """Go on to a later time."""
        dt = stamp - self.stamp
        if dt <= 0:
            return
        F = np.eye(4)
        F[0, 2] = F[1, 3] = dt
        G = np.array([0.5 * dt * dt, dt])
        Q = push**2 * np.kron(np.outer(G, G), np.eye(2))
        self.mean = F @ self.mean
        self.covariance = F @ self.covariance @ F.T + Q
        self.stamp = stamp

    def update(self, middle: Array, noise: float) -> None:
        """Take a middle that was measured at `stamp`."""
        S = self.covariance[POSITION, POSITION] + noise**2 * np.eye(2)
        K = np.linalg.solve(S, self.covariance[POSITION]).T
        self.mean = self.mean + K @ (middle - self.mean[POSITION])
        self.covariance = self.covariance - K @ self.covariance[POSITION]

    def row(self, now: float, options: MovingOptions) -> Array:
        """Capsule about the whole of it, a row as in `planning.clearance`. Shape (7,)."""
        centre = self.mean[POSITION] + self.mean[VELOCITY] * (now - self.stamp)
        axis = np.linalg.eigh(self.points.T @ self.points + 1e-9 * np.eye(2))[1][:, 1]
        along, across = self.points @ axis, self.points @ np.array([-axis[1], axis[0]])
        half = max(float(np.ptp(along)), options.deep) / 2
        radius = max(float(np.ptp(across)), options.deep) / 2
        reach = max(half - 0.7 * radius, 0.0) * axis
        radius += options.margin + options.late * self.speed
        return np.array([*(centre - reach), *(centre + reach), radius, *self.mean[VELOCITY]])


def clusters(points: Array, gap: float, fewest: int) -> list[Array]:
    """Points (n, 2) in the beams' order, cut where neighbours are farther than `gap` apart."""
    if len(points) < fewest:
        return []
    cuts = np.nonzero(np.hypot(*np.diff(points, axis=0).T) > gap)[0] + 1
    return [part for part in np.split(points, cuts) if len(part) >= fewest]


def _middle(points: Array, eye: Array | None, deep: float) -> Array:
    """Middle of a thing of which the side towards the eye is seen. Shape (2,)."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    if eye is None:
        return middle
    away = (middle - eye) / max(float(np.hypot(*(middle - eye))), 1e-6)
    return middle + 0.5 * max(deep - float(np.ptp(points @ away)), 0.0) * away


class MovingObjects:
    """Follows what stands off the map.

    Args:
        options: of clusters and filter.
    """

    def __init__(self, options: MovingOptions | None = None):
        self.options = options or MovingOptions()
        self.objects: list[MovingObject] = []
        # Of those that were lost from sight while they moved: where they were first seen, where
        # they ought to be by then, and when they were given up.
        self._lost: list[tuple[Array, Array, float]] = []

    def update(
        self,
        stamp: float,
        points: Array,
        eye: Array | None = None,
        in_view: Callable[[Array], bool] = lambda xy: True,
        at_edge: NDArray[np.bool_] | None = None,
    ) -> None:
        """Take the points of a scan that lie off the map.

        Args:
            stamp: of the scan, s.
            points: in world, in the beams' order. Shape (n, 2).
            eye: x, y of the lidar in world; things are deeper than what is seen of them.
            in_view: whether the lidar looks at a point in world.
            at_edge: which points lie at the edge of its field of view. Shape (n,).
        """
        o = self.options
        for each in self.objects:
            each.predict(stamp, o.push)
        seen = [c for c in clusters(points, o.gap, o.fewest) if np.ptp(c, axis=0).max() < o.longest]
        middles = np.array([_middle(c, eye, o.deep) for c in seen]).reshape(-1, 2)
        free = set(range(len(seen)))
        # Of what leaves the view a part is seen, whose middle goes another way.
        edge = points[at_edge] if at_edge is not None else points[:0]
        cut = {j for j in free if any((seen[j] == p).all(axis=1).any() for p in edge)}
        if self.objects and seen:
            places = np.array([each.mean[POSITION] for each in self.objects])
            far = np.hypot(*(places[:, None] - middles[None]).transpose(2, 0, 1))
            for flat in np.argsort(far, axis=None):
                i, j = divmod(int(flat), len(seen))
                if far[i, j] > o.gate:
                    break
                each = self.objects[i]
                if j not in free or each.seen == stamp:
                    continue
                free.discard(j)
                if j in cut:
                    each.seen = stamp
                    continue
                each.update(middles[j], o.noise)
                each.points, each.seen = seen[j] - seen[j].mean(axis=0), stamp
                each.hits += 1
                self._judge(each)
        start = np.diag([o.noise**2] * 2 + [o.start_speed**2] * 2)
        for j in sorted(free - cut):
            mean = np.array([*middles[j], 0.0, 0.0])
            self.objects.append(
                MovingObject(
                    mean, start.copy(), stamp, middles[j], seen[j] - seen[j].mean(axis=0), 1, stamp
                )
            )
        self._lost = [way for way in self._lost if stamp - way[2] < o.resume]
        followed, self.objects = self.objects, []
        for each in followed:
            if stamp - each.seen <= self._memory(each, in_view):
                self.objects.append(each)
            elif each.moves:
                self._lost.append((each.born, each.mean[POSITION].copy(), stamp))

    def _memory(self, each: MovingObject, in_view: Callable[[Array], bool]) -> float:
        o = self.options
        if each.hits < o.hits:
            return 0.35 * o.memory
        return o.unseen if each.moves and not in_view(each.mean[POSITION]) else o.memory

    def _judge(self, each: MovingObject) -> None:
        o = self.options
        if each.moves:
            if each.speed > o.speed:
                each.last_way, each.last_moved = each.mean[VELOCITY].copy(), each.stamp
                each.top = max(each.top, each.speed)
            if each.speed < o.rest:
                each.moves, each.born = False, each.mean[POSITION].copy()
            return
        sigma = float(np.sqrt(0.5 * np.trace(each.covariance[VELOCITY, VELOCITY])))
        come = float(np.hypot(*(each.mean[POSITION] - each.born)))
        each.moves = each.hits >= o.hits and each.speed > max(o.speed, 2 * sigma) and come > o.way

    def obstacles(self, now: float) -> Array:
        """Those that move, rows as in `planning.clearance`, where they are now. Shape (n, 7)."""
        rows = [each.row(now, self.options) for each in self.objects if each.moves]
        return np.array(rows).reshape(-1, 7)

    def lanes(self, now: float) -> list[tuple[Array, Array, float]]:
        """Where what moves, or has stopped lately, will go: from, to in world, half width, m.

        What was lost from sight lately may be anywhere on the way that it was seen going.
        """
        o = self.options
        half = 0.5 * o.deep + o.margin
        out = [(a, b, half) for a, b, when in self._lost if now - when < o.resume]
        for each in self.objects:
            if each.moves or now - each.last_moved < o.resume:
                way = each.mean[VELOCITY] if each.moves else each.last_way
                start = each.mean[POSITION] + each.mean[VELOCITY] * (now - each.stamp)
                out.append((start, start + o.lane * way, half))
        return out

    def threats(self, now: float, time: float) -> Array:
        """Where what moves may be after some time, should it turn about: it stands, but larger.

        Args:
            now: s.
            time: s that it has to go wherever it likes.

        Returns:
            Rows as in `planning.clearance`, without velocity. Shape (n, 7).
        """
        rows = []
        for each in self.objects:
            if each.moves or now - each.last_moved < self.options.about:
                row = each.row(now, self.options)
                row[4] += max(each.top, each.speed) * time + self.options.braking
                row[5:] = 0.0
                rows.append(row)
        return np.array(rows).reshape(-1, 7)

    def near_moving(self, stamp: float, points: Array, margin: float) -> NDArray[np.bool_]:
        """Which of points (n, 2) in world belong to something that moves. Shape (n,), bool."""
        out = np.zeros(len(points), dtype=bool)
        for each in self.objects:
            if each.moves and len(points):
                centre = each.mean[POSITION] + each.mean[VELOCITY] * (stamp - each.stamp)
                reach = max(float(np.hypot(*each.points.T).max()), 0.5 * self.options.deep) + margin
                out |= np.hypot(*(points - centre).T) < reach
        return out

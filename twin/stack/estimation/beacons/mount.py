"""Mount of the scanning head on the vehicle's base, from stops between which odometry is known.

Not in the source, which measures the mount by hand. The network gives the head's pose in world at
every stop, wheels the planar way from stop to stop; the floor is level, so the base has no height
and no tilt. Tilt and height of the mount show at a single stop, its x and y only when the vehicle
turns, its yaw only when it drives.
"""

from dataclasses import dataclass

import numpy as np

from twin.geometry import Array, between2, inverse, rot_z, transform, wrap_angle
from twin.stack.estimation.beacons.rigid import exp_rotation, log_rotation

ITERATIONS = 30
AXES = ("shift x", "shift y", "shift z", "turn about x", "turn about y", "turn about z")
LOOSEST = np.array([0.005] * 3 + [0.005] * 3)  # m and rad that a result may be uncertain by


@dataclass(frozen=True)
class Stop:
    """The head's pose at a stop, and the way there.

    Attributes:
        T_world_head: from a fix. Shape (4, 4).
        covariance: shift in world axes (m), turn in head axes (rad). Shape (6, 6).
        way: planar pose of the base in the base at the stop before, by odometry (x, y, yaw);
            nothing at the first stop. Shape (3,).
        way_covariance: of it. Shape (3, 3).
    """

    T_world_head: Array
    covariance: Array
    way: Array | None = None
    way_covariance: Array | None = None


@dataclass(frozen=True)
class Mount:
    """Result.

    Attributes:
        T_base_head: shape (4, 4).
        covariance: of its shift in base (m) and turn in head axes (rad). Shape (6, 6).
        by_stops: derivative of that error by those of the k stops' poses. Shape (6, 6 k).
        cost: in sigmas squared.
        freedom: how many residuals exceed the unknowns.
    """

    T_base_head: Array
    covariance: Array
    by_stops: Array
    cost: float
    freedom: int


def calibrate_mount(stops: list[Stop], start: Array) -> Mount:
    """Least squares over the mount and the planar base pose at each stop, by Gauss-Newton.

    Args:
        stops: in the order of the drive.
        start: `T_base_head` on the drawing, right within a few tenths of a radian. Shape (4, 4).

    Raises:
        ValueError: fewer than three stops, or a part of the mount that they leave undetermined.
    """
    if len(stops) < 3:
        raise ValueError(f"mount: {len(stops)} stops, wanted 3")
    for i, stop in enumerate(stops):
        parts = [stop.T_world_head, stop.covariance]
        if i:
            if stop.way is None or stop.way_covariance is None:
                raise ValueError(f"mount: stop {i} lacks the way from the stop before")
            parts += [stop.way, stop.way_covariance]
        if not all(np.all(np.isfinite(part)) for part in parts):
            raise ValueError(f"mount: stop {i} is not finite")
    T = np.array(start, dtype=float)
    bases = np.array([_planar(stop.T_world_head @ inverse(T)) for stop in stops])
    cost, N = np.inf, np.eye(6)
    for _ in range(ITERATIONS):
        r, J = _linearised(stops, T, bases)
        N, before, cost = J.T @ J, cost, float(r @ r)
        step = np.asarray(np.linalg.lstsq(J, r, rcond=1e-12)[0], dtype=np.float64)
        T = transform(T[:3, :3] @ exp_rotation(step[3:6]), T[:3, 3] + step[:3])
        bases = bases + step[6:].reshape(-1, 3)
        if np.abs(step).max() < 1e-10 or abs(before - cost) < 1e-12 * (1.0 + cost):
            break
    values, vectors = np.linalg.eigh(N)
    inverted = (vectors / np.maximum(values, 1e-9)) @ vectors.T
    covariance = inverted[:6, :6]
    sigma = np.sqrt(np.diag(covariance))
    if np.any(sigma > LOOSEST):
        loose = ", ".join(AXES[i] for i in np.nonzero(sigma > LOOSEST)[0])
        raise ValueError(f"mount: {loose} undetermined by these stops; turn and drive between them")
    r, J = _linearised(stops, T, bases)
    by_stops, row = np.empty((6, 6 * len(stops))), 0
    for k, stop in enumerate(stops):
        L = np.linalg.inv(np.linalg.cholesky(stop.covariance))
        by_stops[:, 6 * k : 6 * k + 6] = inverted[:6] @ J[row : row + 6].T @ L
        row += 9 if k else 6  # its pose, and but for the first the way there
    return Mount(T, covariance, by_stops, cost, len(r) - N.shape[0])


def _planar(T: Array) -> Array:
    return np.array([T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])])


def _linearised(stops: list[Stop], T: Array, bases: Array) -> tuple[Array, Array]:
    """Residuals measured - predicted in sigmas, and the prediction's derivatives.

    Columns: mount's shift (base axes) and turn (head axes), then x, y, yaw of each stop's base.
    """
    up = np.array([0.0, 0.0, 1.0])
    residuals, rows = [], []
    for k, stop in enumerate(stops):
        x, y, yaw = bases[k]
        Rz = rot_z(yaw)
        R, lever = Rz @ T[:3, :3], Rz @ T[:3, 3]
        shift = stop.T_world_head[:3, 3] - np.array([x, y, 0.0]) - lever
        r = np.concatenate([shift, log_rotation(R.T @ stop.T_world_head[:3, :3])])
        J = np.zeros((6, 6 + 3 * len(stops)))
        J[:3, :3], J[3:, 3:6] = Rz, np.eye(3)
        at = 6 + 3 * k
        J[0, at] = J[1, at + 1] = 1.0
        J[:3, at + 2], J[3:, at + 2] = np.cross(up, lever), R.T @ up
        L = np.linalg.inv(np.linalg.cholesky(stop.covariance))
        residuals.append(L @ r)
        rows.append(L @ J)
        if k:
            way = between2(bases[k - 1], bases[k])
            r = np.asarray(stop.way) - way
            r[2] = wrap_angle(r[2])
            c, s = np.cos(bases[k - 1, 2]), np.sin(bases[k - 1, 2])
            J = np.zeros((3, 6 + 3 * len(stops)))
            J[:2, at : at + 2] = [[c, s], [-s, c]]
            J[2, at + 2] = 1.0
            J[:, at - 3 : at] = -J[:, at : at + 3]
            J[:2, at - 1] = way[1], -way[0]
            L = np.linalg.inv(np.linalg.cholesky(np.asarray(stop.way_covariance)))
            residuals.append(L @ r)
            rows.append(L @ J)
    return np.concatenate(residuals), np.concatenate(rows)

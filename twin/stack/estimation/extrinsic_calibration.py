"""Pose of the depth camera in the lidar's frame, from walls that both see while driving.

Frames: *lidar*, whose x-y plane is the scan, and *rgbd*, the camera's optical frame;
`T_lidar_rgbd`. A wall stands upright on the scan: a line of the scan tells its normal and offset,
and the camera's points on it must lie in it. Walls in two directions tell x, y and all angles; the
floor, below the scan by the height on the drawing, tells z. A tilt of the lidar itself moves no
line by more than a second-order term, so what is found is the camera against a level lidar.

The lidar's constant error of range is found along with the pose where walls lie on several sides:
it moves opposite walls apart, a shift of the camera moves them alike.
"""

from dataclasses import dataclass

import numpy as np

from twin.geometry import Array, rot_x, rot_y, rot_z, transform


@dataclass(frozen=True)
class PlaneObservation:
    """Points of the camera on a plane that is known in the lidar's frame: n . p = offset."""

    normal: Array  # (3,) unit, in lidar
    offset: float  # m
    points: Array  # (k, 3) in rgbd, m
    sigma: float = 0.02  # m, of one point across the plane
    bias: float = 0.0  # m that the offset grows with each metre of constant error of the ranges


@dataclass(frozen=True)
class Extrinsics:
    """Result of a calibration."""

    T_lidar_rgbd: Array  # (4, 4)
    covariance: Array  # (6, 6): small rotation in lidar axes, rad, then translation, m
    rms: float  # of the residuals in units of their sigma; near 1 if the belief in noise is right
    range_offset: float = 0.0  # m that the lidar reads too far; 0 where it was not sought

    @property
    def angles(self) -> tuple[float, float, float]:
        """gamma, beta, alpha about the fixed axes x, y, z, rad."""
        return fixed_angles(self.T_lidar_rgbd[:3, :3])


def rotation_xyz(gamma: float, beta: float, alpha: float) -> Array:
    """Li & An 2025, Eq. 1: turn by gamma about x, beta about y, alpha about z, fixed axes."""
    return rot_z(alpha) @ rot_y(beta) @ rot_x(gamma)


def fixed_angles(rotation: Array) -> tuple[float, float, float]:
    """Li & An 2025, Eq. 2: gamma, beta, alpha of a rotation, beta within a quarter turn.

    The arctangents of the source divide both sides by cos(beta), which is positive here. At
    beta = +-90 degrees only the sum or difference of the others counts; alpha is then 0.
    """
    r = rotation
    beta = np.arctan2(-r[2, 0], np.hypot(r[0, 0], r[1, 0]))
    if np.hypot(r[0, 0], r[1, 0]) < 1e-9:
        return float(np.sign(beta) * np.arctan2(r[0, 1], r[1, 1])), float(beta), 0.0
    return float(np.arctan2(r[2, 1], r[2, 2])), float(beta), float(np.arctan2(r[1, 0], r[0, 0]))


MIN_POINTS = 30  # of all observations together
TURNS, SHIFTS = slice(0, 3), slice(3, 6)
AXES = ("turn about x", "turn about y", "turn about z", "shift x", "shift y", "shift z")


def calibrate(
    observations: list[PlaneObservation],
    start: Array,
    iterations: int = 40,
    robust: float = 3.0,
    loosest: tuple[float, float] = (0.02, 0.05),
    range_sigma: float = 0.0,
    range_removed: float = 0.0,
) -> Extrinsics:
    """Levenberg-Marquardt over the six numbers of `T_lidar_rgbd`, with Huber weights.

    With `range_sigma` the lidar's constant error of range is a seventh unknown.

    Args:
        observations: of walls and floor.
        start: `T_lidar_rgbd` on the drawing. Shape (4, 4).
        iterations: at most.
        robust: residual in sigmas from which it counts linearly.
        loosest: standard deviations, rad and m, that the result may have.
        range_sigma: standard deviation of the lidar's constant error, by its data sheet, m.
        range_removed: what was taken off the ranges before, m; the result includes it.

    Raises:
        ValueError: if there are too few points, if they are not finite, or if they leave one of
            the six numbers undetermined; the line names which.
    """
    stacked = _stack(observations)
    T, removed = np.array(start, dtype=float), range_removed
    damping, free = 1e-3, slice(0, 7 if range_sigma > 0 else 6)

    def linearised(T: Array, removed: float) -> tuple[Array, Array]:
        r, J = _residuals(T, removed - range_removed, *stacked)
        if range_sigma > 0:  # what the data sheet says counts as one more measurement
            r = np.append(r, removed / range_sigma)
            J = np.vstack([J, [0, 0, 0, 0, 0, 0, 1 / range_sigma]])
        return r, J[:, free]

    r, J = linearised(T, removed)
    for _ in range(iterations):
        weight = _huber(r, robust)
        H, b = (J.T * weight) @ J, (J.T * weight) @ r
        step = np.zeros(7)
        step[free] = -np.linalg.solve(H + damping * np.diag(np.diag(H)) + 1e-12 * np.eye(len(b)), b)
        trial = _moved(T, step), removed + float(step[6])
        r_trial, J_trial = linearised(*trial)
        if _cost(r_trial, robust) <= _cost(r, robust):
            (T, removed), r, J, damping = trial, r_trial, J_trial, max(0.2 * damping, 1e-9)
            if np.max(np.abs(step)) < 1e-9:
                break
        else:
            damping *= 10.0
            if damping > 1e8:
                break
    values, vectors = np.linalg.eigh((J.T * _huber(r, robust)) @ J)
    limits = np.repeat(loosest, 3)
    covariance = ((vectors / np.maximum(values, 1e-12)) @ vectors.T)[:6, :6]
    sigma = np.sqrt(np.diag(covariance))
    if np.any(sigma > limits):
        loose = ", ".join(AXES[i] for i in np.nonzero(sigma > limits)[0])
        raise ValueError(f"calibration: these walls do not determine {loose}; see others too")
    return Extrinsics(T, covariance, float(np.sqrt(np.mean(r**2))), removed)


def _stack(observations: list[PlaneObservation]):
    """Arrays over the points of all planes."""
    normals, points, offsets, sigmas, biases = [], [], [], [], []
    for seen in observations:
        p = np.atleast_2d(np.asarray(seen.points, dtype=float))
        normals.append(np.tile(np.asarray(seen.normal, dtype=float), (len(p), 1)))
        points.append(p)
        offsets.append(np.full(len(p), float(seen.offset)))
        sigmas.append(np.full(len(p), seen.sigma))
        biases.append(np.full(len(p), seen.bias))
    count = sum(len(p) for p in points)
    if count < MIN_POINTS:
        raise ValueError(f"calibration: {count} points on walls, wanted {MIN_POINTS}")
    stacked = tuple(np.concatenate(part) for part in (normals, points, offsets, sigmas, biases))
    if not all(np.all(np.isfinite(part)) for part in stacked):
        raise ValueError("calibration: an observation is not finite")
    return stacked


def _residuals(T: Array, further: float, normals, points, offsets, sigmas, biases):
    """In sigmas, shape (n,), and derivatives by turns (lidar's axes), shifts and `further`.

    `further` is the error of range, m, that still is in the offsets.
    """
    rotated = points @ T[:3, :3].T
    r = np.einsum("ij,ij->i", normals, rotated + T[:3, 3]) - offsets + biases * further
    J = np.concatenate([np.cross(rotated, normals), normals, biases[:, None]], axis=1)
    return r / sigmas, J / sigmas[:, None]


def _moved(T: Array, step: Array) -> Array:
    return transform(rotation_exp(step[TURNS]) @ T[:3, :3], T[:3, 3] + step[SHIFTS])


def rotation_exp(turn: Array) -> Array:
    """Rotation by a vector: its length is the angle, rad (Rodrigues). Shape (3, 3)."""
    angle = float(np.linalg.norm(turn))
    x, y, z = turn
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * np.sinc(angle / 2 / np.pi) ** 2 * K @ K


def _huber(r: Array, k: float) -> Array:
    return np.minimum(1.0, k / np.maximum(np.abs(r), 1e-12))


def _cost(r: Array, k: float) -> float:
    a = np.abs(r)
    return float(np.sum(np.where(a <= k, 0.5 * a**2, k * a - 0.5 * k**2)))

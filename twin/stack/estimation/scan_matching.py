"""Where a scan fits into a map: search over a window, then Gauss-Newton on the distance field.

The search tries every pose of a coarse lattice (correlative matching after Olson 2009), so that a
poor guess does not end in a wrong valley. The refinement draws the points onto the obstacles along
the slope of the interpolated distance, or onto their surfaces where these are known finer than the
cells (`surfaces`), each point with a weight that falls off with its distance.
The observation of Xu et al., Eq. 2: h(x) is the distance of each end point, which ought to be 0.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from twin.geometry import Array, wrap_angle
from twin.stack.estimation.likelihood_field import LikelihoodField
from twin.stack.estimation.surfaces import SurfaceField


@dataclass(frozen=True)
class MatchSettings:
    """Sizes and steps; not tuned beyond the tests' worlds."""

    window: tuple[float, float] = (0.25, 0.10)  # m and rad on either side of the guess
    step: tuple[float, float] = (0.05, 0.0125)  # m and rad of the search
    sigma: float = 0.10  # m, width of the score's bell in the search
    searched: int = 180  # points used in the search
    robust: float = 0.06  # m, scale of the weights (Geman & McClure) in the refinement
    iterations: int = 20
    inlier: float = 0.10  # m: a point nearer than this has found its obstacle
    # Points side by side are wrong together, by the map's grain; guess.
    correlated: int = 30
    grain: float = 0.03  # share of the information about position that a bare wall feigns
    point_sigma: float = 0.02  # m, of a point against the map


@dataclass(frozen=True)
class Match:
    """Result of a match."""

    pose: Array  # (3,) x, y, yaw in world
    covariance: Array  # (3, 3); large along what the scan does not tell
    inliers: float  # share of the points that found an obstacle
    rms: float  # m, distance of those points
    # Square roots of the smallest over the largest information about position, 0 to 1: a bare
    # corridor tells nothing along itself.
    conditioning: float


NOWHERE, NO_SURFACES = np.zeros((0, 0), dtype=np.int32), np.zeros((0, 4))
ALONG = 0.06  # m along a surface beyond which a point lies past its end
FAR = 1e3  # variance (m^2, rad^2) given to what a scan does not tell at all


def match_scan(
    field: LikelihoodField | SurfaceField,
    points: Array,
    guess: Array,
    settings: MatchSettings = MatchSettings(),
    search: bool = True,
) -> Match | None:
    """Pose at which points lie on the map's obstacles.

    Args:
        field: distances to the map's obstacles.
        points: end points in the frame whose pose is sought, m. Shape (n, 2).
        guess: x, y, yaw in world.
        settings: of search and refinement.
        search: try the window around the guess first; False goes downhill from the guess.

    Returns:
        The match, or None if the points, the guess or the map are of no use.
    """
    points = np.asarray(points, dtype=float)
    if points.ndim != 2 or points.shape[1:] != (2,):
        return None
    points = np.ascontiguousarray(points[np.all(np.isfinite(points), axis=1)])
    pose = np.array(guess, dtype=float)
    if len(points) < 10 or pose.shape != (3,) or not np.all(np.isfinite(pose)):
        return None
    frame = (float(field.origin[0]), float(field.origin[1]), field.resolution)
    if search:
        few = np.ascontiguousarray(points[:: max(len(points) // settings.searched, 1)])
        pose = _search(
            field.distances, frame, few, pose, settings.window, settings.step, settings.sigma
        )
    limits = (settings.robust, settings.iterations, settings.inlier)
    if isinstance(field, SurfaceField):
        map_ = (field.distances, field.nearest, field.surfaces)
    else:
        map_ = (field.distances, NOWHERE, NO_SURFACES)
    pose, H, near, squares = _refine(map_, frame, points, pose, limits)
    if near < 10 or not np.all(np.isfinite(pose)):
        return None
    pose[2] = wrap_angle(pose[2])
    # Along a flat wall the slope of the field is only the map's grain, which tells nothing.
    grain = settings.grain * (H[0, 0] + H[1, 1])
    H = H - np.diag([grain, grain, 0.0])
    information = H / (settings.point_sigma**2 * settings.correlated)
    values, vectors = np.linalg.eigh(information)
    variances = 1 / np.maximum(values, 1 / FAR)
    position = np.linalg.eigvalsh(information[:2, :2])
    return Match(
        pose=pose,
        covariance=(vectors * variances) @ vectors.T,
        inliers=near / len(points),
        rms=float(np.sqrt(squares / near)),
        conditioning=float(np.sqrt(max(position[0], 0.0) / max(position[1], 1e-12))),
    )


@njit(cache=True)
def _search(distances, frame, points, guess, window, step, sigma):
    """Best pose of the lattice; equal scores go to the one nearest the guess."""
    x0, y0, resolution = frame
    h, w = distances.shape
    turns, shifts = int(np.ceil(window[1] / step[1])), int(np.ceil(window[0] / step[0]))
    k = -0.5 / (sigma * sigma)
    best, found = -np.inf, guess.copy()
    px, py = np.empty(len(points)), np.empty(len(points))
    for a in range(-turns, turns + 1):
        yaw = guess[2] + a * step[1]
        c, s = np.cos(yaw), np.sin(yaw)
        for i in range(len(points)):
            px[i] = (c * points[i, 0] - s * points[i, 1] + guess[0] - x0) / resolution
            py[i] = (s * points[i, 0] + c * points[i, 1] + guess[1] - y0) / resolution
        for m in range(-shifts, shifts + 1):
            for n in range(-shifts, shifts + 1):
                dx, dy = m * step[0] / resolution, n * step[0] / resolution
                score = 0.0
                for i in range(len(points)):
                    x, y = px[i] + dx, py[i] + dy
                    if x >= 0 and x < w and y >= 0 and y < h:
                        d = distances[int(y), int(x)]
                        if d < 3 * sigma:
                            score += np.exp(k * d * d)
                # A trifle for the distance from the guess settles ties.
                away = (m * step[0]) ** 2 + (n * step[0]) ** 2 + (a * step[1]) ** 2
                score -= 1e-3 * len(points) * away
                if score > best:
                    best = score
                    found[0], found[1] = guess[0] + m * step[0], guess[1] + n * step[0]
                    found[2] = yaw
    return found


@njit(cache=True)
def _refine(map_, frame, points, start, limits):
    """Pose, information matrix per unit variance, number and squared distance of the inliers."""
    distances = map_[0]
    x0, y0, resolution = frame
    scale, iterations, inlier = limits
    h, w = distances.shape
    pose, best = start.copy(), start.copy()
    H, H_best = np.zeros((3, 3)), np.zeros((3, 3))
    cost_best, damping = np.inf, 1e-3
    near_best, squares_best = 0, 0.0
    b, b_best = np.zeros(3), np.zeros(3)
    for _ in range(iterations):
        H[:], b[:] = 0.0, 0.0
        cost, near, squares = 0.0, 0, 0.0
        c, s = np.cos(pose[2]), np.sin(pose[2])
        J = np.zeros(3)
        for i in range(len(points)):
            rx = c * points[i, 0] - s * points[i, 1]
            ry = s * points[i, 0] + c * points[i, 1]
            # Distances hold for the cells' centres.
            gx = (rx + pose[0] - x0) / resolution - 0.5
            gy = (ry + pose[1] - y0) / resolution - 0.5
            if not (gx >= 0 and gx < w - 1 and gy >= 0 and gy < h - 1):
                cost += 1.0
                continue
            d, J[0], J[1] = _distance(map_, resolution, gx, gy, rx + pose[0], ry + pose[1])
            q = d * d / (scale * scale)
            cost += q / (1 + q)  # Geman & McClure
            weight = 1.0 / (1 + q) ** 2
            J[2] = -J[0] * ry + J[1] * rx
            for m in range(3):
                b[m] += weight * J[m] * d
                for n in range(3):
                    H[m, n] += weight * J[m] * J[n]
            if abs(d) < inlier:
                near += 1
                squares += d * d
        if cost < cost_best:
            gain = cost_best - cost
            cost_best, damping = cost, max(damping * 0.3, 1e-6)
            best[:], H_best[:], b_best[:] = pose, H, b
            near_best, squares_best = near, squares
            if gain < 1e-6 * len(points):
                break
        else:
            damping *= 8.0
            if damping > 1e4:
                break
        A = H_best.copy()
        for m in range(3):
            A[m, m] += damping * H_best[m, m] + 1e-6
        step = _solve3(A, b_best)
        pose = best - step
        if abs(step[0]) + abs(step[1]) + abs(step[2]) < 1e-5:
            break
    return best, H_best, near_best, squares_best


@njit(cache=True)
def _distance(map_, resolution, gx, gy, x, y):
    """Distance of a point to what is nearest, and its slope in x and y."""
    distances, nearest, surfaces = map_
    if len(surfaces):
        k = nearest[int(gy + 0.5), int(gx + 0.5)]
        if k < 0:
            return distances[int(gy), int(gx)], 0.0, 0.0
        dx, dy = x - surfaces[k, 0], y - surfaces[k, 1]
        nx, ny = surfaces[k, 2], surfaces[k, 3]
        if nx * nx + ny * ny > 0.5 and abs(dx * ny - dy * nx) < ALONG:
            return dx * nx + dy * ny, nx, ny
        d = np.sqrt(dx * dx + dy * dy)
        return d, dx / max(d, 1e-6), dy / max(d, 1e-6)
    u, v = int(gx), int(gy)
    fx, fy = gx - u, gy - v
    d00, d10 = distances[v, u], distances[v, u + 1]
    d01, d11 = distances[v + 1, u], distances[v + 1, u + 1]
    low, high = d00 + fx * (d10 - d00), d01 + fx * (d11 - d01)
    slope = ((1 - fy) * (d10 - d00) + fy * (d11 - d01)) / resolution
    return low + fy * (high - low), slope, (high - low) / resolution


@njit(cache=True)
def _solve3(A, b):
    """x of A x = b for a symmetric positive definite (3, 3), by Cholesky's square-root-free way."""
    d0 = A[0, 0]
    l1, l2 = A[1, 0] / d0, A[2, 0] / d0
    d1 = A[1, 1] - l1 * l1 * d0
    l3 = (A[2, 1] - l2 * l1 * d0) / d1
    d2 = A[2, 2] - l2 * l2 * d0 - l3 * l3 * d1
    y1 = b[1] - l1 * b[0]
    x2 = (b[2] - l2 * b[0] - l3 * y1) / d2
    x1 = y1 / d1 - l3 * x2
    return np.array([b[0] / d0 - l1 * x1 - l2 * x2, x1, x2])

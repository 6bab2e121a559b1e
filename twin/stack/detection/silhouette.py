"""What a connector's outline would look like: drawing and pose to a filled mask and its moments.

Image frame: u right, v down, pixel centres at whole numbers. A pose is (x, y, yaw) of the part
frame on the belt plane, in base. Compiled: a frame takes some hundred outlines.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from twin.geometry import Array, inverse
from twin.stack.config import Camera, PartDrawing

THIRD = 0.5  # weight of the third moments: they suffer most from a wrong edge
MAX_TURN = 0.3  # rad, in one step of the fit
GIVE_UP = 6  # yaws of the wrong area until a class is left
MOMENTS = 10  # area, u, v, three central second and four central third moments, over the area


@dataclass(frozen=True)
class Outline:
    """A drawing's solids in one array, ready for `draw`."""

    points: Array  # (n, 3) corners in the part frame, m
    starts: np.ndarray  # (m + 1,) first corner of each solid

    @classmethod
    def of(cls, drawing: PartDrawing) -> "Outline":
        """Outline of a drawing."""
        sizes = [len(s) for s in drawing.solids]
        return cls(np.concatenate(drawing.solids), np.concatenate([[0], np.cumsum(sizes)]))


def projection(camera: Camera) -> Array:
    """`P` such that `u, v, 1 ~ P @ (p_base, 1)`. Shape (3, 4)."""
    return camera.matrix @ inverse(camera.T_base_camera)[:3]


def shifted(P: Array, u0: float, v0: float, factor: float = 1.0) -> Array:
    """Projection to a patch whose corner pixel is (u0, v0), shrunk by `factor`. Shape (3, 4)."""
    centre = 0.5 * (factor - 1.0)  # of the first shrunk pixel, in pixels of the image
    S = np.diag([1 / factor, 1 / factor, 1.0])
    S[:2, 2] = -(u0 + centre) / factor, -(v0 + centre) / factor
    return S @ P


@njit(cache=True)
def draw(points, starts, pose, plane_z, P, mask):
    """Fill `mask` (h, w) with ones inside the outline.

    Returns:
        First and last column and row with a one: left, top, right, bottom.
    """
    mask[:] = 0
    height, width = mask.shape
    box_left, box_top, box_right, box_bottom = width, height, -1, -1
    c, s = np.cos(pose[2]), np.sin(pose[2])
    uv = np.empty((points.shape[0], 2))
    for i in range(points.shape[0]):
        x = pose[0] + c * points[i, 0] - s * points[i, 1]
        y = pose[1] + s * points[i, 0] + c * points[i, 1]
        z = plane_z + points[i, 2]
        w = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
        uv[i, 0] = (P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3]) / w
        uv[i, 1] = (P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]) / w
    for k in range(starts.shape[0] - 1):
        hull = _hull(uv[starts[k] : starts[k + 1]])
        n = hull.shape[0]
        low, high = max(0, int(np.ceil(hull[:, 1].min()))), int(np.floor(hull[:, 1].max()))
        for v in range(low, min(height - 1, high) + 1):
            left, right = 1e9, -1e9
            for i in range(n):
                a, b = hull[i], hull[(i + 1) % n]
                if (a[1] <= v) == (b[1] <= v):
                    continue
                u = a[0] + (v - a[1]) / (b[1] - a[1]) * (b[0] - a[0])
                left, right = min(left, u), max(right, u)
            first, last = max(0, int(np.ceil(left))), min(width - 1, int(np.floor(right)))
            if last >= first:
                mask[v, first : last + 1] = 1
                box_left, box_right = min(box_left, first), max(box_right, last)
                box_top, box_bottom = min(box_top, v), max(box_bottom, v)
    return box_left, box_top, box_right, box_bottom


@njit(cache=True)
def _hull(points):
    """Convex hull by Andrew's monotone chain. Shape (k, 2)."""
    n = points.shape[0]
    order = np.argsort(points[:, 0])
    hull = np.empty((2 * n, 2))
    k = 0
    for turn in range(2):
        base = k + 1
        for j in range(n):
            p = points[order[j]] if turn == 0 else points[order[n - 1 - j]]
            while k >= base + 1 and (
                (hull[k - 1, 0] - hull[k - 2, 0]) * (p[1] - hull[k - 2, 1])
                - (hull[k - 1, 1] - hull[k - 2, 1]) * (p[0] - hull[k - 2, 0])
                <= 0
            ):
                k -= 1
            hull[k] = p
            k += 1
        k -= 1  # the last point of a chain is the first of the next
    return hull[:k]


@njit(cache=True)
def centroid(mask):
    """Area (px), u and v of the centroid."""
    area, su, sv = 0, 0, 0
    for v in range(mask.shape[0]):
        for u in range(mask.shape[1]):
            if mask[v, u]:
                area += 1
                su += u
                sv += v
    return float(area), su / max(area, 1), sv / max(area, 1)


@njit(cache=True)
def moments(mask):
    """Area (px), centroid, and central moments over the area: uu, uv, vv, uuu, uuv, uvv, vvv."""
    out = np.zeros(MOMENTS)
    height, width = mask.shape
    out[0], out[1], out[2] = centroid(mask)
    if out[0] == 0.0:
        return out
    for v in range(height):
        dv = v - out[2]
        for u in range(width):
            if mask[v, u]:
                du = u - out[1]
                out[3] += du * du
                out[4] += du * dv
                out[5] += dv * dv
                out[6] += du * du * du
                out[7] += du * du * dv
                out[8] += du * dv * dv
                out[9] += dv * dv * dv
    out[3:] /= out[0]
    return out


@njit(cache=True)
def overlap(first, second, shift_u, shift_v):
    """Intersection over union of two masks, `second` moved by whole pixels."""
    height, width = first.shape
    both, area = 0, 0
    for v in range(height):
        for u in range(width):
            area += first[v, u]
            area += second[v, u]
            p, q = v - shift_v, u - shift_u
            if first[v, u] and 0 <= p < height and 0 <= q < width:
                both += second[p, q]
    return both / max(area - both, 1)


@njit(cache=True)
def scan(points, starts, x, y, yaws, plane_z, P, seen, target, area_ratio):
    """IoU of the outline with a silhouette at every yaw, centroids laid upon each other.

    Yaws at which the area is out of `area_ratio` (seen over drawn) score zero. Shape (n,).
    """
    scores = np.zeros(yaws.shape[0])
    mask = np.empty_like(seen)
    pose = np.array([x, y, 0.0])
    order = np.arange(yaws.shape[0]) * 7 % yaws.shape[0]  # far apart, to give up early
    misses = 0
    for i in order:
        pose[2] = yaws[i]
        draw(points, starts, pose, plane_z, P, mask)
        area, u, v = centroid(mask)
        ratio = target[0] / max(area, 1.0)
        if area_ratio[0] < ratio < area_ratio[1]:
            shift_u, shift_v = int(np.rint(target[1] - u)), int(np.rint(target[2] - v))
            scores[i] = overlap(seen, mask, shift_u, shift_v)
        else:
            misses += 1
            if misses == GIVE_UP:
                break
    return scores


@njit(cache=True)
def fit(points, starts, pose, plane_z, P, seen, target, steps, iterations):
    """Gauss-Newton on the moments from `pose`. Returns the pose, (3,), and its IoU.

    Moments are brought to pixels: the second ones divided by the silhouette's size, the third ones
    by its square.
    """
    mask = np.empty_like(seen)
    size = np.sqrt(target[0])
    scale = np.ones(MOMENTS - 1)
    scale[2:5] = 1.0 / size
    scale[5:] = THIRD / size**2
    pose = pose.copy()
    J = np.empty((MOMENTS - 1, 3))
    for _ in range(iterations):
        draw(points, starts, pose, plane_z, P, mask)
        now = moments(mask)[1:]
        for k in range(3):
            moved = pose.copy()
            moved[k] += steps[k]
            draw(points, starts, moved, plane_z, P, mask)
            J[:, k] = (moments(mask)[1:] - now) * scale / steps[k]
        residual = (target[1:] - now) * scale
        change = _solve3(J.T @ J, J.T @ residual)
        change[2] = min(max(change[2], -MAX_TURN), MAX_TURN)
        pose += change
    draw(points, starts, pose, plane_z, P, mask)
    return pose, overlap(seen, mask, 0, 0)


@njit(cache=True)
def _solve3(A, b):
    """Cramer's rule; zeros where A is singular. (LAPACK would need scipy under numba.)"""
    c0 = A[1, 1] * A[2, 2] - A[1, 2] * A[2, 1]
    c1 = A[1, 2] * A[2, 0] - A[1, 0] * A[2, 2]
    c2 = A[1, 0] * A[2, 1] - A[1, 1] * A[2, 0]
    det = A[0, 0] * c0 + A[0, 1] * c1 + A[0, 2] * c2
    x = np.zeros(3)
    if det == 0.0:
        return x
    for k in range(3):
        B = A.copy()
        B[:, k] = b
        x[k] = (
            B[0, 0] * (B[1, 1] * B[2, 2] - B[1, 2] * B[2, 1])
            - B[0, 1] * (B[1, 0] * B[2, 2] - B[1, 2] * B[2, 0])
            + B[0, 2] * (B[1, 0] * B[2, 1] - B[1, 1] * B[2, 0])
        ) / det
    return x

"""Linear algebra of a few unknowns for compiled loops, free of LAPACK (numba would need SciPy)."""

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True)
def cholesky(a, n):
    """Lower factor of the leading n x n part of a, in place. False if not positive definite."""
    for j in range(n):
        d = a[j, j]
        for k in range(j):
            d -= a[j, k] * a[j, k]
        if not d > 0.0:
            return False
        d = np.sqrt(d)
        a[j, j] = d
        for i in range(j + 1, n):
            s = a[i, j]
            for k in range(j):
                s -= a[i, k] * a[j, k]
            a[i, j] = s / d
    return True


@njit(cache=True)
def forward(low, n, b):
    """Solves low x = b in place; b has shape (>= n,)."""
    for i in range(n):
        s = b[i]
        for k in range(i):
            s -= low[i, k] * b[k]
        b[i] = s / low[i, i]


@njit(cache=True)
def backward(low, n, b):
    """Solves low^T x = b in place."""
    for i in range(n - 1, -1, -1):
        s = b[i]
        for k in range(i + 1, n):
            s -= low[k, i] * b[k]
        b[i] = s / low[i, i]


@njit(cache=True)
def spd_inverse(a, n, out):
    """Inverse of a symmetric positive definite matrix into out (n, n). False if it is none.

    a is overwritten by its factor.
    """
    if not cholesky(a, n):
        return False
    column = np.empty(n)
    for j in range(n):
        for i in range(n):
            column[i] = 1.0 if i == j else 0.0
        forward(a, n, column)
        backward(a, n, column)
        for i in range(n):
            out[i, j] = column[i]
    return True


@njit(cache=True)
def copy_to(source, target, rows):
    """First rows of a two-dimensional array into another; compiles faster than a slice."""
    for i in range(rows):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]


@njit(cache=True)
def rotation_exp(x, y, z, out):
    """Rodrigues' formula into out (3, 3): the vector's length is the angle, rad."""
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-10:
        a, b = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        angle = np.sqrt(angle2)
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
    out[0, 0], out[0, 1], out[0, 2] = (
        1.0 - b * (y * y + z * z),
        b * x * y - a * z,
        b * x * z + a * y,
    )
    out[1, 0], out[1, 1], out[1, 2] = (
        b * x * y + a * z,
        1.0 - b * (x * x + z * z),
        b * y * z - a * x,
    )
    out[2, 0], out[2, 1], out[2, 2] = (
        b * x * z - a * y,
        b * y * z + a * x,
        1.0 - b * (x * x + y * y),
    )


def scaled_inverse(information: NDArray) -> NDArray:
    """Inverse with unknowns of very different units brought to one scale first.

    All infinite where a direction is left open, as by collinear nodes or on the danger cylinder.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    if values[0] < 1e-13 * values[-1]:
        return np.full(information.shape, np.inf)
    return scale[:, None] * ((vectors / values) @ vectors.T) * scale

"""The heaviest cluster of a cloud of weighted poses, its mean and covariance.

A cloud in several places has no useful mean. As in Nav2, filled bins that touch make a cluster, and
the estimate is that of the cluster with the greatest weight.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.geometry import Array

BIN_SIZE = (0.25, 0.25, float(np.radians(10.0)))  # m, m, rad; a whole turn is 36 bins


def heaviest(poses: Array, weights: Array) -> NDArray[np.bool_]:
    """Which of the poses (n, 3) belong to the heaviest cluster. Shape (n,)."""
    turn_bins = round(2 * np.pi / BIN_SIZE[2])
    keys, rows = _keys(poses, BIN_SIZE, turn_bins)
    bins, bin_of = np.unique(keys, return_inverse=True)
    cluster = _label(bins, rows, turn_bins)[bin_of]
    return cluster == np.argmax(np.bincount(cluster, weights=weights))


def mean_and_covariance(poses: Array, weights: Array) -> tuple[Array, Array]:
    """Weighted mean (3,), yaw as a direction, and covariance (3, 3)."""
    angles = poses[:, 2].astype(np.float32)
    yaw = np.arctan2(weights @ np.sin(angles), weights @ np.cos(angles))
    return _moments(poses, weights, float(yaw))


@njit(cache=True)
def _moments(poses, weights, yaw):
    total, x, y = 0.0, 0.0, 0.0
    for i in range(len(poses)):
        total += weights[i]
        x += weights[i] * poses[i, 0]
        y += weights[i] * poses[i, 1]
    mean = np.array([x / total, y / total, yaw])
    xx, xy, yy, xt, yt, tt = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(len(poses)):
        w, dx, dy = weights[i], poses[i, 0] - mean[0], poses[i, 1] - mean[1]
        turn = poses[i, 2] - mean[2]
        if abs(turn) > np.pi:
            turn -= 2 * np.pi * np.round(turn / (2 * np.pi))
        xx += w * dx * dx
        xy += w * dx * dy
        yy += w * dy * dy
        xt += w * dx * turn
        yt += w * dy * turn
        tt += w * turn * turn
    return mean, np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]]) / total


@njit(cache=True)
def _keys(poses, bin_size, turn_bins):
    """Number of each pose's bin, x by y by yaw, and the rows along y, with a margin of one."""
    low_x, low_y, high_y = np.inf, np.inf, -np.inf
    for i in range(len(poses)):
        low_x, low_y = min(low_x, poses[i, 0]), min(low_y, poses[i, 1])
        high_y = max(high_y, poses[i, 1])
    rows = int((high_y - low_y) / bin_size[1]) + 3
    keys = np.empty(len(poses), dtype=np.int64)
    for i in range(len(poses)):
        column = int((poses[i, 0] - low_x) / bin_size[0]) + 1
        row = int((poses[i, 1] - low_y) / bin_size[1]) + 1
        turn = int(np.floor(poses[i, 2] / bin_size[2])) % turn_bins
        keys[i] = (column * rows + row) * turn_bins + turn
    return keys, rows


@njit(cache=True)
def _label(bins, rows, turn_bins):
    """Cluster of each bin: flood fill among sorted bins that touch, yaw going round."""
    label = np.full(len(bins), -1, dtype=np.int64)
    stack = np.empty(len(bins), dtype=np.int64)
    clusters = 0
    for seed in range(len(bins)):
        if label[seed] >= 0:
            continue
        label[seed], stack[0], filled = clusters, seed, 1
        while filled:
            filled -= 1
            place, turn = divmod(bins[stack[filled]], turn_bins)
            for dx in range(-1, 2):
                for dy in range(-1, 2):
                    for dt in range(-1, 2):
                        key = (place + dx * rows + dy) * turn_bins + (turn + dt) % turn_bins
                        at = np.searchsorted(bins, key)
                        if at < len(bins) and bins[at] == key and label[at] < 0:
                            label[at], stack[filled] = clusters, at
                            filled += 1
        clusters += 1
    return label

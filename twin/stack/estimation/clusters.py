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
    return _heaviest(poses, weights, BIN_SIZE, turn_bins)


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
def _heaviest(poses, weights, bin_size, turn_bins):
    """Bins numbered by a hash table, filled bins that touch flooded, yaw going round."""
    keys, rows = _keys(poses, bin_size, turn_bins)
    size = 16
    while size < 2 * len(keys):
        size *= 2
    table = np.full(size, -1, dtype=np.int64)  # number of the bin in each slot
    bins = np.empty(len(keys), dtype=np.int64)  # key of each bin
    weight = np.zeros(len(keys))
    bin_of = np.empty(len(keys), dtype=np.int64)
    filled = 0
    for i in range(len(keys)):
        slot = _slot(table, bins, keys[i])
        if table[slot] < 0:
            table[slot], bins[filled] = filled, keys[i]
            filled += 1
        bin_of[i] = table[slot]
        weight[bin_of[i]] += weights[i]
    label = np.full(filled, -1, dtype=np.int64)
    stack = np.empty(filled, dtype=np.int64)
    best, best_weight = 0, -1.0
    for seed in range(filled):
        if label[seed] >= 0:
            continue
        label[seed], stack[0], waiting, total = seed, seed, 1, 0.0
        while waiting:
            waiting -= 1
            at = stack[waiting]
            total += weight[at]
            place, turn = divmod(bins[at], turn_bins)
            for dx in range(-1, 2):
                for dy in range(-1, 2):
                    for dt in range(-1, 2):
                        key = (place + dx * rows + dy) * turn_bins + (turn + dt) % turn_bins
                        near = table[_slot(table, bins, key)]
                        if near >= 0 and label[near] < 0:
                            label[near], stack[waiting] = seed, near
                            waiting += 1
        if total > best_weight:
            best, best_weight = seed, total
    return label[bin_of] == best


@njit(cache=True)
def _slot(table, bins, key):
    """Slot of the hash table that holds a bin's key, or the free one where it belongs."""
    mask = len(table) - 1
    slot = (key ^ (key >> 15) * 0x9E3779B1) & mask
    while table[slot] >= 0 and bins[table[slot]] != key:
        slot = (slot + 1) & mask
    return slot

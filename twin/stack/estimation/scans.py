"""Whether a scan can be used at all, and its beams as points."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array
from twin.messages import LidarScan


def scan_fault(scan: LidarScan, beams_needed: bool = True) -> str | None:
    """Why a scan must be dropped, in one line; None if it is usable.

    Single beams without a return (inf) or broken (NaN, negative) are no fault; they are left out.

    Args:
        scan: as it came.
        beams_needed: whether a scan of which no beam returned is a fault.
    """
    ranges = np.asarray(scan.ranges)
    head = (scan.stamp, scan.angle_min, scan.angle_increment, scan.range_max)
    if not np.all(np.isfinite(head)):
        return "scan dropped: its stamp, angles or largest range are not finite"
    if ranges.ndim != 1 or len(ranges) == 0:
        return f"scan at {scan.stamp:.3f} s dropped: ranges of shape {ranges.shape}, wanted (n,)"
    if scan.angle_increment == 0 or scan.range_max <= 0:
        return f"scan at {scan.stamp:.3f} s dropped: angle increment or largest range is 0"
    if beams_needed and not np.any(_usable(ranges, scan.range_max)):
        return f"scan at {scan.stamp:.3f} s dropped: none of its {len(ranges)} beams returned"
    return None


def beam_angles(scan: LidarScan) -> Array:
    """Angles of the beams in the sensor frame, rad. Shape (n,)."""
    return scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges), dtype=np.float64)


def beam_points(scan: LidarScan, max_range: float = np.inf) -> Array:
    """End points of the beams that returned, in the sensor frame, m. Shape (k, 2), k <= n."""
    ranges = np.asarray(scan.ranges, dtype=float)
    good = _usable(ranges, min(scan.range_max, max_range))
    r, a = ranges[good], beam_angles(scan)[good]
    return np.stack([r * np.cos(a), r * np.sin(a)], axis=1)


def _usable(ranges: NDArray, longest: float) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        return (ranges > 0) & (ranges <= longest)


def without_offset(scan: LidarScan, offset: float) -> LidarScan:
    """The scan with a constant error of range taken off, m."""
    return replace(scan, ranges=np.asarray(scan.ranges, dtype=float) - offset) if offset else scan

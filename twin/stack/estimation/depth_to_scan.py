"""Depth picture to the scan of a flat sensor: what stands in the vehicle's way at any height.

Frames: *level* has its origin in the camera and is turned with it about z only, so x is the
heading of the optical axis, y left, z up. Rays of the camera are turned into it once; then a
pixel's beam does not depend on its depth, and a picture costs a few operations a pixel.
"""

from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

from twin.geometry import Array, rot_z
from twin.messages import LidarScan, RgbdFrame
from twin.stack.config import Camera


@dataclass(frozen=True)
class HeightBand:
    """What is cut out of the picture, above the floor; the rest cannot touch the vehicle."""

    low: float = 0.04  # m: below it the wheels roll over, or it is the floor
    high: float = 1.05  # m: the vehicle's top with its margin


@dataclass(frozen=True)
class DepthNoise:
    """How much to believe a pixel; a stereo camera's noise grows with distance squared."""

    at_1m: float = 0.010  # m, 1 sigma
    max_range: float = 3.0  # m, beyond which noise lifts the floor into the band
    sigmas: float = 3.0  # by which a pixel below the camera must rise above the band's foot
    support: int = 3  # pixels that must agree on a beam's range
    deep_range: float = 2.0  # m up to which surfaces behind the first are told apart: 3 sigma 0.1 m
    deep_support: int = 12  # pixels within BIN that make one: more than a level face gives


@dataclass(frozen=True)
class DepthScan:
    """A picture as a scan in the level frame."""

    scan: LidarScan
    clear_to: Array  # (n,) m: floor seen up to there, for beams without a return
    sensor_pose: Array  # (3,) x, y, yaw of the level frame in base
    # x, y in level of upright surfaces behind the first of their beam: goods on a shelf behind
    # its edge, seen over or under it. Shape (k, 2), m.
    behind: Array = field(default_factory=lambda: np.zeros((0, 2)))


class DepthToScan:
    """Turns depth pictures into scans.

    Args:
        camera: intrinsics and `T_base_camera`, as calibrated.
        band: heights that count.
        noise: of the depth.
    """

    def __init__(
        self,
        camera: Camera,
        band: HeightBand = HeightBand(),
        noise: DepthNoise = DepthNoise(),
    ):
        self._camera, self._band, self._noise = camera, band, noise
        R_base_camera, p = camera.T_base_camera[:3, :3], camera.T_base_camera[:3, 3]
        heading = float(np.arctan2(R_base_camera[1, 2], R_base_camera[0, 2]))
        self.sensor_pose = np.array([p[0], p[1], heading])
        v, u = np.mgrid[: camera.height, : camera.width]
        rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.matrix).T
        rays = rays @ (rot_z(heading).T @ R_base_camera).T  # per metre of depth, in level
        angle = np.arctan2(rays[..., 1], rays[..., 0])
        reach = np.hypot(rays[..., 0], rays[..., 1])
        # Beams a little wider than a column in the picture's middle, so that none stays empty.
        self.beams = int(np.ptp(angle) * camera.focal / 1.2)
        self._start = float(angle.min())  # alpha_2 of the source's Eq. 3
        self.increment = float(np.ptp(angle)) / self.beams
        index = np.minimum((angle - self._start) / self.increment, self.beams - 1)  # Eq. 3
        self._beam = index.astype(np.int32)
        self._reach = reach.astype(np.float32)
        self._rise = rays[..., 2].astype(np.float32)
        steepest = float(np.min(rays[..., 2] / reach))
        # Nearer than this a low thing lies under the picture's lower edge.
        self.blind = (p[2] - band.low) / -steepest if steepest < 0 else float(noise.max_range)
        self.fault: str | None = None  # why the last picture was dropped

    def convert(self, frame: RgbdFrame) -> DepthScan | None:
        """Scan of a picture: Li & An 2025, Eq. 3 for the beam and Eq. 4 for its range.

        Of the pixels of a beam within the band the nearest count, those that agree with the first
        within the noise are averaged, and lone pixels are left out.

        Returns:
            The scan, or None for a picture that does not fit the camera; `fault` then says why.
        """
        depth, shape = np.asarray(frame.depth_mm), (self._camera.height, self._camera.width)
        self.fault = None
        if depth.shape != shape or depth.dtype != np.uint16:
            self.fault = f"depth picture: {depth.shape} of {depth.dtype}, wanted {shape} of uint16"
        elif not np.isfinite(frame.stamp):
            self.fault = "depth picture: its stamp is not finite"
        elif not depth.any():
            self.fault = f"depth picture at {frame.stamp:.3f} s: no pixel has a return"
        if self.fault is not None:
            return None
        n, band = self._noise, self._band
        ranges, clear_to, deep = _project(
            np.ascontiguousarray(depth),
            (self._beam, self._reach, self._rise),
            self.beams,
            (float(self._camera.T_base_camera[2, 3]), band.low, band.high),
            (n.at_1m, n.max_range, n.sigmas, n.support),
            (n.deep_range, n.deep_support),
        )
        first = self._start + 0.5 * self.increment  # the middle of the first beam
        scan = LidarScan(frame.stamp, first, self.increment, ranges, n.max_range)
        angle = first + self.increment * deep[:, 0]
        behind = deep[:, 1:] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return DepthScan(scan, clear_to, self.sensor_pose, behind)


BIN = 0.05  # m of range in which pixels of a beam count as one surface
APART = 0.12  # m by which a surface must lie behind the first


@njit(cache=True)
def _project(depth: NDArray[np.uint16], rays, beams, heights, noise, deep):
    """Range of each beam, inf without a return; how far floor was seen; surfaces behind the first.

    The last are beam and range, shape (k, 2).
    """
    beam, reach, rise = rays
    camera, low, high = heights
    at_1m, longest, sigmas, support = noise
    h, w = depth.shape
    nearest, clear = np.full(beams, np.inf), np.zeros(beams)
    in_band = np.zeros((h, w), dtype=np.float32)  # range of the pixels that count, else 0
    for v in range(h):
        for u in range(w):
            d = np.float32(1e-3) * depth[v, u]
            r = d * reach[v, u]
            if d == 0 or r > longest:
                continue
            z = camera + d * rise[v, u]
            b = beam[v, u]
            # A noisy depth moves a pixel along its ray: one that looks down moves up and down.
            lift = sigmas * at_1m * d * d * max(-rise[v, u], np.float32(0.0))
            if z < low + min(lift, low):
                clear[b] = max(clear[b], r)
            if z > low + lift and z < high:
                in_band[v, u] = r
                nearest[b] = min(nearest[b], r)
    total, count = np.zeros(beams), np.zeros(beams)
    for v in range(h):
        for u in range(w):
            r, b = in_band[v, u], beam[v, u]
            if r > 0 and r < nearest[b] + 0.01 + 4.0 * at_1m * nearest[b] * nearest[b]:
                total[b] += r
                count[b] += 1.0
    ranges = np.full(beams, np.inf)
    for b in range(beams):
        if count[b] >= support:
            ranges[b] = total[b] / count[b]
        elif count[b] > 0:
            clear[b] = min(clear[b], nearest[b])  # something may be there
    return ranges, clear, _behind(in_band, beam, ranges, *deep)


@njit(cache=True)
def _behind(in_band, beam, ranges, longest, support):
    """Peaks of the pixels' ranges behind the first surface of each beam."""
    h, w = in_band.shape
    bins = int(longest / BIN) + 2
    count, total = np.zeros((len(ranges), bins), dtype=np.int32), np.zeros((len(ranges), bins))
    for v in range(h):
        for u in range(w):
            r, b = in_band[v, u], beam[v, u]
            if r > 0 and r < longest and r > ranges[b] + APART:
                k = int(r / BIN)
                count[b, k] += 1
                total[b, k] += r
    found = np.empty((len(ranges) * 4, 2))
    n = 0
    for b in range(len(ranges)):
        for k in range(1, bins - 1):
            c = count[b, k]
            if c >= support and c >= count[b, k - 1] and c > count[b, k + 1] and n < len(found):
                found[n, 0], found[n, 1] = b, total[b, k] / c
                n += 1
    return found[:n]

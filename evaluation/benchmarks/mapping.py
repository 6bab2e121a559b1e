"""Mapping against plain NumPy: a scan into the grid, a depth picture, matching, look-ups, graph.

    python -m evaluation.benchmarks.mapping [--repeats 200]

Every row times both in this process on the same input, and checks that they agree. Compilation is
left out: the stack compiles once and keeps the result on disk.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np
from rich.console import Console
from rich.table import Table

from twin.layout import load_layout
from twin.messages import LidarScan, RgbdFrame
from twin.stack.config import nominal_config
from twin.stack.estimation.depth_to_scan import DepthToScan, HeightBand
from twin.stack.estimation.likelihood_field import LikelihoodField
from twin.stack.estimation.occupancy_grid import OccupancyGrid, SensorModel
from twin.stack.estimation.pose_graph import Edge, PoseGraph, edge_error, edge_jacobians
from twin.stack.estimation.scan_matching import match_scan
from twin.stack.estimation.scans import beam_angles, beam_points
from twin.stack.estimation.slam import compose_points
from twin.stack.estimation.surfaces import SurfaceMap

HALL = ((-8.12, -4.78), (8.08, 4.72))  # m, as large as the drawn plant: every beam returns
BIG = ((-19.5, -14.5), (19.5, 14.5))
POSE = np.array([1.0, 0.5, 0.3])
MODEL = SensorModel()


def hall_scan(rng: np.random.Generator, hall=HALL) -> LidarScan:
    """Scan of an empty hall by the vehicle's lidar: 1081 beams over 270 degrees."""
    first, step = -np.radians(135.0), np.radians(0.25)
    angle = first + step * np.arange(1081) + POSE[2]
    (x0, y0), (x1, y1) = hall
    x = np.where(np.cos(angle) > 0, x1 - POSE[0], x0 - POSE[0]) / np.cos(angle)
    y = np.where(np.sin(angle) > 0, y1 - POSE[1], y0 - POSE[1]) / np.sin(angle)
    return LidarScan(0.0, first, step, np.minimum(x, y) + rng.normal(0, 0.01, 1081), 30.0)


def numpy_insert(grid: OccupancyGrid, scan: LidarScan) -> None:
    """Rays sampled every half cell; each cell changes once, and end points outweigh rays."""
    angle = beam_angles(scan) + POSE[2]
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    share = np.arange(0, scan.ranges.max(), 0.5 * grid.resolution)
    r = np.where(share < scan.ranges[:, None] - 0.5 * grid.resolution, share, np.nan)
    points = POSE[:2] + (r[..., None] * unit[:, None])[np.isfinite(r)]
    ends = grid.cells(POSE[:2] + scan.ranges[:, None] * unit)
    mask = np.zeros(grid.shape, dtype=bool)
    cells = grid.cells(points)
    mask[cells[:, 0], cells[:, 1]] = True
    hit = np.zeros(grid.shape, dtype=bool)
    hit[ends[:, 0], ends[:, 1]] = True
    mask &= ~hit
    grid.log_odds[mask] = np.maximum(grid.log_odds[mask] + MODEL.miss, -MODEL.limit)
    grid.log_odds[hit] = np.minimum(grid.log_odds[hit] + MODEL.hit, MODEL.limit)


def numpy_depth(frame: RgbdFrame, converter: DepthToScan, camera, band: HeightBand):
    """Back-projection of all pixels, the band cut out, nearest range of each beam."""
    v, u = np.mgrid[: camera.height, : camera.width]
    d = 1e-3 * frame.depth_mm
    K, T = camera.matrix, camera.T_base_camera
    p = np.stack([(u - K[0, 2]) / K[0, 0] * d, (v - K[1, 2]) / K[1, 1] * d, d], axis=-1)
    p = p @ T[:3, :3].T
    height, r = p[..., 2] + T[2, 3], np.hypot(p[..., 0], p[..., 1])
    angle = np.arctan2(p[..., 1], p[..., 0])
    first = -0.5 * converter.beams * converter.increment
    beam = np.clip(((angle - first) / converter.increment).astype(int), 0, converter.beams - 1)
    good = (frame.depth_mm > 0) & (height > band.low) & (height < band.high) & (r < 3.0)
    ranges = np.full(converter.beams, np.inf)
    np.minimum.at(ranges, beam[good], r[good])
    return ranges


def numpy_search(field: LikelihoodField, points, guess):
    """Score of every pose of the lattice, a yaw at a time."""
    best, found = -np.inf, guess
    shift = np.arange(-5, 6) * 0.05
    for yaw in guess[2] + np.arange(-8, 9) * 0.0125:
        c, s = np.cos(yaw), np.sin(yaw)
        p = points @ np.array([[c, s], [-s, c]]) + guess[:2]
        q = p[None, None] + np.stack(np.meshgrid(shift, shift, indexing="ij"), -1)[:, :, None]
        cell = ((q - field.origin) / field.resolution).astype(int)
        cell = np.clip(cell, 0, np.array(field.distances.shape[::-1]) - 1)
        score = np.exp(-50 * field.distances[cell[..., 1], cell[..., 0]] ** 2).sum(axis=2)
        i, j = np.unravel_index(np.argmax(score), score.shape)
        if score[i, j] > best:
            best = score[i, j]
            found = np.array([guess[0] + shift[i], guess[1] + shift[j], yaw])
    return found


def numpy_nearest(field) -> np.ndarray:
    """Distance of every cell from every surface, a row of cells at a time."""
    h, w = field.distances.shape
    x = field.origin[0] + (np.arange(w) + 0.5) * field.resolution
    y = field.origin[1] + (np.arange(h) + 0.5) * field.resolution
    sx, sy = field.surfaces[:, 0], field.surfaces[:, 1]
    return np.array([np.hypot(x[:, None] - sx, v - sy).min(axis=1) for v in y])


def numpy_step(graph: PoseGraph) -> np.ndarray:
    """One Gauss-Newton step with the full matrix."""
    n = len(graph.poses)
    H, b = np.zeros((3 * n, 3 * n)), np.zeros(3 * n)
    H[:3, :3] += np.diag(graph.first_sigma**-2.0)
    for edge in graph.chain + graph.loops:
        i, j = slice(3 * edge.start, 3 * edge.start + 3), slice(3 * edge.to, 3 * edge.to + 3)
        (A, B), W = edge_jacobians(edge, graph.poses), np.linalg.inv(edge.covariance)
        e = edge_error(edge, graph.poses)
        H[i, i] += A.T @ W @ A
        H[j, j] += B.T @ W @ B
        H[i, j] += A.T @ W @ B
        H[j, i] += B.T @ W @ A
        b[i] += A.T @ W @ e
        b[j] += B.T @ W @ e
    return -np.linalg.solve(H, b).reshape(n, 3)


def milliseconds(work: Callable, repeats: int) -> float:
    """Median wall time of a call, after one that does not count."""
    work()
    took = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        took.append(time.perf_counter() - start)
    return 1e3 * float(np.median(took))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--repeats", type=int, default=200)
    repeats = parser.parse_args().repeats
    rng, slow = np.random.default_rng(0), max(repeats // 20, 3)
    table = Table("job", "ms", "NumPy ms", "ratio", "agreement")

    def row(job: str, fast: Callable, peer: Callable, agreement: str, fewer: bool = False):
        a, b = milliseconds(fast, slow if fewer else repeats), milliseconds(peer, slow)
        table.add_row(job, f"{a:.3f}", f"{b:.3f}", f"{b / a:.1f}", agreement)

    scan = hall_scan(rng)
    ours, theirs = (OccupancyGrid.covering((-8.6, -5.3), (8.6, 5.3), 0.05) for _ in range(2))
    for _ in range(4):
        ours.insert_scan(scan, POSE, MODEL)
        numpy_insert(theirs, scan)
    same = np.mean(ours.states() == theirs.states())
    row(
        "lidar scan into the grid, 1081 beams, 50 mm",
        lambda: ours.insert_scan(scan, POSE, MODEL),
        lambda: numpy_insert(theirs, scan),
        f"{same:.1%} of cells",
    )

    big, far = OccupancyGrid.covering((-20, -15), (20, 15), 0.05), hall_scan(rng, BIG)
    few = OccupancyGrid.covering((-20, -15), (20, 15), 0.05)
    row(
        "the same in a hall of 40 x 30 m",
        lambda: big.insert_scan(far, POSE, MODEL),
        lambda: numpy_insert(few, far),
        "",
        fewer=True,
    )

    layout = load_layout()
    camera, band = nominal_config(layout.site, layout.options).rgbd, HeightBand()
    v = np.arange(camera.height)[:, None] - camera.matrix[1, 2]
    below = np.where(v > 0, camera.T_base_camera[2, 3] * camera.focal / np.maximum(v, 1e-9), 9.0)
    depth = np.minimum(np.broadcast_to(below, (camera.height, camera.width)), 2.5)
    depth = depth + 0.004 * depth**2 * rng.standard_normal(depth.shape)
    picture = RgbdFrame(0.0, np.zeros((*depth.shape, 3), np.uint8), (1e3 * depth).astype(np.uint16))
    convert = DepthToScan(camera, band)
    grid = OccupancyGrid.covering((-8.6, -5.3), (8.6, 5.3), 0.05)
    model = SensorModel(max_range=3.0, blind=convert.blind)

    def picture_into_grid():
        seen = convert.convert(picture)
        if seen is not None:
            grid.insert_scan(seen.scan, POSE + seen.sensor_pose, model, seen.clear_to)
        return seen

    seen, nearest = picture_into_grid(), numpy_depth(picture, convert, camera, band)
    assert seen is not None
    both = np.isfinite(seen.scan.ranges) & np.isfinite(nearest)
    bias = 1e3 * np.median(seen.scan.ranges[both] - nearest[both])
    row(
        "depth picture to scan and into the grid, 424 x 240",
        picture_into_grid,
        lambda: numpy_depth(picture, convert, camera, band),
        f"nearest noisy pixel {bias:.0f} mm before the mean",
    )

    field = LikelihoodField(ours.occupied, ours.origin, ours.resolution, 0.5)
    points = beam_points(scan)
    guess = POSE + np.array([0.12, -0.09, 0.05])
    match, coarse = match_scan(field, points, guess), numpy_search(field, points[::6], guess)
    assert match is not None
    apart = 1e3 * np.hypot(*(match.pose - coarse)[:2])
    row(
        "scan to map, search and refinement (NumPy: search alone)",
        lambda: match_scan(field, points, guess),
        lambda: numpy_search(field, points[::6], guess),
        f"{apart:.0f} mm apart, lattice of 50 mm",
    )
    surfaces = SurfaceMap(ours.origin, ours.resolution, ours.shape)
    for _ in range(4):  # other scans than the one that is matched
        surfaces.add(compose_points(POSE, beam_points(hall_scan(rng))))
    fine = surfaces.field(0.5)
    found = match_scan(fine, points, guess)
    assert found is not None
    off_cells, off_fine = (1e3 * np.hypot(*(m.pose - POSE)[:2]) for m in (match, found))
    row(
        "scan to surfaces, search and refinement (NumPy: search alone)",
        lambda: match_scan(fine, points, guess),
        lambda: numpy_search(field, points[::6], guess),
        f"{off_fine:.0f} mm off the truth, {off_cells:.0f} by cells",
    )
    row(
        "nearest surfaces of all cells (NumPy: of each cell, one after the other)",
        lambda: surfaces.field(0.5, ours.occupied),
        lambda: numpy_nearest(fine),
        "",
        fewer=True,
    )
    row(
        "scan to map, refinement alone",
        lambda: match_scan(field, points, guess, search=False),
        lambda: numpy_search(field, points[::6], guess),
        "",
    )

    many = rng.uniform(-5, 5, (100_000, 2))

    def numpy_lookup():
        cell = ((many - field.origin) / field.resolution).astype(int)
        inside = np.all((cell >= 0) & (cell < field.distances.shape[::-1]), axis=1)
        cell = np.where(inside[:, None], cell, 0)
        return np.where(inside, field.distances[cell[:, 1], cell[:, 0]], field.max_distance)

    equal = np.mean(numpy_lookup() == field.lookup(many))
    row("distance of 100,000 points", lambda: field.lookup(many), numpy_lookup, f"{equal:.1%}")

    graph, covariance = PoseGraph(np.zeros(3), np.full(3, 1e-3)), np.diag([4e-4, 4e-4, 1e-4])
    for _ in range(400):
        graph.append(np.array([0.3, 0.0, 0.05]) + rng.normal(0, 0.01, 3), covariance)
    for k in range(0, 300, 60):
        graph.close(Edge(k, k + 100, np.array([0.1, 0.1, 0.0]), covariance), gate=np.inf)
    off = np.abs(graph._step() - numpy_step(graph)).max()
    row(
        "pose graph, one step, 401 nodes and 5 loops (NumPy: full matrix)",
        graph._step,
        lambda: numpy_step(graph),
        f"within {off:.0e}",
        fewer=True,
    )
    Console(width=140).print(table)


if __name__ == "__main__":
    main()

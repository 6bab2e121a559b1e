"""Photoelectric network: P3P against OpenCV and PoseLib, a full fix, calibration against SciPy.

    python -m evaluation.benchmarks.beacons [--cases 1000000] [--repeats 200]

P3P problems are random: nodes in a box of 2 m, the head 0.5 to 6 m from its middle in any
attitude, for OpenCV and PoseLib turned so that the nodes lie ahead. A case counts as degenerate,
and is left out of the failures, if its nodes are a line or the head is on the danger cylinder. A
failure is a case whose true pose is not among the solutions to 1e-6 m; with the fourth node, one of
which the pose that it picks does not put the four where they are seen. PoseLib is compared where it
is installed: a development dependency. A fix is made as the stack makes it, of a vehicle on the
floor with a calibrated head. Criteria: 4 times cv2.solveP3P, faster than PoseLib, no failure in
`--cases` that are not degenerate, 0.5 ms a fix of a vehicle that sees all nodes once, 5 times SciPy
with a numeric Jacobian at equal cost. Exit code 1 if one is not met.
"""

import argparse
import importlib
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from evaluation.beacon_field import FIELD_X, FIELD_Y, WEST
from twin.geometry import Array, inverse, look_at, pose2_to_transform, rot_z, transform
from twin.layout import load_layout
from twin.stack.config import BeaconHead
from twin.stack.estimation.beacon_receiver import HEIGHT, TILT
from twin.stack.estimation.beacons.angles import TAU, Crossings, angles_of
from twin.stack.estimation.beacons.calibration import Bundle, calibrate
from twin.stack.estimation.beacons.fix import Fix, Locator
from twin.stack.estimation.beacons.p3p import DANGER, conditioning, p3p, p3p_checked
from twin.stack.estimation.beacons.stamps import (
    PLANE_1,
    PLANE_2,
    SYNC,
    Counter,
    HeadParameters,
    NodeSurvey,
    Noise,
    StampBatch,
    SyncSequence,
)

NAMES = ("T1", "T2", "T3", "T4", "T5", "T6")
TRUSS = np.array(
    [[4, -1, 0.2], [4, 1, 0.2], [4, 1, 1.2], [4, -1, 1.2], [4, -0.25, 1.2], [4, 0.3, 0.2]], float
)
MOUNT = transform(rot_z(-2.5), (0.1, 0.0, 0.6))
# Of planes and mount, as a calibration drive leaves it, rad and m.
LEFT_OPEN = np.diag(np.array([2e-5, 2e-5, 8e-5, 8e-4, 9e-4, 1e-5, 1e-5, 1e-5, 1.8e-3]) ** 2)
STANDING, DRIVING = np.zeros(3), np.array([0.5, -0.2, 0.0])  # m/s
SOUND: dict[int, Array] = {}
MIRRORED = {
    1: np.array([0.0, 0.1, 0.25]),
    2: np.array([0.0, 0.004, -0.003]),
}  # far off, and close by
CHUNK = 50_000  # problems at a time, so that a million fit in memory
LINE, CYLINDER = 0.02, 1e-3  # sine of the sides and conditioning below which a case is degenerate
WITHIN = 1e-6  # m, of the true places in head
COMPARED = 2000  # problems that the others solve


def problems(n: int, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Nodes in world and in head, (n, 4, 3) each, and whether they are not degenerate (n,)."""
    q = rng.standard_normal((n, 4))
    w, x, y, z = (q / np.linalg.norm(q, axis=1)[:, None]).T
    R = np.stack(
        [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ],
        axis=1,
    ).reshape(n, 3, 3)
    p_world = rng.uniform(-1, 1, (n, 4, 3))
    away = rng.standard_normal((n, 3))
    origin = away / np.linalg.norm(away, axis=1)[:, None] * rng.uniform(0.5, 6.0, (n, 1))
    p_head = np.einsum("nij,nkj->nki", R, p_world - origin[:, None])
    d = np.linalg.norm(p_head[:, :3], axis=2)
    f = p_head[:, :3] / d[:, :, None]
    rows = np.zeros((n, 3, 3))
    sides = []
    for k, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
        c = np.sum(f[:, i] * f[:, j], axis=1)
        rows[:, k, i], rows[:, k, j] = d[:, i] - d[:, j] * c, d[:, j] - d[:, i] * c
        sides.append(p_world[:, j] - p_world[:, i])
    rows /= np.linalg.norm(rows, axis=2)[:, :, None]
    long = np.sort([np.linalg.norm(s, axis=1) for s in sides], axis=0)
    sine = np.linalg.norm(np.cross(sides[0], sides[1]), axis=1) / (long[1] * long[2])
    return p_world, p_head, (sine > LINE) & (np.abs(np.linalg.det(rows)) > CYLINDER)


def failures(cases: int) -> tuple[int, int, int, float, float]:
    """Sound cases, those failed by P3P and with the fourth node, and microseconds of either.

    Args:
        cases: that are not degenerate, at least.
    """
    rng, tried, failed, mistaken = np.random.default_rng(0), 0, 0, 0
    spent, checked, done = 0.0, 0.0, 0
    while tried < cases:
        n = min(CHUNK, cases)
        p_world, p_head, sound = problems(n, rng)
        start = time.perf_counter()
        found = p3p(p_head[:, :3], p_world[:, :3])
        middle = time.perf_counter()
        R, t, _ = p3p_checked(p_head, p_world)
        spent, checked = spent + middle - start, checked + time.perf_counter() - middle
        p = np.einsum("nkij,nmj->nkmi", found.R, p_world[:, :3]) + found.t[:, :, None]
        off = np.abs(p - p_head[:, None, :3]).max(axis=(2, 3))
        good = np.min(np.where(np.isnan(off), np.inf, off), axis=1) < WITHIN
        picked = np.einsum("nij,nmj->nmi", R, p_world) + t[:, None]
        right = np.abs(picked - p_head).max(axis=(1, 2)) < WITHIN
        tried, done = tried + int(sound.sum()), done + n
        failed, mistaken = (
            failed + int((sound & ~good).sum()),
            mistaken + int((sound & ~right).sum()),
        )
    return tried, failed, mistaken, 1e6 * spent / done, 1e6 * checked / done


def others() -> dict[str, float]:
    """Microseconds of one solve by cv2.solveP3P and by PoseLib, both called in a Python loop."""
    rng = np.random.default_rng(1)
    p_world, p_head, _ = problems(COMPARED, rng)
    turned = [inverse(look_at(np.zeros(3), p[:3].mean(axis=0))) for p in p_head]
    ahead = np.einsum("nij,nkj->nki", np.array(turned)[:, :3, :3], p_head)[:, :3]
    keep = ahead[:, :, 2].min(axis=1) > 0.05
    nodes, rays = np.ascontiguousarray(p_world[keep, :3]), ahead[keep]
    pixels = np.ascontiguousarray(rays[:, :, :2] / rays[:, :, 2:])
    unit = rays / np.linalg.norm(rays, axis=2)[:, :, None]
    eye, n, found = np.eye(3), int(keep.sum()), {}
    for label, flag in (("P3P", cv2.SOLVEPNP_P3P), ("AP3P", cv2.SOLVEPNP_AP3P)):
        start = time.perf_counter()
        for k in range(n):
            cv2.solveP3P(nodes[k], pixels[k], eye, None, flag)
        found[f"cv2.solveP3P {label}"] = 1e6 * (time.perf_counter() - start) / n
    try:
        poselib = importlib.import_module("poselib")
    except ImportError:
        return found
    start = time.perf_counter()
    for k in range(n):
        poselib.p3p(unit[k], nodes[k])
    found["PoseLib p3p"] = 1e6 * (time.perf_counter() - start) / n
    return found


def stamps(
    rng: np.random.Generator, velocity: Array = STANDING, images: dict[int, Array] = SOUND
) -> StampBatch:
    """One revolution, all six nodes, each on a clock of its own.

    Args:
        rng: draws noise and clocks.
        velocity: of the head in world, m/s. Shape (3,).
        images: shifts in world of images beside nodes, m, by number of the node. Shape (3,) each.
    """
    noise, counter, turn = Noise(), Counter(), 1.0 / 30.0
    nodes = [[p, p + images[i]] if i in images else [p] for i, p in enumerate(TRUSS)]
    theta = [crossed(np.array(seen), velocity, turn) for seen in nodes]
    pulses = SyncSequence().times(np.arange(1, 9)) - 2e-3
    channel, kind, ticks = [], [], []
    for i in range(7):
        planes = (np.array([0.0, turn]), np.zeros(0)) if i == 0 else (theta[i - 1].T / TAU * turn)
        events = [pulses + noise.sync * rng.standard_normal(len(pulses))]
        events += [p + noise.crossing * rng.standard_normal(len(p)) for p in planes]
        times = np.concatenate(events) + 0.01
        order = np.argsort(times)
        rate = 1.0 + 1e-4 * rng.standard_normal()
        ticks.append((times[order] * rate / counter.tick).astype(np.int64) + i * 10**8)
        kind.append(np.repeat([SYNC, PLANE_1, PLANE_2], [len(e) for e in events])[order])
        channel.append(np.full(len(times), i))
    return StampBatch(NAMES, *(np.concatenate(part) for part in (channel, kind, ticks)))


def crossed(places: Array, velocity: Array, turn: float) -> Array:
    """Angles at which a head that drives meets places, (n, 3) in world to (n, 2).

    It is at `MOUNT` in the middle of the turn.
    """
    theta = np.full((len(places), 2), np.pi)
    for _ in range(4):  # where the head is when it meets them depends on when it does
        origin = MOUNT[:3, 3] + (theta[..., None] / TAU - 0.5) * turn * velocity
        p = (places[:, None] - origin) @ MOUNT[:3, :3]
        theta = np.stack([angles_of(p[:, k], HeadParameters())[:, k] for k in range(2)], axis=1)
    return theta


def survey() -> NodeSurvey:
    return NodeSurvey(NAMES, TRUSS, np.full(6, 30e-6))


def timed(run: Callable[[], object], repeats: int) -> list[float]:
    """Milliseconds of each of `repeats` runs after one to warm up."""
    found = []
    for i in range(repeats + 1):
        start = time.perf_counter()
        run()
        if i:
            found.append(1e3 * (time.perf_counter() - start))
    return found


def calibrations(repeats: int) -> tuple[float, float, float, float]:
    """Milliseconds of ours and of SciPy's on six stops, and the costs both end at."""
    from scipy.optimize import least_squares  # a development dependency

    rng, sigma = np.random.default_rng(2), 50e-6
    built = HeadParameters(np.pi / 4 + 0.004, np.pi / 4 - 0.003, np.pi / 2 + 0.005)
    node, plane, stops = np.repeat(np.arange(6), 2), np.tile([0, 1], 6), []
    for x, y, yaw in ((0, 0, 0), (0.8, 0.6, 0.3), (-0.4, -0.6, -0.3), (0.5, -0.8, 0.5),
                      (1, 0.2, -0.4), (-0.3, 0.7, 0.2)):  # fmt: skip
        T = transform(rot_z(yaw), (x, y, 0.0)) @ MOUNT
        theta = angles_of((TRUSS - T[:3, 3]) @ T[:3, :3], built).ravel()
        theta = theta + sigma * rng.standard_normal(12)
        stops.append(Crossings(node, plane, theta, np.zeros(12), sigma**2 * np.eye(12), 188.5))
    start = HeadParameters()
    ours = timed(lambda: calibrate(stops, survey(), start), repeats)

    def theirs():
        bundle = Bundle(stops, survey(), start)
        return least_squares(bundle.residuals, np.zeros(bundle.unknowns), x_scale="jac")

    spent = timed(theirs, max(repeats // 10, 3))
    cost = calibrate(stops, survey(), start).cost
    return statistics.median(ours), statistics.median(spent), cost, 2 * theirs().cost


def near_the_cylinder(rng: np.random.Generator) -> float:
    """Share of places before the default cell's truss where three of its corners tell no pose.

    Places are those of the field; the source's method is decimetres off there.
    """
    network = load_layout().site.beacons
    assert network is not None
    corners, near = np.array([node.position for node in network.nodes[:3]]), []
    for _ in range(10_000):
        pose = rng.uniform(*FIELD_X), rng.uniform(*FIELD_Y), WEST + rng.uniform(-0.4, 0.4)
        T = pose2_to_transform(pose) @ BeaconHead().T_base_head
        near.append(conditioning((corners - T[:3, 3]) @ T[:3, :3]) < DANGER)
    return float(np.mean(near))


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--cases", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=200)
    asked = parser.parse_args()
    failures(100)  # compiles
    tried, failed, mistaken, solve, checked = failures(asked.cases)
    table = Table("what", "time", "ratio to ours")
    table.add_row("P3P, up to four poses (Eqs. 9-22), batch", f"{solve:.2f} us", "")
    table.add_row("P3P and the fourth node's choice, batch", f"{checked:.2f} us", "1")
    found = others()
    for label, spent in found.items():
        table.add_row(label, f"{spent:.2f} us", f"{spent / checked:.1f}")
    locator = Locator(
        *(survey(), HeadParameters(), MOUNT, LEFT_OPEN), height=HEIGHT, tilt=TILT, noise=Noise()
    )
    whole = []
    twist = np.concatenate([DRIVING, np.zeros(3)])  # base and world have the same axes
    far, close = ({k: MIRRORED[k]} for k in MIRRORED)
    for label, velocity, images, moving in (
        ("standing", STANDING, SOUND, None),
        ("driving", DRIVING, SOUND, twist),
        ("standing, a node beside its image 27 cm off", STANDING, far, None),
        ("standing, a node beside its image 5 mm off", STANDING, close, None),
        ("driving, a node beside its image 27 cm off", DRIVING, far, twist),
    ):
        batch = stamps(np.random.default_rng(3), velocity, images)
        assert isinstance(locator.fix(batch, moving), Fix)
        fixes = timed(partial(locator.fix, batch, moving), asked.repeats)
        table.add_row(
            f"full fix from raw stamps, {label}", f"{statistics.median(fixes):.3f} ms", ""
        )
        if images is SOUND:
            whole.append(statistics.median(fixes))
    ours, theirs, cost, their_cost = calibrations(max(asked.repeats // 10, 3))
    table.add_row("calibration, six stops", f"{ours:.1f} ms", "1")
    table.add_row("scipy.optimize.least_squares", f"{theirs:.1f} ms", f"{theirs / ours:.1f}")
    Console().print(table)
    Console().print(f"P3P: {failed} failures in {tried} cases that are not degenerate")
    Console().print(f"P3P and fourth node: {mistaken} failures in the same cases")
    near = near_the_cylinder(np.random.default_rng(4))
    Console().print(
        f"three corners of the truss: {near:.3f} of the field near their danger cylinder"
    )
    Console().print(f"calibration: cost {cost:.6f}, SciPy's {their_cost:.6f}")
    fastest = min(spent for label, spent in found.items() if label.startswith("cv2"))
    met = {
        "4 times cv2.solveP3P": fastest >= 4.0 * checked,
        "faster than PoseLib": found.get("PoseLib p3p", np.inf) > checked,
        "no failure": failed == mistaken == 0 and tried >= asked.cases,
        "a full fix in 0.5 ms": max(whole) <= 0.5,
        "5 times SciPy": theirs >= 5.0 * ours,
        "at equal cost": abs(cost - their_cost) <= 1e-6 * their_cost,
    }
    missed = [name for name, good in met.items() if not good]
    Console().print(f"not met: {', '.join(missed)}" if missed else "every criterion met")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())

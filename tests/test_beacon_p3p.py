"""P3P against truth and OpenCV, the SVD pose, the fourth node (Liu et al. 2022, Eqs. 9-28)."""

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from twin.geometry import apply, inverse, rot_x, rot_y, rot_z, rotation_from_quat, transform
from twin.stack.estimation.beacons.p3p import (
    conditioning,
    p3p,
    p3p_checked,
    triple_fault,
    virtual_plane_error,
)
from twin.stack.estimation.beacons.quartic import distances, real_roots
from twin.stack.estimation.beacons.rigid import euler_xyz, exp_rotation, rigid_fit, rotation_of

seeds = st.integers(0, 2**32 - 1)
first_compiles = settings(deadline=None)


def random_case(seed, n=4):
    """Nodes in a box, and a head somewhere about it: p_world (n, 3), T_head_world."""
    rng = np.random.default_rng(seed)
    R = rotation_from_quat(rng.standard_normal(4))
    away = rng.standard_normal(3)
    origin = away / np.linalg.norm(away) * rng.uniform(0.5, 6.0)
    return rng.uniform(-1, 1, (n, 3)), transform(R, -R @ origin)


@first_compiles
@given(st.lists(st.floats(-3, 3), min_size=4, max_size=4))
def test_quartic_with_known_roots(roots):
    assume(min(abs(a - b) for i, a in enumerate(roots) for b in roots[:i]) > 0.05)
    c, out = np.poly(roots), np.empty(4)
    assert real_roots(*c, out) == 4
    assert np.sort(out) == pytest.approx(np.sort(roots), abs=1e-6)


@first_compiles
@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(0.3, 2), st.floats(-2, 2))
def test_quartic_with_two_complex_roots(a, b, height, middle):
    assume(abs(a - b) > 0.05)
    c, out = np.poly([a, b, middle + 1j * height, middle - 1j * height]).real, np.empty(4)
    count = real_roots(*c, out)
    for root in (a, b):
        assert np.min(np.abs(out[:count] - root)) < 1e-6


def test_quartic_without_odd_terms():
    out = np.empty(4)
    assert real_roots(1.0, 0.0, -5.0, 0.0, 4.0, out) == 4
    assert np.sort(out) == pytest.approx([-2, -1, 1, 2])


def test_eqs_11_to_13_by_hand():
    """Corner of a cube: nodes on the axes at 1, 2, 3 and right angles between the rays.

    Expected result: d1 = 1, d2 = 2, d3 = 3 solves Eq. 9 with squared sides 5, 10, 13, alone.
    """
    out = np.empty((4, 4))
    assert distances(0.0, 0.0, 0.0, 5.0, 10.0, 13.0, 0.0, out, np.empty(4)) == 1
    assert out[0, :3] == pytest.approx([1, 2, 3])


@first_compiles
@given(seeds)
def test_eqs_9_to_13_as_printed_hold_at_every_solution(seed):
    """With the print's slips mended: w's ratio in Eq. 11, x and y of Eq. 12's second line."""
    p_world, T = random_case(seed, 3)
    p_head = apply(T, p_world)
    assume(conditioning(p_head) > 0.01 and triple_fault(p_world) is None)
    f = p_head / np.linalg.norm(p_head, axis=1)[:, None]
    cab, cac, cbc = f[0] @ f[1], f[0] @ f[2], f[1] @ f[2]
    s12, s13, s23 = (np.sum((p_world[i] - p_world[j]) ** 2) for i, j in ((0, 1), (0, 2), (1, 2)))
    out = np.empty((4, 4))
    n = distances(cab, cac, cbc, s12, s13, s23, 0.0, out, np.empty(4))
    assert n >= 1
    v, w = s23 / s12, s13 / s12
    for d1, d2, d3 in out[:n, :3]:
        assert d1**2 + d2**2 - 2 * d1 * d2 * cab == pytest.approx(s12, abs=1e-7)  # Eq. 9
        x, y = d1 / d3, d2 / d3
        u = s12 / d3**2
        assert x**2 + 1 - 2 * x * cac == pytest.approx(w * u, abs=1e-6)  # Eq. 11
        assert y**2 + 1 - 2 * y * cbc == pytest.approx(v * u, abs=1e-6)
        scale = 1 + w * (x**2 + y**2) + v * (x**2 + y**2) + x**2 + y**2
        one = (1 - w) * x**2 - w * y**2 - 2 * x * cac + 2 * w * x * y * cab + 1  # Eq. 12
        two = (1 - v) * y**2 - v * x**2 - 2 * y * cbc + 2 * v * x * y * cab + 1
        assert abs(one) < 1e-6 * scale and abs(two) < 1e-6 * scale
        b1 = 2 * w * (cab * x - cbc)  # Eq. 13
        b0 = (v + w - 1) * x**2 + 2 * (1 - v) * cac * x + v - w - 1
        assert abs(b1 * y - b0) < 1e-6 * scale


@first_compiles
@given(seeds)
def test_p3p_finds_the_truth(seed):
    p_world, T = random_case(seed)
    p_head = apply(T, p_world)
    assume(conditioning(p_head[:3]) > 1e-3 and triple_fault(p_world[:3]) is None)
    found = p3p(p_head[:3], p_world[:3])
    n = int(found.count[0])
    assert 1 <= n <= 4
    errors = [np.abs(found.R[0, k] - T[:3, :3]).max() + np.abs(found.t[0, k] - T[:3, 3]).max()
              for k in range(n)]  # fmt: skip
    best = int(np.argmin(errors))
    assert errors[best] < 1e-6
    assert found.position[0, best] == pytest.approx(inverse(T)[:3, 3], abs=1e-6)  # Eqs. 27, 28
    for k in range(n):  # every solution obeys Eq. 9 and Eq. 17
        p = found.R[0, k] @ p_world[:3].T + found.t[0, k][:, None]
        rays = p_head[:3] / np.linalg.norm(p_head[:3], axis=1)[:, None]
        assert pytest.approx(rays * found.distances[0, k][:, None], abs=1e-6) == p.T


@first_compiles
@given(seeds)
def test_p3p_against_opencv(seed):
    """Whatever pose OpenCV finds with all nodes ahead is among ours."""
    p_world, T = random_case(seed, 3)
    p_head = apply(T, p_world)
    assume(p_head[:, 2].min() > 0.3)
    assume(conditioning(p_head) > 0.01 and triple_fault(p_world) is None)
    pixels = p_head[:, :2] / p_head[:, 2:]
    _, rvecs, tvecs = cv2.solveP3P(p_world, pixels, np.eye(3), None, cv2.SOLVEPNP_P3P)
    ours = p3p(p_head, p_world)
    for rvec, tvec in zip(rvecs, tvecs, strict=True):
        R, t = cv2.Rodrigues(rvec)[0], tvec.ravel()
        off = np.abs(R @ p_world.T + t[:, None] - p_head.T)
        seen = (R @ p_world.T + t[:, None]).T
        if seen[:, 2].min() < 0 or np.abs(seen[:, :2] / seen[:, 2:] - pixels).max() > 1e-9:
            continue  # not a solution to our precision
        k = int(ours.count[0])
        errors = [np.abs(ours.R[0, i] - R).max() + np.abs(ours.t[0, i] - t).max() for i in range(k)]
        assert min(errors) < 1e-4, off


@first_compiles
@given(seeds)
def test_the_fourth_node_picks_the_pose(seed):
    p_world, T = random_case(seed)
    p_head = apply(T, p_world)
    assume(conditioning(p_head[:3]) > 0.01 and triple_fault(p_world[:3]) is None)
    R, t, psi = p3p_checked(p_head, p_world)
    alone = p3p(p_head[:3], p_world[:3])
    others = [np.abs(alone.R[0, k] - T[:3, :3]).max() for k in range(int(alone.count[0]))]
    assert psi[0] < 1e-10
    if sum(error < 0.01 for error in others) == 1:
        assert R[0] == pytest.approx(T[:3, :3], abs=1e-5)
        assert t[0] == pytest.approx(T[:3, 3], abs=1e-5)


def test_batches_are_the_single_problems():
    cases = [random_case(seed) for seed in range(20)]
    p_world = np.array([c[0] for c in cases])
    p_head = np.array([apply(T, p) for p, T in cases])
    R, _, _ = p3p_checked(p_head, p_world)
    for k in range(20):
        assert np.array_equal(p3p_checked(p_head[k], p_world[k])[0][0], R[k], equal_nan=True)
    same = p3p(p_head[:, :3], p_world[0, :3])  # one set of nodes for all
    assert same.R[0] == pytest.approx(p3p(p_head[0, :3], p_world[0, :3]).R[0], nan_ok=True)
    with pytest.raises(ValueError, match="20 sets of rays, 3"):
        p3p(p_head[:, :3], p_world[:3, :3])


def test_eqs_25_and_26_by_hand():
    # The plane X = 1 is at right angles to the ray x; the point is met at (1, 0.1, 0): psi = 0.01.
    tau = np.array([1.0, 0, 0])
    assert virtual_plane_error(tau, np.array([2.0, 0.2, 0.0])) == pytest.approx(0.01)
    assert virtual_plane_error(tau, np.array([2.0, 0.0, 0.0])) == 0.0  # where Y = 1 sees nothing
    assert virtual_plane_error(tau, np.array([-2.0, 0.0, 0.0])) == np.inf


@first_compiles
@given(seeds, st.integers(3, 8))
def test_svd_pose_of_exact_points(seed, n):
    p_a, T = random_case(seed, n)
    assume(triple_fault(p_a[:3]) is None)
    assert rigid_fit(p_a, apply(T, p_a)) == pytest.approx(T, abs=1e-8)


@first_compiles
@given(seeds)
def test_svd_rotation_is_proper_and_best(seed):
    """Eqs. 20, 21 with the reflection's correction, against LAPACK; any matrix, flat ones too."""
    rng = np.random.default_rng(seed)
    for H in (
        rng.standard_normal((3, 3)),
        rng.standard_normal((3, 2)) @ rng.standard_normal((2, 3)),
    ):
        R = np.empty((3, 3))
        assert rotation_of(H, R, np.empty((2, 3, 3)))
        assert pytest.approx(np.eye(3), abs=1e-9) == R @ R.T
        assert np.linalg.det(R) == pytest.approx(1.0)
        U, S, Vt = np.linalg.svd(H)
        sign = np.sign(np.linalg.det(Vt.T @ U.T))
        assert np.trace(R @ H) == pytest.approx(S[0] + S[1] + sign * S[2], abs=1e-9)


@first_compiles
@given(seeds)
def test_closed_form_of_three_points_is_the_svd(seed):
    p_world, T = random_case(seed, 3)
    p_head = apply(T, p_world)
    assume(conditioning(p_head) > 0.01 and triple_fault(p_world) is None)
    found = p3p(p_head, p_world)
    for k in range(int(found.count[0])):
        unit = p_head / np.linalg.norm(p_head, axis=1)[:, None]
        svd = rigid_fit(p_world, unit * found.distances[0, k][:, None])
        assert found.R[0, k] == pytest.approx(svd[:3, :3], abs=1e-7)
        assert found.t[0, k] == pytest.approx(svd[:3, 3], abs=1e-6)
        assert np.linalg.det(found.R[0, k]) == pytest.approx(1.0)


def test_mirrored_points_get_a_rotation_not_a_reflection():
    p = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    T = rigid_fit(p, p * [1, 1, -1])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


def test_points_on_a_line_have_no_rotation():
    p = np.outer([0.0, 1, 2.5], [1.0, 2, 3])
    with pytest.raises(ValueError, match="line"):
        rigid_fit(p, p)
    fault = triple_fault(p)
    assert fault is not None and fault.reason == "collinear nodes"


@first_compiles
@given(st.floats(-3, 3), st.floats(-1.5, 1.5), st.floats(-3, 3))
def test_eq_16(a, b, c):
    assert euler_xyz(rot_x(a) @ rot_y(b) @ rot_z(c)) == pytest.approx([a, b, c], abs=1e-9)


def test_rotation_vector():
    assert exp_rotation(np.array([0, 0, 0.3])) == pytest.approx(rot_z(0.3))
    assert exp_rotation(np.array([1e-6, 0, 0])) == pytest.approx(rot_x(1e-6), abs=1e-16)


def test_danger_cylinder_shows_in_the_conditioning():
    angles = np.radians([0.0, 100.0, 220.0])
    p_world = np.stack([np.cos(angles), np.sin(angles), np.zeros(3)], axis=1)
    for radius, low in ((1.0, True), (0.3, False), (2.0, False)):
        origin = np.array([radius, 0.0, 3.0])
        assert (conditioning(p_world - origin) < 1e-9) == low
    near = p3p(p_world - [1.0, 0.0, 3.0 + 1e-3], p_world)
    assert np.nanmin(near.conditioning) < 1e-2
    # That of the solver and that of the points are one.
    p_world, T = random_case(1, 3)
    p_head = apply(T, p_world)
    found = p3p(p_head, p_world)
    off = np.abs(found.distances[0] - np.linalg.norm(p_head, axis=1)).sum(axis=1)
    assert found.conditioning[0, np.nanargmin(off)] == pytest.approx(conditioning(p_head))

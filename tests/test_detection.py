"""Contour detection: stored pictures, fresh renders, and the geometry under it."""

import numpy as np
import pytest
from belt_frames import BeltStudio, errors, load

from twin.layout import load_layout
from twin.messages import CameraFrame
from twin.stack.config import nominal_config
from twin.stack.detection.catalogue import CATALOGUE
from twin.stack.detection.classify import ground_point
from twin.stack.detection.contour import ContourDetector
from twin.stack.detection.silhouette import (
    Outline,
    centroid,
    draw,
    moments,
    overlap,
    projection,
    shifted,
)  # fmt: skip

layout = load_layout()
config = nominal_config(layout.site, layout.options)


@pytest.fixture(scope="module")
def detector():
    return ContourDetector(config)


def judge(results, visible: int) -> None:
    """The aims: centroid 1 mm and axis within 3 degrees at p95 up close, class right in 97 %."""
    right, distance, angle, x = np.array(results, dtype=float).T
    near = (x > 0.35) & (x < 0.60)
    assert len(results) >= 0.97 * visible
    assert right.mean() >= 0.97
    assert np.percentile(distance[near], 95) < 1e-3
    assert np.median(distance[near]) < 3e-4
    assert np.percentile(angle[near], 95) < np.radians(3.0)
    assert np.median(angle[near]) < np.radians(1.0)


def surely_visible(labels) -> int:
    return sum(0.38 < x < 0.75 for _, x, _, _ in labels)


def test_stored_pictures(detector):
    results, visible = [], 0
    for frame, pose, labels in load():
        results += errors(detector.detect(frame, pose), labels)
        visible += surely_visible(labels)
    judge(results, visible)


def test_fresh_pictures(detector):
    studio = BeltStudio(seed=11)
    results, visible = [], 0
    for _ in range(25):
        frame, pose, labels = studio.shoot()
        results += errors(detector.detect(frame, pose), labels)
        visible += surely_visible(labels)
    studio.close()
    judge(results, visible)


def test_empty_belt_and_no_belt(detector):
    empty = np.full((480, 640, 3), (35, 60, 52), np.uint8)
    noisy = np.clip(empty + np.random.default_rng(0).normal(0, 2, empty.shape), 0, 255)
    frame = CameraFrame(0.0, noisy.astype(np.uint8))
    assert detector.detect(frame, np.array(layout.site.pick)) == ()
    assert detector.detect(frame, np.array(layout.site.dock)) == ()


def test_part_cut_by_the_window_is_ignored(detector):
    frame, pose, _ = load()[0]
    for d in detector.detect(frame, pose):
        polygon = detector.window(pose).astype(np.float32)
        low, high = polygon.min(axis=0), polygon.max(axis=0)
        assert (d.contour_px > low).all() and (d.contour_px < high).all()


def test_ground_point_inverts_projection():
    P = projection(config.camera)
    rng = np.random.default_rng(0)
    for _ in range(50):
        p = np.array([*rng.uniform((0.35, 0.36), (0.8, 0.54)), rng.uniform(0.69, 0.73)])
        uvw = P @ (*p, 1)
        np.testing.assert_allclose(ground_point(P, *uvw[:2] / uvw[2], p[2]), p[:2], atol=1e-12)


def test_drawn_silhouette_of_a_block_has_its_area_and_place():
    """A thin plate seen straight from above, 1 px a millimetre."""
    P = np.array([[1000.0, 0, 0, 0], [0, 1000.0, 0, 0], [0, 0, 0, 1]])
    plate = np.array([(x, y, 0.0) for x in (-0.010, 0.010) for y in (-0.005, 0.005)])
    mask = np.zeros((60, 60), np.uint8)
    for yaw in np.linspace(0, 3, 7):
        pose = np.array([0.0303, 0.0296, yaw])
        draw(plate, np.array([0, 4]), pose, 0.0, P, mask)
        area, u, v = centroid(mask)
        assert area == pytest.approx(200, abs=12)
        np.testing.assert_allclose((u, v), (30.3, 29.6), atol=0.3)
        m = moments(mask)
        axis = 0.5 * np.arctan2(2 * m[4], m[3] - m[5])
        assert abs(np.sin(axis - yaw)) < 0.04


def test_shrunk_projection_keeps_pixel_centres():
    P = projection(config.camera)
    p = (0.5, 0.45, 0.7, 1)
    u, v = (P @ p)[:2] / (P @ p)[2]
    q = shifted(P, 10, 20, 2.0) @ p
    np.testing.assert_allclose(q[:2] / q[2], ((u - 10.5) / 2, (v - 20.5) / 2))


def test_outlines_differ():
    """No two classes can be laid upon each other, at any yaw, at the middle of the window."""
    P = projection(config.camera)
    u, v, w = P @ (0.5, 0.45, 0.71, 1)
    P = shifted(P, round(u / w) - 45, round(v / w) - 45)
    masks = {}
    for name, drawing in CATALOGUE.items():
        outline = Outline.of(drawing)
        masks[name] = []
        for yaw in np.linspace(-np.pi, np.pi, 36, endpoint=False):
            mask = np.zeros((90, 90), np.uint8)
            pose = np.array([0.5, 0.45, yaw])
            draw(outline.points, outline.starts, pose, 0.7, P, mask)
            masks[name].append(mask)
    names = list(masks)
    for i, first in enumerate(names):
        for second in names[i + 1 :]:
            best = max(overlap(a, b, 0, 0) for a in masks[first] for b in masks[second])
            assert best < 0.97, (first, second, best)

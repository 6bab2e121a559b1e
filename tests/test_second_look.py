"""The second look: patches to one scale, and what both looks say together."""

import numpy as np
import pytest

from twin.geometry import rot_x, transform
from twin.layout import load_layout
from twin.stack.config import Camera, nominal_config
from twin.stack.detection.boxes import Boxes
from twin.stack.detection.network import Network
from twin.stack.detection.second_look import FIRST_SAYS, SIDE, SPAN, agreed, patches, scale_at

layout = load_layout()
config = nominal_config(layout.site, layout.options)
DOWN = Camera(640, 480, 60.0, transform(rot_x(np.pi), (0.0, 0.0, 1.5)))  # looks straight down


def test_scale_by_hand():
    """A camera 1 m above the belt: a metre there is the focal length, wherever it is seen."""
    for centre in ((319.5, 239.5), (20.0, 400.0)):
        assert scale_at(DOWN, centre, 0.5) == pytest.approx(DOWN.focal)
    assert scale_at(DOWN, (319.5, 239.5), 1.0) == pytest.approx(2 * DOWN.focal)


def test_scale_is_that_of_the_projection():
    """Two points of the belt, 1 mm apart across the line of sight, against the camera's matrix."""
    camera, z = config.camera, layout.site.line.height
    P = camera.matrix @ np.linalg.inv(camera.T_base_camera)[:3]
    across = 1e-3 * camera.T_base_camera[:3, 0]  # the picture's u
    for x, y in ((0.4, 0.4), (0.7, 0.6)):
        p = np.array([x, y, z])
        ends = [P @ (*(p + s * across), 1.0) for s in (-0.5, 0.5)]
        apart = np.hypot(*np.subtract(*(q[:2] / q[2] for q in ends)))
        q = P @ (*p, 1.0)
        assert scale_at(camera, q[:2] / q[2], z) == pytest.approx(1e3 * apart, rel=1e-3)


@pytest.mark.parametrize("height", [0.3, 0.6])
def test_a_part_is_as_large_in_its_patch_from_near_and_far(height):
    image = np.zeros((480, 640, 3), np.uint8)
    half = round(0.010 * DOWN.focal / (1.5 - height))  # a square of about 2 cm
    image[240 - half : 240 + half, 320 - half : 320 + half] = 255
    box = np.array([[320 - half, 240 - half, 320 + half, 240 + half]], float)
    shown = patches(image, box, DOWN, height)
    assert shown.shape == (1, SIDE, SIDE, 3)
    bright = shown[0, :, :, 0] > 127
    width = 2 * half / DOWN.focal * (1.5 - height)
    assert bright.sum() == pytest.approx((SIDE * width / SPAN) ** 2, rel=0.05)
    v, u = np.nonzero(bright)
    assert (u.mean(), v.mean()) == pytest.approx(((SIDE - 1) / 2,) * 2, abs=0.2)


def test_no_boxes_no_patches():
    assert patches(np.zeros((480, 640, 3), np.uint8), np.empty((0, 4)), DOWN, 0.5).shape[0] == 0
    empty = Boxes(np.empty((0, 4)), np.empty(0), np.empty((0, 5)))
    assert len(agreed(empty, np.empty((0, 6))).score) == 0


@pytest.mark.parametrize("plane_z", [1.5, 3.0, -100.0])
def test_a_belt_that_cannot_be_seen_gives_a_finite_patch(plane_z):
    box = np.array([[600.0, 10.0, 640.0, 40.0]])
    assert np.isfinite(scale_at(DOWN, (620.0, 25.0), plane_z))
    assert patches(np.zeros((480, 640, 3), np.uint8), box, DOWN, plane_z).shape == (1, 64, 64, 3)


def test_both_looks_together_by_hand():
    """One box that the second look takes for another class, one that it takes for nothing."""
    first = np.array([[0.6, 0.4, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0, 0.0]])
    boxes = Boxes(np.arange(8.0).reshape(2, 4), np.array([0.81 * 0.6, 0.9]), first)
    second = np.array([[0.1, 0.9, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.2, 0.0, 0.0, 0.8]])
    found = agreed(boxes, second)
    assert found.part_class.tolist() == [1, 2]
    a, b = 0.1 * 0.6**FIRST_SAYS, 0.9 * 0.4**FIRST_SAYS
    assert found.chances[0, 1] == pytest.approx(b / (a + b), rel=1e-3)
    assert found.score == pytest.approx([0.9 * b / (a + b), 0.9**0.5 * 0.2], rel=1e-3)
    assert found.box[0].tolist() == [0, 1, 2, 3]


def test_the_surest_comes_first():
    boxes = Boxes(np.zeros((2, 4)), np.array([0.9, 0.8]), np.eye(5)[:2])
    second = np.zeros((2, 6))
    second[0, [0, 5]] = 0.5
    second[1, 1] = 1.0
    assert agreed(boxes, second).part_class.tolist() == [1, 0]


def test_what_is_unsure_is_seen_mirrored_too():
    """A session that says what a table has for the patch's first pixel, by hand."""
    table = {1: (0.99, 0.01), 2: (0.6, 0.4), 3: (0.1, 0.9)}

    class Session:
        def run(self, _, feed):
            said = [table[int(p[0, 0, 0])] for p in feed["patches"]]
            return [np.pad(np.array(said, np.float32), ((0, 0), (0, 4)))]

    network = Network()
    network._second = Session()
    shown = np.zeros((2, SIDE, SIDE, 3), np.uint8)
    shown[0, 0, 0], shown[0, 0, -1] = 1, 3  # sure: its mirror image is not asked for
    shown[1, 0, 0], shown[1, 0, -1] = 2, 3
    said = network.chances(shown)
    a, b = (0.6 * 0.1) ** 0.5, (0.4 * 0.9) ** 0.5
    np.testing.assert_allclose(said[0, :2], (0.99, 0.01), rtol=1e-6)
    np.testing.assert_allclose(said[1, :2], (a / (a + b), b / (a + b)), rtol=1e-5)

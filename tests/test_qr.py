"""Floor tags: text, finder patterns, floor points and poses on drawn pictures."""

from dataclasses import replace

import numpy as np
import pytest
from floor_tags import DOWN, DRAWING, TAG, TILTED, code_image, picture
from hypothesis import given, settings
from hypothesis import strategies as st

from twin.geometry import compose2, wrap_angle
from twin.messages import CameraFrame
from twin.stack.config import Camera
from twin.stack.detection.finder_patterns import drawn_centres, finder_centres
from twin.stack.detection.qr import TagReader, tag_pose_in_base, to_floor
from twin.tag_text import TagText, format_tag, parse_tag

ids = st.from_regex(r"[A-Z0-9]{1,8}", fullmatch=True)


def test_text_by_hand():
    assert format_tag(TAG).startswith("T1:G7:12350:-3200:9000:N4/N5:")
    assert len(format_tag(TAG)) < 38  # 26 of a small code's 38 characters hold it with correction


@settings(max_examples=40, deadline=None)
@given(
    ids,
    st.floats(-900, 900),
    st.floats(-900, 900),
    st.floats(-3.14, 3.14),
    st.lists(ids, max_size=4),
)
def test_text_goes_round(tag_id, x, y, yaw, following):
    tag = TagText(tag_id, (x, y, yaw), tuple(following))
    back = parse_tag(format_tag(tag))
    assert back is not None
    assert (back.tag_id, back.next_nodes) == (tag.tag_id, tag.next_nodes)
    np.testing.assert_allclose(back.pose[:2], (x, y), atol=0.51e-3)
    assert abs(back.pose[2] - yaw) < np.radians(0.0051)


@given(st.integers(0, 40), st.characters(min_codepoint=32, max_codepoint=126))
def test_one_wrong_character_is_refused(place, other):
    text = format_tag(TAG)
    place %= len(text)
    wrong = text[:place] + other + text[place + 1 :]
    assert wrong == text or parse_tag(wrong) is None


@given(st.text())
def test_foreign_text_is_refused(text):
    assert parse_tag(text) is None


@pytest.mark.parametrize(
    "tag",
    [
        TagText("g7", (0, 0, 0)),
        TagText("", (0, 0, 0)),
        TagText("G7", (np.nan, 0, 0)),
        TagText("G7", (1e6, 0, 0)),
        TagText("G7", (0, 0, 4.0)),
        TagText("G7", (0, 0, 0), ("N:4",)),
    ],
)
def test_what_does_not_fit_is_not_printed(tag):
    with pytest.raises(ValueError, match="tag"):
        format_tag(tag)


def test_floor_points_by_hand():
    # Eq. 6: 0.25 m up and f = 415.7 px, 100 px right of the middle are 60.1 mm to the right.
    middle = np.array([DOWN.width / 2 - 0.5, DOWN.height / 2 - 0.5])
    found = to_floor(middle + np.array([(0, 0), (100, 0), (0, -100)]), DOWN)
    d = 100 * 0.25 / DOWN.focal
    np.testing.assert_allclose(found, [(-0.2, 0), (-0.2, -d), (-0.2 + d, 0)], atol=1e-12)


def test_a_pixel_above_the_horizon_shows_no_floor():
    level = Camera(
        640, 480, 60.0, np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1], [0, 0, 0, 1.0]])
    )
    found = to_floor(np.array([(320, 400), (320, 100)]), level)
    assert np.all(np.isfinite(found[0])) and np.all(np.isnan(found[1]))


def test_tag_pose_by_hand():
    # Eq. 7: 25 modules of 4 mm, centres 72 mm apart; turned by 90 degrees about (0.3, 0.1).
    a = 0.036
    points = np.array([(0.3 - a, 0.1 - a), (0.3 - a, 0.1 + a), (0.3 + a, 0.1 - a)])
    pose, size = tag_pose_in_base(points, 25, 0.1)
    np.testing.assert_allclose(pose, (0.3, 0.1, np.pi / 2), atol=1e-12)
    assert size == pytest.approx(1.0)


def seen(pose, camera=DOWN, **how):
    reader = TagReader(camera, DRAWING)
    return reader.read(CameraFrame(1.0, picture(pose, camera, **how))), reader


@pytest.mark.parametrize("camera", [DOWN, TILTED], ids=["down", "tilted"])
@pytest.mark.parametrize("yaw_deg", [0, 13, 45, 90, -120, 178])
def test_pose_over_offsets_and_angles(camera, yaw_deg):
    rng = np.random.default_rng(yaw_deg + 180)
    for dx in (0.0, 0.03, 0.06):
        for dy in (-0.03, 0.02, 0.06):
            pose = np.array([-0.2 + dx, dy, np.radians(yaw_deg)])
            fixes, reader = seen(pose, camera, rng=rng)
            assert len(fixes) == 1, reader.refused
            off = fixes[0].pose_base_tag - pose
            assert np.hypot(off[0], off[1]) < 0.2e-3
            assert abs(wrap_angle(off[2])) < np.radians(0.1)
            assert fixes[0].text == parse_tag(format_tag(TAG)) and fixes[0].stamp == 1.0


def test_vehicle_pose():
    vehicle, tag_pose = np.array([4.0, -2.0, 0.7]), compose2((4.0, -2.0, 0.7), (-0.18, 0.02, 1.2))
    fixes, _ = seen(np.array([-0.18, 0.02, 1.2]))
    off = fixes[0].vehicle_pose(tag_pose) - vehicle
    assert np.hypot(off[0], off[1]) < 0.6e-3 and abs(off[2]) < np.radians(0.1)


def test_centres_are_finer_than_the_corners_given():
    """Corners off by more than a pixel do not shift the centres."""
    texture, modules = code_image(format_tag(TAG))
    edge = 4 * 16
    truth = edge + 16 * drawn_centres(modules) - 0.5
    a, b = edge - 0.5, edge + 16 * modules - 0.5
    corners = np.array([(a, a), (b, a), (b, b), (a, b)])
    rng = np.random.default_rng(0)
    for _ in range(10):
        found = finder_centres(texture, corners + rng.uniform(-4, 4, (4, 2)), modules)
        assert found is not None
        # Sharp edges, of pixels a sixteenth of a module: seen to a third of a sample's spacing.
        np.testing.assert_allclose(found, truth, atol=0.5)


def test_no_finder_patterns():
    corners = np.array([(100, 100), (200, 100), (200, 200), (100, 200.0)])
    assert finder_centres(np.full((300, 300), 90, np.uint8), corners, 25) is None


def test_a_tag_of_another_size_is_refused():
    fixes, reader = seen(np.array([-0.2, 0.0, 0.0]), side=0.12)
    assert fixes == () and "drawn size" in reader.refused


def test_a_foreign_code_is_refused():
    fixes, reader = seen(np.array([-0.2, 0.0, 0.0]), text="HTTPS://EXAMPLE.ORG/PALLET/17")
    assert fixes == () and "no tag" in reader.refused


def test_half_hidden_or_empty_pictures_do_no_harm():
    reader = TagReader(DOWN, DRAWING)
    image = picture(np.array([-0.2, 0.0, 0.3]))
    hidden = image.copy()
    hidden[:, 300:] = 90
    for bad in (hidden, np.zeros_like(image), np.full_like(image, 255)):
        assert reader.read(CameraFrame(0.0, bad)) == ()
    for bad in (image[:100], image.astype(float), np.zeros((0, 0, 3), np.uint8)):
        assert reader.read(CameraFrame(0.0, bad)) == () and "wanted" in reader.refused
    assert reader.read(replace(CameraFrame(0.0, image), stamp=np.nan)) == ()
    assert len(reader.read(CameraFrame(0.0, image))) == 1

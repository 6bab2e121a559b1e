"""Goods codes: their text, and a parcel's lid as the mast camera sees it."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from parcel_bench import ParcelBench

from twin.geometry import inverse, rot2, wrap_angle
from twin.goods_text import format_goods, parse_goods
from twin.layout import load_layout
from twin.messages import CameraFrame
from twin.plant.floor_tags import TEXELS, printed_code
from twin.stack.config import nominal_config
from twin.stack.detection.goods import GoodsReader
from twin.stack.tasks.transport_mission import LOOK_BACK
from twin.tag_text import TagText, format_tag

LAYOUT = load_layout()
CONFIG = nominal_config(LAYOUT.site, LAYOUT.options)
ABOUT = np.array([CONFIG.parcel_place[0] + LOOK_BACK, CONFIG.parcel_place[1]])


@given(st.integers(1, 999))
def test_text_goes_round(rack):
    text = format_goods(rack)
    assert parse_goods(text) == rack and text.startswith(f"G1:{rack}:")
    assert len(text) <= 16  # a version 1 code with correction level Q


@given(st.integers(0, 20), st.characters(min_codepoint=32, max_codepoint=126))
def test_one_wrong_character_is_refused(place, other):
    text = format_goods(7)
    place %= len(text)
    wrong = text[:place] + other + text[place + 1 :]
    assert wrong == text or parse_goods(wrong) is None


@given(st.text())
def test_foreign_text_is_refused(text):
    assert parse_goods(text) is None


@pytest.mark.parametrize("rack", [0, -1, 1000])
def test_what_does_not_fit_is_not_printed(rack):
    with pytest.raises(ValueError, match="1 to 999"):
        format_goods(rack)


def picture(*lids) -> CameraFrame:
    """Drawn by its homography: lids of (text, x, y, yaw in base, side of the code, height)."""
    camera, over = CONFIG.camera, 3
    finer = np.array([[over, 0, (over - 1) / 2], [0, over, (over - 1) / 2], [0, 0, 1.0]])
    size = (over * camera.width, over * camera.height)
    big = np.full(size[::-1], 130, np.uint8)
    for text, x, y, yaw, side, height in lids:
        texture = printed_code(text, 2)
        metres = side / (texture.shape[0] - 4 * TEXELS)  # a texel
        half = 0.5 * texture.shape[0]
        turn = rot2(yaw) @ np.diag([metres, -metres])
        base_of_texel = np.zeros((4, 3))
        base_of_texel[:2, :2] = turn
        base_of_texel[:2, 2] = np.array([x, y]) + turn @ (0.5 - half, 0.5 - half)
        base_of_texel[2:, 2] = height, 1.0
        H = finer @ camera.matrix @ (inverse(camera.T_base_camera) @ base_of_texel)[:3]
        cv2.warpPerspective(
            texture, H, size, dst=big, flags=cv2.INTER_AREA, borderMode=cv2.BORDER_TRANSPARENT
        )
    grey = big.reshape(camera.height, over, camera.width, over).mean(axis=(1, 3))
    return CameraFrame(2.0, np.repeat(np.rint(grey).astype(np.uint8)[..., None], 3, axis=2))


LID = CONFIG.stand_height + CONFIG.parcel.height
SIDE = CONFIG.parcel.code_side


def lid(rack, ahead):
    """A parcel's lid, so far ahead of the place where it should be."""
    return (format_goods(rack), ABOUT[0] + ahead, ABOUT[1], 0.0, SIDE, LID)


@pytest.mark.parametrize("yaw_deg", [-5, 0, 5, 90, 180])
def test_drawn_lids(yaw_deg):
    reader = GoodsReader(CONFIG)
    for dx, dy in ((0.0, 0.0), (0.012, -0.012), (-0.012, 0.012)):
        x, y = ABOUT[0] + dx, ABOUT[1] + dy
        yaw = np.radians(yaw_deg)
        sight = reader.read(picture((format_goods(7), x, y, yaw, SIDE, LID)), ABOUT)
        assert sight is not None, reader.refused
        assert (sight.rack, sight.stamp) == (7, 2.0)
        assert np.hypot(*(sight.pose[:2] - (x, y))) < 0.0005
        assert abs(wrap_angle(sight.pose[2] - yaw)) < np.radians(1.0)


@pytest.mark.parametrize(
    ("lids", "why"),
    [
        ([], "no code"),
        ([("G1:7:0000", *ABOUT, 0.0, SIDE, LID)], "no goods code"),
        ([("HELLO", *ABOUT, 0.0, SIDE, LID)], "no goods code"),
        ([(format_tag(TagText("G0", (0, 0, 0))), *ABOUT, 0.0, 0.05, LID)], "no goods code"),
        ([(format_goods(7), *ABOUT, 0.0, 1.2 * SIDE, LID)], "drawn size"),
        ([(format_goods(7), *ABOUT, 0.0, SIDE, LID + 0.05)], "drawn size"),
        ([lid(7, -0.03), lid(3, 0.04)], "more than one"),
    ],
    ids=["none", "checksum", "foreign", "floor tag", "too large", "too high", "two"],
)
def test_bad_codes_are_refused(lids, why):
    reader = GoodsReader(CONFIG)
    assert reader.read(picture(*lids), ABOUT) is None
    assert why in reader.refused


def test_bad_pictures_are_refused():
    reader, good = GoodsReader(CONFIG), picture((format_goods(7), *ABOUT, 0.0, SIDE, LID))
    for image in (good.image[:100], good.image.astype(float), good.image[..., 0]):
        assert reader.read(CameraFrame(0.0, image), ABOUT) is None
        assert "wanted" in reader.refused


def test_the_plants_parcel_is_read_where_it_lies():
    """Expected: three vehicles as built, each parcel put down anew: 2 mm and 1 degree at most."""
    for seed in (0, 1, 2):
        bench = ParcelBench(seed, LOOK_BACK)
        for _ in range(25):
            bench.step(picture=True)
        (x, y, yaw), _ = bench.parcel_in_base()
        frames, reader = bench.pictures, GoodsReader(bench.config)
        bench.close()
        sights = [reader.read(frame, ABOUT) for frame in frames]
        assert len(frames) >= 3 and all(sights), reader.refused
        for sight in sights:
            assert sight.rack == 7
            assert np.hypot(*(sight.pose[:2] - (x, y))) < 0.002
            assert abs(wrap_angle(sight.pose[2] - yaw)) < np.radians(1.0)

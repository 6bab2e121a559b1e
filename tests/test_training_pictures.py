"""Training pictures: the same by seed, labelled exactly, glaring enough, resumed where left."""

import json

import numpy as np
import pytest

from evaluation.pictures import PictureSet, to_json
from twin.layout import load_layout
from twin.plant.studio import Studio
from twin.stack.config import nominal_config
from twin.training import dataset
from twin.training.dataset import Darkroom, make_set
from twin.training.domain import HELD_OUT, TRAINING
from twin.training.textures import SHAPE, texture

layout = load_layout()
config = nominal_config(layout.site, layout.options)
COUNT = 12


@pytest.fixture(scope="module")
def made():
    with Darkroom(layout, TRAINING, seed=5) as room:
        return [room.make(i) for i in range(COUNT)]


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    folder = tmp_path_factory.mktemp("set")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dataset, "SHARD", 4)
        make_set(folder, layout, TRAINING, 5, COUNT)
        yield folder


def test_the_same_by_seed_whatever_was_made_before(made):
    with Darkroom(layout, TRAINING, seed=5) as room:
        image, shot = room.make(7)
    np.testing.assert_array_equal(image, made[7][0])
    assert shot.labels == made[7][1].labels


def test_domains_differ(made):
    with Darkroom(layout, HELD_OUT, seed=5) as room:
        assert (room.make(0)[0] != made[0][0]).any()
    assert not set(TRAINING.textures) & set(HELD_OUT.textures)
    for low, high in HELD_OUT.speeds:
        assert all(high <= a or b <= low for a, b in TRAINING.speeds)
    for low, high in HELD_OUT.azimuth_deg:
        assert all(high <= a or b <= low for a, b in TRAINING.azimuth_deg)


def test_labels_lie_where_parts_are(made):
    """Expected: the box holds the contour, and the part's drawn origin lies inside the box."""
    from twin.stack.detection.silhouette import projection

    labels = 0
    for _, shot in made:
        P = projection(shot.camera)
        for label in shot.labels:
            left, top, right, bottom = label.box
            contour = np.array(label.contour)
            assert contour[:, 0].min() == left and contour[:, 0].max() == right - 1
            assert contour[:, 1].min() == top and contour[:, 1].max() == bottom - 1
            if label.visible > 0.95:
                c, s = np.cos(shot.pose[2]), np.sin(shot.pose[2])
                x, y = np.subtract(label.pose[:2], shot.pose[:2]) @ [[c, -s], [s, c]]
                u, v, w = P @ (x, y, config.site.line.height + 0.008, 1.0)
                assert left - 3 <= u / w <= right + 3 and top - 3 <= v / w <= bottom + 3
                labels += 1
    assert labels > 30


def test_glare_saturates_a_fifth_of_the_parts():
    with Darkroom(layout, HELD_OUT, seed=0) as room:
        shots = [room.make(i)[1] for i in range(14)]
    shares = [s.saturated for s in shots if s.condition.light == "glare" and s.labels]
    assert len(shares) >= 2 and min(shares) >= 0.20
    calm = [s.saturated for s in shots if s.condition.light != "glare"]
    assert max(calm) < 0.2


def test_a_set_is_resumed_and_split(stored, made):
    before = PictureSet(stored)
    digest = before.digest()
    shards = sorted(stored.glob("*.json"))
    assert len(shards) == 3 and len(before) == COUNT
    shards[1].unlink()
    shards[1].with_suffix(".npy").write_bytes(b"half")
    make_set(stored, layout, TRAINING, 5, COUNT)
    assert PictureSet(stored).digest() == digest
    np.testing.assert_array_equal(before.image(7), made[7][0])
    parts = [PictureSet(stored, p) for p in "tve"]
    assert sum(map(len, parts)) == COUNT
    assert [len(p) for p in parts] == [9, 2, 1]
    json.dumps(to_json(before.shots[0]))


def test_no_pictures(tmp_path):
    with pytest.raises(FileNotFoundError, match="train-detector"):
        PictureSet(tmp_path)


def test_studio_tells_parts_apart():
    with Studio(layout, pool=1) as studio:
        assert len(studio.part_names) == 5


@pytest.mark.parametrize("kind", [*TRAINING.textures, *HELD_OUT.textures])
def test_textures_are_factors_about_one(kind):
    face = texture(kind, np.random.default_rng(1))
    assert face.shape == SHAPE and face.dtype == np.float32
    assert 0.7 < face.mean() < 1.3 and face.min() > 0

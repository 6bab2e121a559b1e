"""Training pictures: the same by seed, labelled exactly, glaring enough, resumed where left."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evaluation.pictures import SHARDS, Label, PictureSet, SetError, to_json
from twin.layout import load_layout
from twin.plant.studio import Studio
from twin.stack.config import nominal_config
from twin.training import augment, dataset
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
    assert set(TRAINING.belts) & set(HELD_OUT.belts) == {(0.12, 0.22, 0.19)}  # the cell's own
    assert HELD_OUT.warmth[1] <= TRAINING.warmth[0] or TRAINING.warmth[1] <= HELD_OUT.warmth[0]
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
    shards = sorted(stored.glob(SHARDS))
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
    with pytest.raises(SetError, match="train-detector"):
        PictureSet(tmp_path)


@pytest.fixture
def copied(stored, tmp_path):
    return Path(shutil.copytree(stored, tmp_path / "set"))


@pytest.mark.parametrize(
    "seed, domain, width, other",
    [
        (6, TRAINING, 0.2, "seed"),
        (5, HELD_OUT, 0.2, "domain"),
        (5, TRAINING, 0.25, "site"),
        (6, TRAINING, 0.25, "seed and site"),
    ],
)
def test_a_folder_of_other_pictures_is_refused(copied, seed, domain, width, other):
    elsewhere = load_layout(None, (f"site.line.width={width}",))
    with pytest.raises(SetError, match=f"{copied}: holds pictures of another {other}; move it"):
        make_set(copied, elsewhere, domain, seed, COUNT)


def test_a_folder_of_an_earlier_version_is_taken_and_marked(copied):
    note = (copied / "set.json").read_text()
    (copied / "set.json").unlink()
    make_set(copied, layout, TRAINING, 5, COUNT)
    assert (copied / "set.json").read_text() == note
    (copied / "set.json").write_text("{")
    with pytest.raises(SetError, match=r"set\.json: damaged; delete it"):
        make_set(copied, layout, TRAINING, 5, COUNT)


def test_a_shard_with_too_few_pictures_is_made_anew(copied, stored, monkeypatch):
    monkeypatch.setattr(dataset, "SHARD", 4)
    known = copied / "000004.json"
    known.write_text(json.dumps(json.loads(known.read_text())[:2]))
    np.save(known.with_suffix(".npy"), np.load(known.with_suffix(".npy"))[:2])
    make_set(copied, layout, TRAINING, 5, COUNT)
    assert PictureSet(copied).digest() == PictureSet(stored).digest()


DAMAGES = {
    "half the pixels": ("000004.npy", lambda path: path.read_bytes()[:-9]),
    "no pixels": ("000004.npy", lambda path: b""),
    "half of what is known": ("000004.json", lambda path: path.read_bytes()[:-9]),
    "one shot less": ("000004.json", lambda path: json.dumps(json.loads(path.read_text())[1:])),
    "shots of no sense": ("000004.json", lambda path: "[1, 2, 3, 4]"),
    "a file more": ("7.json", lambda path: "[]"),
}


@pytest.mark.parametrize("name, damaged", DAMAGES.values(), ids=DAMAGES)
def test_damaged_files_are_named(copied, name, damaged):
    content = damaged(copied / name)
    (copied / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(SetError, match=f"{name}: .*; delete it to have it made again"):
        PictureSet(copied)


@pytest.mark.parametrize("other", [np.zeros((4, 3), np.uint8), np.zeros((4, 480, 640, 3), int)])
def test_arrays_that_are_no_pictures_are_named(copied, other):
    np.save(copied / "000004.npy", other)
    with pytest.raises(SetError, match=r"000004\.npy: .* no pictures; delete it"):
        PictureSet(copied)


def test_a_square_part_keeps_its_middle_in_every_crop(made, monkeypatch):
    """Expected: a box's centre where the crop's map puts the label's, at any scale."""
    maps = []
    warp = augment.cv2.warpAffine

    def noted(image, M, *rest, **named):
        maps.append(M)
        return warp(image, M, *rest, **named)

    monkeypatch.setattr(augment.cv2, "warpAffine", noted)
    # A contour that is its own mirror image, far from the crop's edges, and no turn.
    monkeypatch.setattr(augment, "TURN_DEG", 0.0)
    monkeypatch.setattr(augment, "OFF_CENTRE", 0.0)
    square = Label("sma_f_n_m", (300, 220, 331, 251), SQUARE, (0.0, 0.0, 0.0), 1.0)
    crops = augment.Augmenter(One(replace(made[0][1], labels=(square,))), config)  # type: ignore
    rng = np.random.default_rng(0)
    for _ in range(20):
        _, found = crops._crop(rng, augment.CROP)
        if found:
            A, shift = maps[-1][:, :2], maps[-1][:, 2]
            scale = abs(np.linalg.det(A)) ** 0.5
            box = found[0][0]
            np.testing.assert_allclose((box[:2] + box[2:]) / 2, A @ (315, 235) + shift + 0.5)
            np.testing.assert_allclose(box[2:] - box[:2], 31 * scale)
    assert len(maps) == 20


SQUARE = [(300, 220), (330, 220), (330, 250), (300, 250)]


class One:
    """A set of one black picture."""

    def __init__(self, shot):
        self.shots = [shot]

    def __len__(self) -> int:
        return 1

    def image(self, k: int) -> np.ndarray:
        return np.zeros((480, 640, 3), np.uint8)


def test_studio_tells_parts_apart():
    with Studio(layout, pool=1) as studio:
        assert len(studio.part_names) == 5


@pytest.mark.parametrize("kind", [*TRAINING.textures, *HELD_OUT.textures])
def test_textures_are_factors_about_one(kind):
    face = texture(kind, np.random.default_rng(1))
    assert face.shape == SHAPE and face.dtype == np.float32
    assert 0.7 < face.mean() < 1.3 and face.min() > 0

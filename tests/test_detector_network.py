"""The network's file is refused unless it is the very one of its card; bad pictures are told."""

import hashlib
import json
import shutil

import numpy as np
import pytest

from twin.layout import load_layout, models_dir
from twin.messages import CameraFrame
from twin.stack.config import nominal_config
from twin.stack.detection.card import CARD, NetworkError
from twin.stack.detection.network import Network
from twin.stack.detection.network_detector import NetworkDetector
from twin.stack.detection.onnx_file import read_facts

layout = load_layout()
config = nominal_config(layout.site, layout.options)
FOLDER = models_dir() / "detector"


@pytest.fixture
def copy(tmp_path):
    for path in FOLDER.iterdir():
        if path.suffix in (".onnx", ".json"):
            shutil.copy(path, tmp_path)
    return tmp_path


def edit_card(folder, **changes) -> None:
    card = json.loads((folder / CARD).read_text()) | changes
    (folder / CARD).write_text(json.dumps(card))


def foreign(folder, look, content) -> None:
    """Other content in a look's file, with the right hash on the card."""
    entry = json.loads((folder / CARD).read_text())[look]
    (folder / entry["file"]).write_bytes(content)
    edit_card(folder, **{look: entry | {"sha256": hashlib.sha256(content).hexdigest()}})


def refuse(folder, *words) -> None:
    with pytest.raises(NetworkError) as caught:
        Network(folder)
    said = str(caught.value)
    assert "\n" not in said
    assert all(w in said for w in words), said


def test_the_shipped_networks_are_what_their_card_says():
    network = Network()
    sizes = [
        (FOLDER / part.file).stat().st_size for part in (network.card.first, network.card.second)
    ]
    assert sum(sizes) < 3_000_000
    assert network.card.parameters <= 500_000
    shapes = [m.shape for m in network.maps(np.zeros((1, 320, 416, 3), np.uint8))]
    assert shapes == [(80, 104, 10), (20, 26, 10), (10, 13, 10)]
    assert network.maps(np.zeros((1, 416, 416, 3), np.uint8))[0].shape == (104, 104, 10)
    chances = network.chances(np.zeros((3, 64, 64, 3), np.uint8))
    assert chances.shape == (3, 6)
    np.testing.assert_allclose(chances.sum(axis=1), 1.0, atol=1e-5)
    assert network.chances(np.zeros((0, 64, 64, 3), np.uint8)).shape == (0, 6)


@pytest.mark.parametrize("name", ["detector.onnx", "second_look.onnx"])
def test_damaged_file(copy, name):
    content = bytearray((copy / name).read_bytes())
    content[len(content) // 2] ^= 1
    (copy / name).write_bytes(content)
    refuse(copy, name, "damaged or foreign")


@pytest.mark.parametrize("look", ["first", "second"])
def test_truncated_file_whose_hash_is_right(copy, look):
    name = json.loads((copy / CARD).read_text())[look]["file"]
    foreign(copy, look, (copy / name).read_bytes()[:5000])
    refuse(copy, "cut off")


@pytest.mark.parametrize(
    "look, other", [("first", "second_look.onnx"), ("second", "detector.onnx")]
)
def test_a_network_in_the_other_s_place(copy, look, other):
    foreign(copy, look, (FOLDER / other).read_bytes())
    refuse(copy, "shapes")


def test_missing_file_and_missing_card(copy):
    (copy / "detector.onnx").unlink()
    refuse(copy, "the network is missing")
    (copy / CARD).unlink()
    refuse(copy, "the model card is missing")


def test_wrong_card(copy):
    edit_card(copy, opset=9)
    refuse(copy, "operator sets", "9")
    edit_card(copy, opset=18, classes=["bolt"])
    refuse(copy, "bolt")
    (copy / CARD).write_text("[]")
    refuse(copy, "not a model card")


def test_file_from_elsewhere(copy):
    foreign(copy, "first", b"GIF89a not a network at all")
    with pytest.raises(NetworkError):
        Network(copy)


def varint(field: int, kind: int) -> bytes:
    return bytes([field << 3 | kind])


def message(field: int, content: bytes) -> bytes:
    return varint(field, 2) + bytes([len(content)]) + content


def test_external_data_is_seen():
    """A model of one weight that says it lies elsewhere (TensorProto.data_location = 1)."""
    opset = message(8, varint(2, 0) + b"\x12")
    inside = message(7, message(5, message(8, b"w")))
    outside = message(7, message(5, message(8, b"w") + varint(14, 0) + b"\x01"))
    assert not read_facts(opset + inside).external
    assert read_facts(opset + inside).opsets == {"": 18}
    assert read_facts(opset + outside).external
    with pytest.raises(ValueError, match="not an ONNX model"):
        read_facts(opset)
    with pytest.raises(ValueError, match="cut off"):
        read_facts((opset + inside)[:-1])


GOOD = np.random.default_rng(0).integers(0, 255, (480, 640, 3), np.uint8)
BAD = {
    "empty": (np.empty((0, 0, 3), np.uint8), "empty"),
    "not a picture": (None, "empty"),
    "black": (np.zeros_like(GOOD), "black"),
    "white": (np.full_like(GOOD, 255), "white"),
    "one colour": (np.full_like(GOOD, 90), "one colour"),
    "truncated": (GOOD * (np.arange(480)[:, None, None] < 300).astype(np.uint8), "truncated"),
    "wrong size": (GOOD[:240], "shape"),
    "grey": (GOOD[:, :, 0], "shape"),
    "not a number": (np.full((480, 640, 3), np.nan), "not numbers"),
    "wrong type": (GOOD.astype(float), "type"),
}


@pytest.mark.parametrize("image, word", BAD.values(), ids=BAD.keys())
def test_bad_pictures_give_nothing_and_a_reason(image, word):
    detector = NetworkDetector(config)
    assert detector.detect(CameraFrame(0.0, image), np.array(layout.site.pick)) == ()
    assert detector.reason is not None and word in detector.reason


def test_belt_out_of_view():
    detector = NetworkDetector(config)
    assert detector.detect(CameraFrame(0.0, GOOD), np.array(layout.site.dock)) == ()
    assert detector.reason == "belt not in view"

"""The network's file is refused unless it is the very one of its card; bad pictures are told."""

import hashlib
import json
import shutil

import numpy as np
import pytest
from belt_frames import load
from detector_frames import Stored

from twin.geometry import between2, compose2
from twin.layout import load_layout, models_dir
from twin.messages import CameraFrame
from twin.plant.sensors.camera import Optics
from twin.stack.config import nominal_config
from twin.stack.detection.card import CARD, MAX_BYTES, Card, NetworkError
from twin.stack.detection.contour import ContourDetector
from twin.stack.detection.frames import fault_of
from twin.stack.detection.network import STRIDES, Network
from twin.stack.detection.network_detector import NetworkDetector
from twin.stack.detection.onnx_file import read_facts
from twin.stack.detection.roi import Region
from twin.stack.stack import Stack

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


@pytest.mark.parametrize("score, looks", [(0.12, 0), (0.18, 1)])
def test_a_box_gets_a_second_look_from_a_score_of_015(monkeypatch, score, looks):
    network, seen = Network(), []

    def chances(some):
        seen.append(len(some))
        return np.full((len(some), 6), 1 / 6)

    maps = [np.full((320 // s, 416 // s, 10), -20.0) for s in STRIDES]
    maps[1][10, 13] = [0, 0, 0, 0, np.log(score / (1 - score)), 20, 0, 0, 0, 0]
    monkeypatch.setattr(network, "maps", lambda image: maps)
    monkeypatch.setattr(network, "chances", chances)
    whole = Region(0, 0, 640, 480, 0.65)
    network.see(GOOD, whole, config.camera, layout.site.line.height)
    assert seen == [looks]


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


WRONG = {
    "threshold": ["NaN", "1e999", "-1", "0", "1", "7", "true", '"0.5"', "null"],
    "first.parameters": ["-3", "0", "5000000", "371539", "1e999", "3.5", "true", '"7"'],
    "first.mmac": ["NaN", "-1", "0", "1e999"],
    "second.sha256": ['"d9"', "7"],
    "second.file": ['"../second_look.onnx"', '""', "[]"],
    "opset": ["18.9", '"18"', "0", "1e999"],
    "classes": ['"bolt"', "[7]", "null"],
    "training": ["[]", '"x"', "null"],
    "training.held_out_sha256": ["7", '"d9"'],
    "training.ablation": ['{"all": {}}', "[]", '{"all": null}', '{"a\\nb": {}}'],
    "training.ablation.all.steps": ["0", "600.5", "true"],
    "training.ablation.all.map50": ["NaN", "1.2", '"0.6"'],
}


@pytest.mark.parametrize("where, text", [(w, t) for w, some in WRONG.items() for t in some])
def test_a_wrong_value_on_the_card_is_told_with_its_field(copy, where, text):
    card = json.loads((copy / CARD).read_text())
    *path, last = where.split(".")
    entry = card
    for name in path:
        entry = entry[name]
    entry[last] = "HERE"
    (copy / CARD).write_text(json.dumps(card).replace('"HERE"', text))
    together = text == "371539"  # one too many, with those of the second look
    refuse(copy, CARD, "at most 500000" if together else where)


@pytest.mark.parametrize("text", ["", "[]", "null", "{", "{}", "[" * 100_000, "\xff"])
def test_what_is_no_card(copy, text):
    (copy / CARD).write_bytes(text.encode("latin-1"))
    refuse(copy, CARD, "not a model card")


def test_what_others_take_from_the_card():
    card = Card.read(FOLDER)
    said = json.loads((FOLDER / CARD).read_text())
    assert card.ablation == said["training"]["ablation"]
    assert card.held_out_sha256 == said["training"]["held_out_sha256"]


def test_file_that_is_too_large(copy):
    foreign(copy, "first", bytes(MAX_BYTES + 1))
    refuse(copy, f"{MAX_BYTES + 1} bytes, at most")


def test_file_from_elsewhere(copy):
    foreign(copy, "first", b"GIF89a not a network at all")
    with pytest.raises(NetworkError):
        Network(copy)


def varint(value: int) -> bytes:
    """A number as protobuf writes it."""
    head = bytes([value & 0x7F | (0x80 if value > 0x7F else 0)])
    return head + varint(value >> 7) if value > 0x7F else head


def number(field: int, value: int) -> bytes:
    return varint(field << 3) + varint(value)


def message(field: int, *content: bytes) -> bytes:
    whole = b"".join(content)
    return varint(field << 3 | 2) + varint(len(whole)) + whole


HEAD = number(1, 8) + message(8, number(2, 18))  # version of the format, operator set
OUTSIDE = number(14, 1)  # TensorProto.data_location
ELSEWHERE = message(13, message(1, b"location"), message(2, b"weights"))  # .external_data
IN_NODE = {  # field numbers of onnx.proto3, from the graph inwards
    "weight": (5,),
    "sparse weight": (15, 1),
    "its places": (15, 2),
    "constant": (1, 5, 5),
    "constants": (1, 5, 10),
    "branch": (1, 5, 6, 5),
    "branches": (1, 5, 11, 5),
    "constant of a branch of a branch": (1, 5, 6, 1, 5, 6, 1, 5, 5),
    "sparse constant": (1, 5, 22, 1),
    "sparse constants": (1, 5, 23, 2),
}
IN_MODEL = {f"{name} of the graph": (7, *path) for name, path in IN_NODE.items()} | {
    "constant of a function": (25, 7, 5, 5),
    "default of a function": (25, 11, 5),
    "start of a training": (20, 1, 5),
    "step of a training": (20, 2, 5),
}


def nested(path: tuple[int, ...], content: bytes) -> bytes:
    for field in reversed(path):
        content = message(field, content)
    return content


@pytest.mark.parametrize("path", IN_MODEL.values(), ids=IN_MODEL.keys())
def test_external_data_is_seen(path):
    weight = message(8, b"w")
    graph = message(7, message(5, weight))
    assert not read_facts(HEAD + graph + nested(path, weight)).external
    assert not read_facts(HEAD + graph + nested(path, weight + number(14, 0))).external
    assert read_facts(HEAD + graph + nested(path, weight + OUTSIDE)).external
    assert read_facts(HEAD + graph + nested(path, weight + ELSEWHERE)).external


def test_facts_of_an_onnx_file():
    graph = message(7, message(5, message(8, b"w")))
    assert read_facts(HEAD + graph).opsets == {"": 18}
    with pytest.raises(ValueError, match="not an ONNX model"):
        read_facts(HEAD)
    with pytest.raises(ValueError, match="cut off"):
        read_facts((HEAD + graph)[:-1])
    with pytest.raises(ValueError, match="nested too deeply"):
        read_facts(HEAD + nested((7, *(1, 5, 6) * 2000, 5), b""))


BYTES, TYPES = 2, {"float32": 1, "uint8": 2, "int64": 7, "float64": 11}  # TensorProto.DataType


def value_info(name: str, kind: int, shape=None) -> bytes:
    """A named value; a side that may be any is None."""
    sides = [message(1, number(1, s) if s else message(2, b"any")) for s in shape or ()]
    known = [] if shape is None else [message(2, *sides)]
    return message(1, name.encode()) + message(2, message(1, number(1, kind), *known))


def stand_in(outputs, name, shape, kind=BYTES, weight=b"") -> bytes:
    """A model that always gives the same arrays, whatever it is shown."""
    parts = [message(11, value_info(name, kind, shape))]
    for k, array in enumerate(outputs):
        sides = b"".join(number(1, s) for s in array.shape)
        head = sides + number(2, TYPES[array.dtype.name]) + message(8, f"out{k}".encode())
        parts.append(message(5, head, message(9, array.tobytes()), weight))
        parts.append(message(12, value_info(f"out{k}", TYPES[array.dtype.name])))
    return HEAD + message(7, message(2, b"stand-in"), *parts)


MAPS = [np.zeros((320 // s, 416 // s, 10), np.float32) for s in STRIDES]
CHANCES = np.full((2, 6), 1 / 6, np.float32)
PICTURE, PATCH = ("image", (1, None, None, 3)), ("patches", (None, 64, 64, 3))
NAN = np.full_like(MAPS[2], np.nan)
FIRST_LOOKS = {
    "input of another name": (stand_in(MAPS, "picture", PICTURE[1]), "inputs"),
    "input that is no bytes": (stand_in(MAPS, *PICTURE, kind=1), "inputs"),
    "one size of picture alone": (stand_in(MAPS, "image", (1, 416, 416, 3)), "inputs"),
    "the right size alone": (stand_in(MAPS, "image", (1, 320, 416, 3)), "inputs"),
    "two pictures at once": (stand_in(MAPS, "image", (2, None, None, 3)), "inputs"),
    "two maps": (stand_in(MAPS[:2], *PICTURE), "shapes"),
    "flat maps": (stand_in([m.reshape(-1, 10) for m in MAPS], *PICTURE), "shapes"),
    "lists": (stand_in([np.zeros((1, 1000, 10), np.float32)] * 3, *PICTURE), "shapes"),
    "a number": (stand_in([np.float32(0).reshape(())], *PICTURE), "shapes"),
    "double precision": (stand_in([m.astype(float) for m in MAPS], *PICTURE), "float64"),
    "whole numbers": (stand_in([m.astype(np.int64) for m in MAPS], *PICTURE), "int64"),
    "no numbers": (stand_in([*MAPS[:2], NAN], *PICTURE), "not numbers"),
}
SECOND_LOOKS = {
    "input of another name": (stand_in([CHANCES], "some", PATCH[1]), "inputs"),
    "one patch alone": (stand_in([CHANCES], "patches", (1, 64, 64, 3)), "inputs"),
    "two patches alone": (stand_in([CHANCES], "patches", (2, 64, 64, 3)), "inputs"),
    "patches of another size": (stand_in([CHANCES], "patches", (None, 32, 32, 3)), "inputs"),
    "one answer for two": (stand_in([CHANCES[:1]], *PATCH), "shapes"),
    "two outputs": (stand_in([CHANCES, CHANCES], *PATCH), "shapes"),
    "double precision": (stand_in([CHANCES.astype(float)], *PATCH), "float64"),
    "no numbers": (stand_in([CHANCES * np.float32("nan")], *PATCH), "not numbers"),
    "no chances": (stand_in([CHANCES * 2], *PATCH), "sum is not 1"),
    "less than never": (
        stand_in([CHANCES - np.array([0.2, -0.2, 0, 0, 0, 0], np.float32)], *PATCH),
        "sum is not 1",
    ),
}
LOOKS = [("first", *w) for w in FIRST_LOOKS.values()]
LOOKS += [("second", *w) for w in SECOND_LOOKS.values()]
IDS = [f"first look: {name}" for name in FIRST_LOOKS]
IDS += [f"second look: {name}" for name in SECOND_LOOKS]


def test_a_stand_in_is_taken(copy):
    """So those below are refused for what is said of them, not for being made by hand."""
    foreign(copy, "first", stand_in(MAPS, *PICTURE))
    foreign(copy, "second", stand_in([CHANCES], *PATCH))
    maps = Network(copy).maps(np.zeros((1, 320, 416, 3), np.uint8))
    assert [m.shape for m in maps] == [m.shape for m in MAPS]


@pytest.mark.parametrize("look, content, why", LOOKS, ids=IDS)
def test_a_network_that_does_something_else(copy, look, content, why):
    foreign(copy, look, content)
    refuse(copy, ".onnx", why)


def test_weights_in_other_files_are_refused(copy):
    foreign(copy, "first", stand_in(MAPS, *PICTURE, weight=OUTSIDE + ELSEWHERE))
    refuse(copy, "other files")


def test_a_network_that_cannot_be_run(copy):
    """It asks for a map's sides to be other than they are, which is seen only when it runs."""
    node = message(
        1, message(1, b"image"), message(1, b"side"), message(2, b"out0"), message(4, b"Reshape")
    )
    side = message(5, number(1, 1), number(2, 7), message(8, b"side"), message(9, bytes(7) + b"\1"))
    ends = message(11, value_info(PICTURE[0], BYTES, PICTURE[1])) + message(
        12, value_info("out0", BYTES)
    )
    foreign(copy, "first", HEAD + message(7, message(2, b"stand-in"), node, side, ends))
    refuse(copy, "cannot be run")


GOOD = np.random.default_rng(0).integers(0, 255, (480, 640, 3), np.uint8)


def filled(edge, value) -> np.ndarray:
    """A good picture with one value over a part of it."""
    image = GOOD.copy()
    image[edge] = value
    return image


BAD = {
    "empty": (np.empty((0, 0, 3), np.uint8), "empty"),
    "not a picture": (None, "empty"),
    "black": (np.zeros_like(GOOD), "black"),
    "white": (np.full_like(GOOD, 255), "white"),
    "nearly white": (244 + GOOD % 12, "white"),
    "one colour": (np.full_like(GOOD, 90), "one colour"),
    "last rows black": (filled(np.s_[440:], 0), "bottom"),
    "last rows grey": (filled(np.s_[330:], 128), "bottom"),
    "last rows white": (filled(np.s_[330:], 255), "bottom"),
    "last rows repeated": (filled(np.s_[470:], GOOD[470]), "bottom"),
    "first rows black": (filled(np.s_[:200], 0), "top"),
    "right columns black": (filled(np.s_[:, 400:], 0), "right"),
    "left columns repeated": (filled(np.s_[:, :9], GOOD[:, 9:10]), "left"),
    "wrong size": (GOOD[:240], "shape"),
    "grey": (GOOD[:, :, 0], "shape"),
    "not a number": (np.full((480, 640, 3), np.nan), "not numbers"),
    "wrong type": (GOOD.astype(float), "type"),
}
PICK, DOCK = np.array(layout.site.pick), np.array(layout.site.dock)


@pytest.fixture(scope="module", params=[NetworkDetector, ContourDetector])
def detector(request):
    return request.param(config)


@pytest.mark.parametrize("image, word", BAD.values(), ids=BAD.keys())
def test_bad_pictures_give_nothing_and_a_reason(detector, image, word):
    assert detector.detect(CameraFrame(0.0, image), PICK) == ()
    assert detector.reason is not None and word in detector.reason
    detector.detect(CameraFrame(0.1, GOOD), PICK)
    assert detector.reason is None


def test_belt_out_of_view(detector):
    assert detector.detect(CameraFrame(0.0, GOOD), DOCK) == ()
    assert detector.reason == "belt not in view"


def test_good_pictures_are_not_refused():
    """Stored ones in all lights, even colours without noise, glare that saturates all edges."""
    stored = Stored()
    images = [stored.image(k) for k in range(len(stored))] + [f.image for f, *_ in load()]
    for noise in (1.0, 0.0):
        optics = Optics(np.random.default_rng(0), noise)
        even = np.full((480, 640, 3), (35, 60, 52), np.float32)
        even[200:280, 300:380] = (150, 140, 110)
        glare = np.full_like(even, 400.0)
        glare[90:400, 90:560] = even[90:400, 90:560]
        images += [optics.read_out(light, 0) for light in (even, glare)]
    assert [fault_of(image, 480, 640) for image in images] == [None] * len(images)


@pytest.fixture
def stack():
    """Stands at the line and watches the belt."""
    stack = Stack(config)
    for stamp in (0.0, 0.1):
        stack.localiser.fused.history.add(stamp, PICK)
    stack.watch_belt()
    stack._anchor = np.zeros(3)
    return stack


def told(stack, image) -> tuple[str, ...]:
    """What the stack says of one picture more."""
    stack._hear(CameraFrame(0.0, image))
    return stack._snapshot(()).events


def test_the_stack_tells_once_why_it_looks_at_no_pictures(stack):
    assert told(stack, GOOD) == told(stack, GOOD) == ()
    assert told(stack, None) == ("mast camera: empty picture",)
    assert told(stack, None) == ()
    (line,) = told(stack, filled(np.s_[440:], 0))
    assert line == "mast camera: truncated picture: its bottom is filled up"
    assert told(stack, GOOD) == ("mast camera: good pictures again",)
    assert told(stack, GOOD) == ()


def test_the_stack_misses_the_belt_only_where_it_should_be_in_view(stack):
    stack._anchor = compose2(DOCK, between2(PICK, np.zeros(3)))
    stack.drive.start(0.0, DOCK, (layout.site.pick,))
    assert told(stack, GOOD) == ()
    stack.drive.give_up("enough")
    assert "mast camera: belt not in view" in told(stack, GOOD)

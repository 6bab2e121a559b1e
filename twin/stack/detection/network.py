"""The trained networks: loaded only if they are the very files of the model card, on one thread."""

from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from twin.geometry import Array
from twin.layout import models_dir
from twin.messages import PART_CLASSES
from twin.stack.config import Camera
from twin.stack.detection.boxes import Boxes, read_maps
from twin.stack.detection.card import Card, NetworkError, checked, one_line
from twin.stack.detection.roi import HEIGHT, WIDTH, Region
from twin.stack.detection.second_look import SIDE, agreed, patches

IMAGE, PATCHES = "image", "patches"  # names of the inputs
STRIDES = (4, 16, 32)  # px of the input a cell, finest map first
WORTH = 0.15  # score of the first look from which a box gets a second one
SUM_ERROR = 1e-3  # of the second look's chances
SURE = 0.95  # chance from which a patch need not be seen mirrored too


class Network:
    """A picture to boxes with classes, by two looks.

    Args:
        folder: with the ONNX files and their card; the installed one by default.

    Raises:
        NetworkError: a file is missing, damaged, foreign, or says something else than its card.
    """

    def __init__(self, folder: Path | None = None):
        folder = folder or models_dir() / "detector"
        self.card = Card.read(folder)
        paths = folder / self.card.first.file, folder / self.card.second.file
        self._first = _open(paths[0], checked(paths[0], self.card, self.card.first))
        self._second = _open(paths[1], checked(paths[1], self.card, self.card.second))
        _check_first(paths[0], self._first)
        _check_second(paths[1], self._second)

    def maps(self, image: NDArray[np.uint8]) -> list[Array]:
        """First look: (tx, ty, tw, th, object, classes), finest map first. Shapes (h, w, 10).

        Args:
            image: RGB, sides multiples of 32. Shape (1, h, w, 3).
        """
        return [np.asarray(m) for m in self._first.run(None, {IMAGE: image})]

    def chances(self, some: NDArray[np.uint8]) -> Array:
        """Second look: chances of the classes and, last, of nothing. Shape (k, 6).

        Where it is unsure it sees the mirror image too, which is one of the same part.

        Args:
            some: patches, RGB. Shape (k, 64, 64, 3).
        """
        said = self._said_of(some)
        unsure = said.max(axis=1) < SURE
        both = np.sqrt(said[unsure] * self._said_of(some[unsure, :, ::-1]))
        said[unsure] = both / both.sum(axis=1, keepdims=True)
        return said

    def _said_of(self, some: NDArray[np.uint8]) -> Array:
        if len(some) == 0:
            return np.empty((0, len(PART_CLASSES) + 1))
        return np.asarray(self._second.run(None, {PATCHES: np.ascontiguousarray(some)})[0])

    def see(
        self, image: NDArray[np.uint8], region: Region, camera: Camera, plane_z: float
    ) -> Boxes:
        """All that may be a part in a region of the picture, surest first; boxes in its pixels.

        Args:
            image: RGB. Shape (h, w, 3).
            region: where to look.
            camera: as calibrated.
            plane_z: height of the belt in base, m.
        """
        boxes = read_maps(self.maps(region.input(image)), WIDTH, WORTH)
        boxes = Boxes(region.to_image(boxes.box), boxes.score, boxes.chances)
        return agreed(boxes, self.chances(patches(image, boxes.box, camera, plane_z)))


def _open(path: Path, content: bytes) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # the same bits every time
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors have no common base
        raise NetworkError(f"{path}: onnxruntime refuses it ({one_line(error)})") from None


def _check_first(path: Path, session: onnxruntime.InferenceSession) -> None:
    """Any size of picture, and the maps of one as they should be."""
    channels = 5 + len(PART_CLASSES)
    wanted = [(HEIGHT // s, WIDTH // s, channels) for s in STRIDES]
    _check_input(path, session, IMAGE, [1, None, None, 3])
    _try(path, session, IMAGE, (1, HEIGHT, WIDTH, 3), wanted)


def _check_second(path: Path, session: onnxruntime.InferenceSession) -> None:
    """Any number of patches, and the chances of two as they should be."""
    _check_input(path, session, PATCHES, [None, SIDE, SIDE, 3])
    (said,) = _try(path, session, PATCHES, (2, SIDE, SIDE, 3), [(2, len(PART_CLASSES) + 1)])
    if (said < 0).any() or not np.allclose(said.sum(axis=1), 1.0, atol=SUM_ERROR):
        raise NetworkError(f"{path}: gives chances whose sum is not 1")


def _check_input(
    path: Path, session: onnxruntime.InferenceSession, name: str, wanted: list[int | None]
) -> None:
    """One input of bytes with this name and shape, where None is a side that may be any."""
    found = [(i.name, i.type, i.shape) for i in session.get_inputs()]
    shape = [s if isinstance(s, int) else None for s in found[0][2]] if len(found) == 1 else []
    if shape != wanted or found[0][:2] != (name, "tensor(uint8)"):
        raise NetworkError(
            f"{path}: inputs {found}; wanted {name!r} of bytes with the shapes {wanted}"
        )


def _try(
    path: Path,
    session: onnxruntime.InferenceSession,
    name: str,
    shape: tuple[int, ...],
    wanted: list[tuple[int, ...]],
) -> list[Array]:
    """What comes of a made-up input: numbers (float32, finite) in the wanted shapes.

    Raises:
        NetworkError: it cannot be run, or gives something else.
    """
    example = np.resize(np.arange(251, dtype=np.uint8), shape)
    try:
        said = [np.asarray(m) for m in session.run(None, {name: example})]
    except Exception as error:  # onnxruntime's errors have no common base
        raise NetworkError(f"{path}: cannot be run ({one_line(error)})") from None
    if [m.shape for m in said] != wanted or any(m.dtype != np.float32 for m in said):
        found = [(m.shape, m.dtype.name) for m in said]
        raise NetworkError(f"{path}: gives {found}; wanted float32 in the shapes {wanted}")
    if not all(np.isfinite(m).all() for m in said):
        raise NetworkError(f"{path}: gives values that are not numbers")
    return said

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
from twin.stack.detection.card import Card, NetworkError, NetworkFile, checked
from twin.stack.detection.roi import WIDTH, Region
from twin.stack.detection.second_look import SIDE, agreed, patches

STRIDES = (4, 16, 32)  # px of the input a cell, finest map first
WORTH = 0.15  # score of the first look from which a box gets a second one
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
        self._first = _open(folder, self.card, self.card.first)
        self._second = _open(folder, self.card, self.card.second)
        first, second = ([n] for n in (5 + len(PART_CLASSES), len(PART_CLASSES) + 1))
        _check_shapes(
            folder, self.card.first, self._first, [1, None, None, 3], len(STRIDES) * first
        )
        _check_shapes(folder, self.card.second, self._second, [None, SIDE, SIDE, 3], second)

    def maps(self, image: NDArray[np.uint8]) -> list[Array]:
        """First look: (tx, ty, tw, th, object, classes), finest map first. Shapes (h, w, 10).

        Args:
            image: RGB, sides multiples of 32. Shape (1, h, w, 3).
        """
        return [np.asarray(m) for m in self._first.run(None, {"image": image})]

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
        return np.asarray(self._second.run(None, {"patches": np.ascontiguousarray(some)})[0])

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


def _open(folder: Path, card: Card, part: NetworkFile) -> onnxruntime.InferenceSession:
    path = folder / part.file
    content = checked(path, card, part)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # the same bits every time
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors have no common base
        said = str(error).splitlines()[0]
        raise NetworkError(f"{path}: onnxruntime refuses it ({said})") from None


def _check_shapes(
    folder: Path,
    part: NetworkFile,
    session: onnxruntime.InferenceSession,
    shape: list[int | None],
    channels: list[int],
) -> None:
    """One input of bytes in this shape, where None may be any number; channels of the outputs."""
    inputs = session.get_inputs()
    found = inputs[0].shape if len(inputs) == 1 else []
    right = (
        len(found) == len(shape)
        and all(w is None or f == w for f, w in zip(found, shape, strict=True))
        and inputs[0].type == "tensor(uint8)"
        and [o.shape[-1] for o in session.get_outputs()] == channels
    )
    if not right:
        shapes = [i.shape for i in inputs], [o.shape for o in session.get_outputs()]
        raise NetworkError(
            f"{folder / part.file}: shapes {shapes}; wanted {shape} and {channels} channels"
        )

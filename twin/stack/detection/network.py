"""The trained network: loaded only if it is the very file of the model card, run on one thread."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from twin.geometry import Array
from twin.layout import models_dir
from twin.messages import PART_CLASSES
from twin.stack.detection.onnx_file import read_facts

MAX_BYTES = 3_000_000
STRIDES = (4, 16, 32)  # px of the input a cell, finest map first
CARD = "detector.json"


class NetworkError(ValueError):
    """The file is not the network that it should be. The message is one line."""


@dataclass(frozen=True)
class Card:
    """The machine's part of the model card."""

    file: str
    sha256: str
    opset: int
    classes: tuple[str, ...]
    threshold: float  # score from which a detection counts, fixed on the validation part
    parameters: int
    mmac: float  # million multiply-accumulates at 416 x 416
    held_out_sha256: str  # of the pictures that it was judged on
    ablation: dict[str, dict[str, float]]  # figures of shorter trainings, by what was left out

    @classmethod
    def read(cls, folder: Path) -> "Card":
        """Card of the network in a folder.

        Raises:
            NetworkError: there is none, or it lacks something.
        """
        path = folder / CARD
        try:
            entry = json.loads(path.read_text(encoding="utf-8"))
            return cls(
                file=str(entry["file"]),
                sha256=str(entry["sha256"]),
                opset=int(entry["opset"]),
                classes=tuple(entry["classes"]),
                threshold=float(entry["threshold"]),
                parameters=int(entry["parameters"]),
                mmac=float(entry["mmac_416x416"]),
                held_out_sha256=str(entry["training"].get("held_out_sha256", "")),
                ablation=dict(entry["training"].get("ablation", {})),
            )
        except OSError:
            raise NetworkError(f"{path}: the model card is missing") from None
        except (ValueError, KeyError, TypeError) as error:
            raise NetworkError(f"{path}: not a model card ({error!r})") from None


class Network:
    """A picture to raw maps.

    Args:
        folder: with the ONNX file and its card; the installed one by default.

    Raises:
        NetworkError: a file is missing, damaged, foreign, or says something else than its card.
    """

    def __init__(self, folder: Path | None = None):
        folder = folder or models_dir() / "detector"
        self.card = Card.read(folder)
        path = folder / Path(self.card.file).name
        content = _checked(path, self.card)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1  # the same bits every time
        options.log_severity_level = 3
        try:
            self._session = onnxruntime.InferenceSession(
                content, options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # onnxruntime's errors have no common base
            said = str(error).splitlines()[0]
            raise NetworkError(f"{path}: onnxruntime refuses it ({said})") from None
        _check_shapes(path, self._session)
        self._input = self._session.get_inputs()[0].name

    def __call__(self, image: NDArray[np.uint8]) -> list[Array]:
        """Maps of (tx, ty, tw, th, object, classes), finest first. Shapes (h, w, 10).

        Args:
            image: RGB, sides multiples of 32. Shape (1, h, w, 3).
        """
        return [np.asarray(m) for m in self._session.run(None, {self._input: image})]


def _checked(path: Path, card: Card) -> bytes:
    """Content of the file, once size, hash, operator set and data are as they should be."""
    try:
        content = path.read_bytes()
    except OSError:
        raise NetworkError(f"{path}: the network is missing") from None
    if len(content) > MAX_BYTES:
        raise NetworkError(f"{path}: {len(content)} bytes, at most {MAX_BYTES} are taken")
    found = hashlib.sha256(content).hexdigest()
    if found != card.sha256:
        raise NetworkError(
            f"{path}: damaged or foreign: SHA-256 {found[:12]}, the card says {card.sha256[:12]}"
        )
    if card.classes != PART_CLASSES:
        raise NetworkError(f"{path}: knows {list(card.classes)}, not {list(PART_CLASSES)}")
    try:
        facts = read_facts(content)
    except ValueError as error:
        raise NetworkError(f"{path}: {error}") from None
    if facts.opsets.get("") != card.opset or len(facts.opsets) != 1:
        raise NetworkError(f"{path}: operator sets {facts.opsets}, the card says {card.opset}")
    if facts.external:
        raise NetworkError(f"{path}: keeps weights in other files; they must be inside")
    return content


def _check_shapes(path: Path, session: onnxruntime.InferenceSession) -> None:
    inputs, outputs = session.get_inputs(), session.get_outputs()
    channels = 5 + len(PART_CLASSES)
    right = (
        len(inputs) == 1
        and inputs[0].type == "tensor(uint8)"
        and len(inputs[0].shape) == 4
        and inputs[0].shape[0] == 1
        and inputs[0].shape[3] == 3
        and len(outputs) == len(STRIDES)
        and all(len(o.shape) == 3 and o.shape[2] == channels for o in outputs)
    )
    if not right:
        shapes = [i.shape for i in inputs], [o.shape for o in outputs]
        raise NetworkError(
            f"{path}: shapes {shapes}; wanted a picture (1, h, w, 3), three maps (h, w, {channels})"
        )

"""The machine's part of the model card and its files, taken only if they are those."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

from twin.messages import PART_CLASSES
from twin.stack.detection.onnx_file import read_facts

CARD = "detector.json"
MAX_BYTES = 3_000_000


class NetworkError(ValueError):
    """A file is not the network that it should be. The message is one line."""


@dataclass(frozen=True)
class NetworkFile:
    """What the card says of one file."""

    file: str
    sha256: str
    parameters: int
    mmac: float  # million multiply-accumulates, at 416 x 416 or a patch


@dataclass(frozen=True)
class Card:
    """The machine's part of the model card."""

    first: NetworkFile
    second: NetworkFile
    opset: int
    classes: tuple[str, ...]
    threshold: float  # score from which a detection counts, fixed on the validation part
    held_out_sha256: str  # of the pictures that it was judged on
    ablation: dict[str, dict[str, float]]  # figures of shorter trainings, by what was left out

    @property
    def parameters(self) -> int:
        """Of both networks."""
        return self.first.parameters + self.second.parameters

    @classmethod
    def read(cls, folder: Path) -> "Card":
        """Card of the networks in a folder.

        Raises:
            NetworkError: there is none, or it lacks something.
        """
        path = folder / CARD
        try:
            entry = json.loads(path.read_text(encoding="utf-8"))
            first, second = (
                NetworkFile(
                    file=Path(str(entry[look]["file"])).name,
                    sha256=str(entry[look]["sha256"]),
                    parameters=int(entry[look]["parameters"]),
                    mmac=float(entry[look]["mmac"]),
                )
                for look in ("first", "second")
            )
            return cls(
                first=first,
                second=second,
                opset=int(entry["opset"]),
                classes=tuple(entry["classes"]),
                threshold=float(entry["threshold"]),
                held_out_sha256=str(entry["training"].get("held_out_sha256", "")),
                ablation=dict(entry["training"].get("ablation", {})),
            )
        except OSError:
            raise NetworkError(f"{path}: the model card is missing") from None
        except (ValueError, KeyError, TypeError) as error:
            raise NetworkError(f"{path}: not a model card ({error!r})") from None


def checked(path: Path, card: Card, part: NetworkFile) -> bytes:
    """Content of a file, once size, hash, operator set and data are as they should be."""
    try:
        content = path.read_bytes()
    except OSError:
        raise NetworkError(f"{path}: the network is missing") from None
    if len(content) > MAX_BYTES:
        raise NetworkError(f"{path}: {len(content)} bytes, at most {MAX_BYTES} are taken")
    found = hashlib.sha256(content).hexdigest()
    if found != part.sha256:
        raise NetworkError(
            f"{path}: damaged or foreign: SHA-256 {found[:12]}, the card says {part.sha256[:12]}"
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

"""The machine's part of the model card and its files, taken only if they are those."""

import hashlib
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from twin.messages import PART_CLASSES
from twin.stack.detection.onnx_file import read_facts

CARD = "detector.json"
MAX_BYTES = 3_000_000  # of one network
MAX_PARAMETERS = 500_000  # of both networks

Parameters = Annotated[int, Field(gt=0, le=MAX_PARAMETERS)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class NetworkError(ValueError):
    """A file is not the network that it should be. The message is one line."""


class Entry(BaseModel):
    """A part of the card. What else the card says is for people, and not looked at."""

    model_config = ConfigDict(strict=True, frozen=True, allow_inf_nan=False)


class NetworkFile(Entry):
    """What the card says of one file."""

    file: Annotated[str, Field(pattern=r"^\w+\.onnx$")]
    sha256: Sha256
    parameters: Parameters
    mmac: Annotated[float, Field(gt=0)]  # million multiply-accumulates, at 416 x 416 or a patch


class AblationLine(Entry):
    """Figures of one shorter training."""

    steps: Annotated[int, Field(gt=0)]
    parameters: Parameters
    map50: Share
    map50_95: Share
    map50_small: Share
    accuracy_mean: Share


class Training(Entry):
    """How the networks were trained."""

    held_out_sha256: Sha256 | None = None  # of the pictures that they were judged on
    ablation: dict[str, AblationLine] = {}  # by what was left out


class Card(Entry):
    """The machine's part of the model card."""

    first: NetworkFile
    second: NetworkFile
    opset: Annotated[int, Field(gt=0)]
    classes: tuple[str, ...]
    threshold: Annotated[float, Field(gt=0, lt=1)]  # score from which a detection counts
    training: Training

    @property
    def parameters(self) -> int:
        """Of both networks."""
        return self.first.parameters + self.second.parameters

    @property
    def held_out_sha256(self) -> str | None:
        """Of the pictures that the networks were judged on, where the card says it."""
        return self.training.held_out_sha256

    @property
    def ablation(self) -> dict[str, dict[str, float]]:
        """Figures of shorter trainings (the fields of `AblationLine`), by what was left out."""
        return {name: line.model_dump() for name, line in self.training.ablation.items()}

    @model_validator(mode="after")
    def _both_are_small(self):
        if self.parameters > MAX_PARAMETERS:
            raise ValueError(f"{self.parameters} parameters, at most {MAX_PARAMETERS} are taken")
        return self

    @classmethod
    def read(cls, folder: Path) -> "Card":
        """Card of the networks in a folder.

        Raises:
            NetworkError: there is none, or what it says cannot be.
        """
        path = folder / CARD
        try:
            return cls.model_validate_json(path.read_bytes())
        except OSError:
            raise NetworkError(f"{path}: the model card is missing") from None
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            where = ".".join(str(part) for part in first["loc"]) or "all of it"
            why = one_line(f"{where}: {first['msg'].removeprefix('Value error, ')}")
            raise NetworkError(f"{path}: not a model card: {why}") from None


def checked(path: Path, card: Card, part: NetworkFile) -> bytes:
    """Content of a file, once size, hash, operator set and data are as they should be.

    Raises:
        NetworkError: they are not.
    """
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise NetworkError(f"{path}: {size} bytes, at most {MAX_BYTES} are taken")
        content = path.read_bytes()
    except OSError:
        raise NetworkError(f"{path}: the network is missing") from None
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


def one_line(error: object) -> str:
    """What an error says, in one line."""
    return " ".join(str(error).split())[:300]

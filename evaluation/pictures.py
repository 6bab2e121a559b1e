"""Labelled pictures on disk, and where in them the stack would look.

`twin.training.dataset` makes them; here they are only read.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array
from twin.messages import PART_CLASSES, PartClass
from twin.stack.config import Camera, StackConfig
from twin.stack.detection.roi import Region
from twin.stack.detection.silhouette import projection
from twin.stack.detection.window import belt_window

SIZE = (480, 640)  # px, height and width
SHARDS = "[0-9]*.json"  # what is known of the pictures, one file a shard; pixels in the .npy beside
SPLIT = "tttttttvve"  # 7:2:1 for training, validation and test (Li & An 2025, section 4)

AGAIN = "delete it to have it made again"

Height = Literal["low", "pick", "high"]
Angle = Literal["drawn", "tilted"]
Light = Literal["normal", "dim", "side", "glare"]
Content = Literal["parts", "clutter", "empty"]


@dataclass(frozen=True)
class Condition:
    """What a picture is taken under; the report tells figures apart by these."""

    height: Height
    angle: Angle
    light: Light
    content: Content


@dataclass(frozen=True)
class Label:
    """One part in a picture."""

    part_class: PartClass
    box: tuple[float, float, float, float]  # of what is seen: left, top, right, bottom, px
    contour: list[tuple[int, int]]  # convex hull of what is seen, u and v
    pose: tuple[float, float, float]  # x, y, yaw of the part frame in world
    visible: float  # share of the part's outline that is seen

    @property
    def index(self) -> int:
        """Of the class."""
        return PART_CLASSES.index(self.part_class)


@dataclass(frozen=True)
class Shot:
    """All that is known of a picture but its pixels."""

    pose: tuple[float, float, float]  # of the base in world
    T_base_camera: Array  # (4, 4) optical frame
    fovy_deg: float
    condition: Condition
    saturated: float  # share of the parts' pixels
    labels: tuple[Label, ...]

    @property
    def camera(self) -> Camera:
        """As calibrated."""
        return Camera(SIZE[1], SIZE[0], self.fovy_deg, self.T_base_camera)


class SetError(ValueError):
    """A set on disk that cannot be used. The message is one line."""


class PictureSet:
    """A set on disk. Pixels are read when asked for.

    Args:
        folder: where it was made.
        part: "t" training, "v" validation, "e" test, or "" for all.

    Raises:
        SetError: there are no pictures, or a file of them is damaged.
    """

    def __init__(self, folder: Path, part: str = ""):
        files = sorted(folder.glob(SHARDS))
        if not files:
            raise SetError(
                f"{folder}: no pictures here; twin run detect or twin train-detector makes them"
            )
        shards = [read_shard(f) for f in files]
        self._pixels = [pixels for pixels, _ in shards]
        shots = [known for _, known in shards]
        at = [(i, j) for i, some in enumerate(shots) for j in range(len(some))]
        self._at = [p for n, p in enumerate(at) if not part or SPLIT[n % len(SPLIT)] == part]
        self.shots: Sequence[Shot] = [shots[i][j] for i, j in self._at]

    def __len__(self) -> int:
        return len(self._at)

    def image(self, k: int) -> NDArray[np.uint8]:
        """Pixels of one picture, not to be written to. Shape (480, 640, 3)."""
        i, j = self._at[k]
        return np.asarray(self._pixels[i][j])

    def digest(self) -> str:
        """SHA-256 over all pixels and labels: which pictures these are."""
        total = hashlib.sha256()
        for k, shot in enumerate(self.shots):
            total.update(self.image(k).tobytes())
            total.update(json.dumps(to_json(shot)).encode())
        return total.hexdigest()


def read_shard(known: Path) -> tuple[NDArray[np.uint8], list[Shot]]:
    """Pixels, (n, 480, 640, 3) and still on disk, and what is known of them.

    Args:
        known: the .json file of the shard.

    Raises:
        SetError: one of the two files is missing or damaged.
    """
    pixels = known.with_suffix(".npy")
    try:
        shots = [from_json(entry) for entry in json.loads(known.read_text(encoding="utf-8"))]
    except (OSError, ValueError, KeyError, TypeError):
        raise SetError(f"{known}: damaged; {AGAIN}") from None
    try:
        images = np.load(pixels, mmap_mode="r")
    except FileNotFoundError:
        raise SetError(f"{known}: its pictures, {pixels.name}, are missing; {AGAIN}") from None
    except (OSError, ValueError, EOFError):
        raise SetError(f"{pixels}: damaged; {AGAIN}") from None
    if images.dtype != np.uint8 or images.shape[1:] != (*SIZE, 3):
        raise SetError(f"{pixels}: {images.dtype} of shape {images.shape}, no pictures; {AGAIN}")
    if len(images) != len(shots):
        raise SetError(f"{known}: tells of {len(shots)} pictures, not of {len(images)}; {AGAIN}")
    return images, shots


def region_of(shot: Shot, config: StackConfig) -> Region:
    """Where the stack would look in this picture."""
    return Region.around(window_of(shot, config), SIZE)


def window_of(shot: Shot, config: StackConfig) -> Array:
    """The belt that the stack would look at, as a polygon in the picture. Shape (k, 2)."""
    P = projection(shot.camera)
    return belt_window(config.site.line, np.array(shot.pose), P, SIZE)


def to_json(shot: Shot) -> dict:
    """A shot as plain values."""
    return asdict(shot) | {"T_base_camera": np.round(shot.T_base_camera, 9).tolist()}


def from_json(entry: dict) -> Shot:
    """The inverse of `to_json`."""
    labels = tuple(
        Label(
            part_class=label["part_class"],
            box=tuple(label["box"]),
            contour=[(u, v) for u, v in label["contour"]],
            pose=tuple(label["pose"]),
            visible=label["visible"],
        )
        for label in entry["labels"]
    )
    return Shot(
        pose=tuple(entry["pose"]),
        T_base_camera=np.array(entry["T_base_camera"]),
        fovy_deg=entry["fovy_deg"],
        condition=Condition(**entry["condition"]),
        saturated=entry["saturated"],
        labels=labels,
    )

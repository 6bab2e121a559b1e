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
SPLIT = "tttttttvve"  # 7:2:1 for training, validation and test (Li & An 2025, section 4)

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


class PictureSet:
    """A set on disk. Pixels are read when asked for.

    Args:
        folder: where it was made.
        part: "t" training, "v" validation, "e" test, or "" for all.
    """

    def __init__(self, folder: Path, part: str = ""):
        files = sorted(folder.glob("*.json"))
        if not files:
            raise FileNotFoundError(f"{folder}: no pictures here; twin train-detector makes them")
        self._pixels = [np.load(f.with_suffix(".npy"), mmap_mode="r") for f in files]
        shots = [[from_json(s) for s in json.loads(f.read_text())] for f in files]
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

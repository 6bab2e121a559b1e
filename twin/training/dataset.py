"""Pictures with labels on disk: made by seed, shard by shard, so that making them can be resumed.

A picture depends on the seed, the domain and its own number alone. Nothing of this is committed;
`twin train-detector` makes it anew.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array, inverse, pose2_to_transform, rot2
from twin.layout import Layout
from twin.plant.sensors.camera import Optics
from twin.plant.studio import Studio
from twin.stack.config import Camera, StackConfig, nominal_config
from twin.stack.detection.silhouette import projection
from twin.training.domain import HELD_OUT, TRAINING, Condition, Domain
from twin.training.effects import develop, saturated_share
from twin.training.labels import Label, labels_of
from twin.training.scenes import draw_scene

SHARD = 100  # pictures a file
SPLIT = "tttttttvve"  # 7:2:1 for training, validation and test (Li & An 2025, section 4)


@dataclass(frozen=True)
class Shot:
    """All that is known of a picture but its pixels."""

    pose: tuple[float, float, float]  # of the base in world
    T_base_camera: Array  # (4, 4) optical frame
    fovy_deg: float
    condition: Condition
    saturated: float  # share of the parts' pixels
    labels: tuple[Label, ...]

    def camera(self, size: tuple[int, int]) -> Camera:
        """The camera as calibrated. `size` is height and width."""
        return Camera(size[1], size[0], self.fovy_deg, self.T_base_camera)


class Darkroom:
    """Makes pictures of one domain (a context manager).

    Args:
        layout: of the cell.
        domain: what the pictures are drawn from.
        seed: of the set.
    """

    def __init__(self, layout: Layout, domain: Domain, seed: int):
        self._config = nominal_config(layout.site, layout.options)
        self._studio = Studio(layout)
        self._domain, self._seed = domain, seed
        self._optics = Optics(np.random.default_rng([seed, 1]))

    def __enter__(self) -> "Darkroom":
        return self

    def __exit__(self, *error) -> None:
        self._studio.__exit__(*error)

    def make(self, number: int) -> tuple[NDArray[np.uint8], Shot]:
        """Picture of this number, (480, 640, 3), and what is known of it."""
        config, studio = self._config, self._studio
        rng = np.random.default_rng([self._seed, _salt(self._domain), number])
        condition = Condition.draw(rng)
        scene, pose = draw_scene(
            config, studio.part_names, studio.clutter_names, self._domain, condition, rng
        )
        picture = studio.shoot(scene)
        height, width = picture.part.shape
        camera = Camera(width, height, scene.fovy_deg, scene.T_world_camera)
        P_world = projection(camera)  # with the world in the base's place
        line = config.site.line
        labels = labels_of(picture, scene, studio.part_names, config.parts, line.height, P_world)
        H = belt_homography(config, pose, P_world)
        image = develop(picture, H, self._domain, condition, self._optics, rng)
        shot = Shot(
            pose=(float(pose[0]), float(pose[1]), float(pose[2])),
            T_base_camera=inverse(pose2_to_transform(pose)) @ scene.T_world_camera,
            fovy_deg=scene.fovy_deg,
            condition=condition,
            saturated=saturated_share(image, picture.part >= 0),
            labels=tuple(labels),
        )
        return image, shot


def belt_homography(config: StackConfig, pose: Array, P_world: Array) -> Array:
    """Metres along the belt from the far end of the view, and across, to pixels. Shape (3, 3)."""
    line = config.site.line
    along = rot2(line.direction)
    ahead = rot2(pose[2]) @ (0.85, 0.0) + pose[:2] - line.origin
    start = np.asarray(line.origin) + along @ (float((along.T @ ahead)[0]), 0.0)
    to_world = np.zeros((4, 3))
    to_world[:2, :2] = along
    to_world[:2, 2], to_world[2, 2], to_world[3, 2] = start, line.height, 1.0
    return P_world @ to_world


def make_set(
    folder: Path,
    layout: Layout,
    domain: Domain,
    seed: int,
    count: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Make a set, or what of it is still missing."""
    folder.mkdir(parents=True, exist_ok=True)
    missing = [k for k in range(0, count, SHARD) if not _files(folder, k)[1].exists()]
    if not missing:
        return
    with Darkroom(layout, domain, seed) as room:
        for first in missing:
            made = [room.make(i) for i in range(first, min(first + SHARD, count))]
            pixels, known = _files(folder, first)
            np.save(pixels, np.stack([image for image, _ in made]))
            partial = known.with_suffix(".partial")
            partial.write_text(json.dumps([_to_json(shot) for _, shot in made]))
            partial.rename(known)  # the last to come: with it the shard is whole
            progress(first + len(made), count)


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
        shots = [[_from_json(s) for s in json.loads(f.read_text())] for f in files]
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
            total.update(json.dumps(_to_json(shot)).encode())
        return total.hexdigest()


def _salt(domain: Domain) -> int:
    return {TRAINING.name: 2, HELD_OUT.name: 3}[domain.name]


def _files(folder: Path, first: int) -> tuple[Path, Path]:
    return folder / f"{first:06d}.npy", folder / f"{first:06d}.json"


def _to_json(shot: Shot) -> dict:
    return asdict(shot) | {"T_base_camera": np.round(shot.T_base_camera, 9).tolist()}


def _from_json(entry: dict) -> Shot:
    condition = Condition(**entry.pop("condition"))
    labels = tuple(
        Label(**(label | {"contour": [tuple(p) for p in label["contour"]]}))
        for label in entry.pop("labels")
    )
    T = np.array(entry.pop("T_base_camera"))
    return Shot(condition=condition, labels=labels, T_base_camera=T, **entry)

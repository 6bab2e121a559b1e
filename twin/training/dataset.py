"""Pictures with labels on disk: made by seed, shard by shard, so that making them can be resumed.

A picture depends on the seed, the domain, the drawing of the site and its own number alone: what a
folder's pictures were made from stands in its set.json. Nothing of this is committed; `twin
train-detector` makes it anew.
"""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evaluation.pictures import AGAIN, SetError, Shot, read_shard, to_json
from twin.geometry import Array, inverse, pose2_to_transform, rot2
from twin.layout import Layout
from twin.plant.sensors.camera import Optics
from twin.plant.studio import Studio
from twin.stack.config import Camera, StackConfig, nominal_config
from twin.stack.detection.silhouette import projection
from twin.training.domain import HELD_OUT, TRAINING, Domain, draw_condition
from twin.training.effects import develop, saturated_share
from twin.training.labels import labels_of
from twin.training.scenes import draw_scene

SHARD = 100  # pictures a file
SET = "set.json"  # which pictures a folder holds; its name begins with no digit, as shards' do
GLARING = 0.20  # least share of the parts' pixels that glare saturates


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
        condition = draw_condition(rng)
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
        parts = picture.part >= 0
        image = develop(picture, H, self._domain, condition, self._optics, rng)
        while condition.light == "glare" and labels and saturated_share(image, parts) < GLARING:
            image = develop(picture, H, self._domain, condition, self._optics, rng)
        shot = Shot(
            pose=(float(pose[0]), float(pose[1]), float(pose[2])),
            T_base_camera=inverse(pose2_to_transform(pose)) @ scene.T_world_camera,
            fovy_deg=scene.fovy_deg,
            condition=condition,
            saturated=saturated_share(image, parts),
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
    """Make a set, or what of it is still missing.

    Args:
        folder: of the set.
        layout: of the cell.
        domain: what the pictures are drawn from.
        seed: of the set.
        count: pictures. Those beyond it that are there already are left.
        progress: called with the pictures that are there, and `count`.

    Raises:
        SetError: the folder holds other pictures, or a file of them is damaged.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _claim(folder, layout, domain, seed)
    missing = [k for k in range(0, count, SHARD) if _held(folder, k) < min(SHARD, count - k)]
    if not missing:
        return
    with Darkroom(layout, domain, seed) as room:
        for first in missing:
            made = [room.make(i) for i in range(first, min(first + SHARD, count))]
            pixels, known = _files(folder, first)
            known.unlink(missing_ok=True)
            np.save(pixels, np.stack([image for image, _ in made]))
            partial = known.with_suffix(".partial")
            partial.write_text(json.dumps([to_json(shot) for _, shot in made]))
            partial.rename(known)  # the last to come: with it the shard is whole
            progress(first + len(made), count)


def _claim(folder: Path, layout: Layout, domain: Domain, seed: int) -> None:
    """Note what the pictures are made from, or see that it is what is noted.

    Without a note (earlier versions wrote none) the pictures count as fitting.
    """
    note = folder / SET
    site = hashlib.sha256(layout.site.model_dump_json().encode()).hexdigest()
    wanted = {"seed": seed, "domain": domain.name, "site": site}
    if not note.exists():
        note.write_text(json.dumps(wanted, indent=2) + "\n", encoding="utf-8")
        return
    try:
        found = dict(json.loads(note.read_text(encoding="utf-8")))
    except (ValueError, TypeError):
        raise SetError(f"{note}: damaged; {AGAIN}") from None
    other = [name for name, value in wanted.items() if found.get(name) != value]
    if other:
        raise SetError(
            f"{folder}: holds pictures of another {' and '.join(other)};"
            " move it away, or take another folder"
        )


def _held(folder: Path, first: int) -> int:
    """Pictures of a shard that are there."""
    pixels, known = _files(folder, first)
    return len(read_shard(known)[0]) if pixels.exists() and known.exists() else 0


def _salt(domain: Domain) -> int:
    return {TRAINING.name: 2, HELD_OUT.name: 3}[domain.name]


def _files(folder: Path, first: int) -> tuple[Path, Path]:
    return folder / f"{first:06d}.npy", folder / f"{first:06d}.json"

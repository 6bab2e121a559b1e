"""The second look's network and its training: patches of single parts, and of what is none."""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from evaluation.pictures import PictureSet, region_of
from twin.geometry import Array
from twin.messages import PART_CLASSES, PartClass
from twin.stack.config import StackConfig
from twin.stack.detection.boxes import iou
from twin.stack.detection.second_look import SIDE, SPAN, centred, patch, patches, scale_at
from twin.training.augment import lit
from twin.training.backdrop import Backdrop
from twin.training.loop import Plan, Progress, fit, load_weights
from twin.training.network import Block, Detector, OneLook, conv
from twin.training.train import pixels

NOTHING = len(PART_CLASSES)  # the last class
SEEN, WANTED = 0.45, 0.7  # share of a part that is seen: to be trained on, to be judged by
STRAY, SHIFT = 0.0012, 0.0008  # m, sigma of a box about its part: in training, in judging
ZOOM, TURN_DEG = 0.04, 15.0  # sigma of the logarithm of the scale; turned by at most
EMPTY = 0.15  # of the patches show nothing
# Of the patches with a part. Next to all that is confused is a male SMA end with a female one; what
# shows little of its end looks rather like a female one: equally many would leave the male behind.
SHARES: dict[PartClass, float] = {
    "sma_f_n_m": 0.2,
    "sma_m_n_m": 0.4,
    "tnc_m_sma_f": 0.14,
    "n_tee_m_mm": 0.13,
    "n_tee_fff": 0.13,
}
COVERED, COVER = 0.2, (4, 20)  # of the patches, by a rectangle with sides in px
APART = 10.0  # px from every part, where a box of the first look is of none
SMOOTHING = 0.02  # of the labels
RATE, BATCH = 3e-3, 96
BANK = 1 << 20  # stored standard normals
Spot = tuple[int, Array, float]  # number of the picture, centre, px a metre


class SecondLook(nn.Module):
    """Patches to raw chances of the classes and of nothing."""

    def __init__(self):
        super().__init__()
        self.body = nn.Sequential(
            conv(3, 16, 3, 2),
            *(Block(16, 24, 3, 2), Block(24, 24, 3, 1), Block(24, 24, 3, 1)),
            *(Block(24, 48, 3, 2), Block(48, 48, 3, 1), Block(48, 48, 3, 1), Block(48, 48, 3, 1)),
            *(Block(48, 96, 3, 2), Block(96, 96, 2, 1)),
        )
        self.drop = nn.Dropout(0.2)
        self.head = nn.Linear(96, NOTHING + 1)

    def forward(self, x: Tensor) -> Tensor:
        """`x`: RGB from -0.5 to 0.5. Shape (n, 3, 64, 64). Logits of shape (n, 6)."""
        return self.head(self.drop(self.body(x).mean((2, 3))))


class ExportableLook(nn.Module):
    """The network as the stack runs it: patches as bytes, channels last, to chances."""

    def __init__(self, network: SecondLook):
        super().__init__()
        self.network = network

    def forward(self, patches: Tensor) -> Tensor:
        """`patches`: shape (n, 64, 64, 3), uint8. Shape (n, 6)."""
        x = patches.permute(0, 3, 1, 2).float() / 255.0 - 0.5
        return torch.softmax(self.network(x), 1)


class Patches:
    """Draws patches from a set of pictures.

    Args:
        pictures: labelled.
        config: the drawing.
        first: whose boxes on nothing are shown as such.
    """

    def __init__(self, pictures: PictureSet, config: StackConfig, first: OneLook):
        self._pictures, self._backdrop = pictures, Backdrop(BANK)
        self._bank = np.random.default_rng(BANK).standard_normal(BANK, dtype=np.float32)
        self._spots: list[list[Spot]] = [[] for _ in range(NOTHING + 1)]  # by class
        z = config.site.line.height
        for k, shot in enumerate(pictures.shots):
            truth = np.array([x.box for x in shot.labels], float).reshape(-1, 4)
            for label, centre in zip(shot.labels, _centres(truth), strict=True):
                if label.visible >= SEEN:
                    scale = scale_at(shot.camera, centre, z)
                    self._spots[label.index].append((k, centre, scale))
            seen = first.see(pictures.image(k), region_of(shot, config), shot.camera, z).box
            for box, centre in zip(seen, _centres(seen), strict=True):
                off = np.hypot(*(_centres(truth) - centre).T)
                if iou(box, truth).max(initial=0.0) < 0.15 and off.min(initial=np.inf) > APART:
                    scale = scale_at(shot.camera, centre, z)
                    self._spots[NOTHING].append((k, centre, scale))
        shares = [(1 - EMPTY) * SHARES[c] for c in PART_CLASSES] + [EMPTY]
        there = np.array([x if s else 0.0 for x, s in zip(shares, self._spots, strict=True)])
        self._shares = there / there.sum()

    def draw(self, rng: np.random.Generator) -> tuple[NDArray[np.uint8], int]:
        """A patch, (64, 64, 3), and what it shows."""
        index = int(rng.choice(len(self._shares), p=self._shares))
        some = self._spots[index]
        k, centre, scale = some[rng.integers(len(some))]
        angle = np.radians(rng.uniform(-TURN_DEG, TURN_DEG))
        A = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        A *= SIDE / (SPAN * scale) * np.exp(rng.normal(0, ZOOM))
        if rng.random() < 0.5:  # mirrored: the parts are their own mirror images
            A[:, 0] = -A[:, 0]
        M = centred(centre + rng.normal(0, STRAY, 2) * scale, A)
        image = patch(self._pictures.image(k), M)
        hulls = [np.array(x.contour, float) @ A.T + M[:, 2] for x in self._pictures.shots[k].labels]
        hulls = [h for h in hulls if (h.max(axis=0) > 0).all() and (h.min(axis=0) < SIDE).all()]
        image = lit(self._backdrop.lay(image, hulls, rng), self._bank, rng)
        if rng.random() < COVERED:
            size = rng.integers(*COVER, 2)
            u, v = rng.integers(0, SIDE - size)
            image[v : v + size[1], u : u + size[0]] = rng.integers(0, 256, 3)
        return image, index


def train_second_look(
    folder: Path,
    data: Path,
    config: StackConfig,
    first: Detector,
    steps: int,
    seed: int,
    start: Path | None = None,
    progress: Progress = lambda step, total, text: None,
) -> SecondLook:
    """Train, from the last checkpoint in `folder` if there is one.

    Args:
        folder: of checkpoint.pt and log.jsonl.
        data: of the training pictures.
        config: the drawing.
        first: the first look's network.
        steps: of 96 patches.
        seed: of the patches.
        start: weights (npz) to begin with, where there is no checkpoint.
        progress: called with step, steps, and a word.

    Returns:
        The network with its averaged weights.

    Raises:
        SetError: the pictures cannot be read.
        WeightsError: weights or checkpoint are another run's, or damaged.
    """
    torch.manual_seed(seed)
    network = SecondLook()
    if start is not None:
        load_weights(network, start)
    drawn = Patches(PictureSet(data, "t"), config, OneLook(first))
    shown, known = validation_patches(PictureSet(data, "v"), config, seed)

    def loss_of(network: SecondLook, rng: np.random.Generator) -> dict[str, Tensor]:
        some = [drawn.draw(rng) for _ in range(BATCH)]
        logits = network(pixels([image for image, _ in some]))
        wanted = torch.tensor([index for _, index in some])
        return {"total": nn.functional.cross_entropy(logits, wanted, label_smoothing=SMOOTHING)}

    @torch.no_grad()
    def validate(network: SecondLook) -> dict:
        parts = [shown[k : k + BATCH] for k in range(0, len(shown), BATCH)]
        said = torch.cat([network(pixels(list(x))).argmax(1) for x in parts])
        right = said.numpy() == known
        return {"accuracy": [round(float(right[known == c].mean()), 4) for c in range(NOTHING)]}

    plan = Plan(steps, BATCH, RATE, seed)
    return fit(network, folder, plan, loss_of, validate, {}, progress)


def validation_patches(
    pictures: PictureSet, config: StackConfig, seed: int
) -> tuple[NDArray[np.uint8], NDArray[np.integer]]:
    """All parts well seen, with boxes that are a little off. Shapes (n, 64, 64, 3) and (n,)."""
    rng = np.random.default_rng(seed)
    z, shown, known = config.site.line.height, [], []
    for k, shot in enumerate(pictures.shots):
        wanted = [x for x in shot.labels if x.visible >= WANTED]
        boxes = np.array([x.box for x in wanted], float).reshape(-1, 4)
        scales = [scale_at(shot.camera, centre, z) for centre in _centres(boxes)]
        off = rng.normal(0, SHIFT, (len(boxes), 2)) * np.reshape(scales, (-1, 1))
        shown.append(patches(pictures.image(k), boxes + np.tile(off, 2), shot.camera, z))
        known += [x.index for x in wanted]
    return np.concatenate(shown), np.array(known)


def _centres(boxes: Array) -> Array:
    """Middles, in pixels whose centres are whole numbers. Shape (k, 2)."""
    return (boxes[:, :2] + boxes[:, 2:] - 1) / 2

"""Trains the detector's first look on crops."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from evaluation.detection import average_precision, count
from evaluation.judging import judge_pictures
from evaluation.pictures import PictureSet
from twin.stack.config import StackConfig
from twin.training.augment import Augmenter, Sample
from twin.training.loop import Plan, Progress, fit, load_weights
from twin.training.loss import Target, loss
from twin.training.network import Design, Detector, OneLook

VALIDATED = 150  # pictures of the validation part while training
SURE = 0.5  # score at which the log counts


def train(
    folder: Path,
    data: Path,
    config: StackConfig,
    design: Design,
    plan: Plan,
    start: Path | None = None,
    progress: Progress = lambda step, total, text: None,
) -> Detector:
    """Train, from the last checkpoint in `folder` if there is one.

    Args:
        folder: of checkpoint.pt and log.jsonl.
        data: of the training pictures.
        config: the drawing.
        design: which improvements are in.
        plan: how long and how fast.
        start: weights (npz) to begin with, where there is no checkpoint.
        progress: called with step, steps, and a word.

    Returns:
        The network with its averaged weights.

    Raises:
        SetError: the pictures cannot be read.
        WeightsError: weights or checkpoint are another run's, or damaged.
    """
    torch.manual_seed(plan.seed)
    network = Detector(design)
    if start is not None:
        load_weights(network, start)
    crops = Augmenter(PictureSet(data, "t"), config)
    validation = PictureSet(data, "v")

    def loss_of(network: Detector, rng: np.random.Generator) -> dict[str, Tensor]:
        x, targets = batch_of([crops.draw(rng) for _ in range(plan.batch)])
        return loss(network(x), targets, design)

    def validate(network: Detector) -> dict:
        judged = judge_pictures(validation, config, OneLook(network), VALIDATED)
        counts = count(judged, SURE)
        return {
            "map50": round(average_precision(judged), 4),
            "accuracy": [round(c.accuracy, 4) for c in counts.classes],
            "false": counts.false,
        }

    return fit(network, folder, plan, loss_of, validate, asdict(design), progress)


def batch_of(samples: list[Sample]) -> tuple[Tensor, list[Target]]:
    """Pictures, (n, 3, h, w) from -0.5 to 0.5, and their targets."""
    targets = [
        Target(torch.from_numpy(s.boxes), torch.from_numpy(s.classes), torch.from_numpy(s.ignored))
        for s in samples
    ]
    return pixels([s.image for s in samples]), targets


def pixels(images: list) -> Tensor:
    """Crops, (h, w, 3), as a batch: (n, 3, h, w) from -0.5 to 0.5, channels last in memory."""
    return torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2).float() / 255.0 - 0.5

"""Trains the network on crops: one thread, resumable, with a log."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from evaluation.detection import average_precision, count
from evaluation.judging import judge_pictures
from evaluation.pictures import PictureSet
from twin.stack.config import StackConfig
from twin.training.augment import Augmenter, Sample
from twin.training.loss import Target, loss
from twin.training.network import Design, Detector, torch_maps

WARM_UP = 100  # steps in which the rate rises
DECLINE = 0.3  # of the steps, the last ones, in which the rate falls to nearly nothing
LAST_RATE = 0.02  # of the first
EMA = 0.998  # of the weights that are validated and exported
DECAY = 0.02  # of weights
CLIP = 10.0  # of the gradient's length
SAVE_EVERY, LOG_EVERY, VALIDATE_EVERY = 100, 20, 500  # steps
VALIDATED = 150  # pictures of the validation part while training
SURE = 0.5  # score at which the log counts


@dataclass(frozen=True)
class Plan:
    """How long and how fast."""

    steps: int
    batch: int = 32
    rate: float = 2e-3
    seed: int = 0


def train(
    folder: Path,
    data: Path,
    config: StackConfig,
    design: Design,
    plan: Plan,
    start: Path | None = None,
    progress: Callable[[int, int, str], None] = lambda step, total, text: None,
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
    """
    torch.set_num_threads(1)
    torch.manual_seed(plan.seed)
    folder.mkdir(parents=True, exist_ok=True)
    network = Detector(design)
    if start is not None:
        load_weights(network, start)
    network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    averaged = Detector(design)
    averaged.load_state_dict(network.state_dict())
    optimiser = torch.optim.AdamW(network.parameters(), lr=plan.rate, weight_decay=DECAY)
    first = _resume(folder, network, averaged, optimiser)
    crops = Augmenter(PictureSet(data, "t"), config)
    validation = PictureSet(data, "v")
    for step in range(first, plan.steps):
        rate = _rate(plan, step)
        for group in optimiser.param_groups:
            group["lr"] = rate
        rng = np.random.default_rng([plan.seed, step])  # a resumed run sees what it would have seen
        x, targets = batch_of([crops.draw(rng) for _ in range(plan.batch)])
        parts = loss(network.train()(x), targets, design)
        optimiser.zero_grad()
        parts["total"].backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), CLIP)
        optimiser.step()
        _average(averaged, network, step)
        done = step + 1
        if done % LOG_EVERY == 0:
            numbers = {k: round(v.item(), 4) for k, v in parts.items()}
            _log(folder, {"step": done, "rate": round(rate, 6), **numbers})
            progress(done, plan.steps, f"loss {numbers['total']:.3f}")
        if done % VALIDATE_EVERY == 0 or done == plan.steps:
            judged = judge_pictures(validation, config, torch_maps(averaged), VALIDATED)
            counts = count(judged, SURE)
            _log(
                folder,
                {
                    "step": done,
                    "map50": round(average_precision(judged), 4),
                    "accuracy": [round(c.accuracy, 4) for c in counts.classes],
                    "false": counts.false,
                },
            )
        if done % SAVE_EVERY == 0 or done == plan.steps:
            _save(folder, done, network, averaged, optimiser)
    return averaged.eval()


def batch_of(samples: list[Sample]) -> tuple[Tensor, list[Target]]:
    """Pictures, (n, 3, h, w) from -0.5 to 0.5, and their targets."""
    pixels = torch.from_numpy(np.stack([s.image for s in samples]))
    x = pixels.permute(0, 3, 1, 2).float() / 255.0 - 0.5  # channels last in memory, as wanted
    targets = [
        Target(torch.from_numpy(s.boxes), torch.from_numpy(s.classes), torch.from_numpy(s.ignored))
        for s in samples
    ]
    return x, targets


def save_weights(network: Detector, path: Path) -> None:
    """Weights alone, as arrays by name; about 1.3 MB."""
    arrays = {k: v.numpy() for k, v in network.state_dict().items() if "num_batches" not in k}
    np.savez(path, **arrays)  # type: ignore[arg-type]


def load_weights(network: Detector, path: Path) -> None:
    """Weights of `save_weights`.

    Raises:
        ValueError: they are another network's.
    """
    with np.load(path) as arrays:
        state = {k: torch.from_numpy(arrays[k]) for k in arrays.files}
    missing, surplus = network.load_state_dict(state, strict=False)
    missing = [k for k in missing if "num_batches" not in k]
    if missing or surplus:
        raise ValueError(f"{path}: weights of another network ({(missing + surplus)[0]} differs)")


def _rate(plan: Plan, step: int) -> float:
    """Warm-up, plateau, decline: the number of steps may be raised before the decline begins."""
    left = (plan.steps - step) / max(DECLINE * plan.steps, 1)
    return plan.rate * min((step + 1) / WARM_UP, 1.0, LAST_RATE + (1 - LAST_RATE) * left)


@torch.no_grad()
def _average(averaged: Detector, network: Detector, step: int) -> None:
    keep = min(EMA, (1 + step) / (10 + step))
    now = network.state_dict()
    for name, mean in averaged.state_dict().items():
        if mean.dtype.is_floating_point:
            mean.lerp_(now[name], 1 - keep)


def _save(folder: Path, step: int, network, averaged, optimiser) -> None:
    state = {
        "step": step,
        "design": asdict(network.design),
        "network": network.state_dict(),
        "averaged": averaged.state_dict(),
        "optimiser": optimiser.state_dict(),
    }
    partial = folder / "checkpoint.partial"
    torch.save(state, partial)
    partial.replace(folder / "checkpoint.pt")


def _resume(folder: Path, network, averaged, optimiser) -> int:
    path = folder / "checkpoint.pt"
    if not path.exists():
        return 0
    state = torch.load(path, weights_only=True)
    if state["design"] != asdict(network.design):
        raise ValueError(f"{path}: checkpoint of another design {state['design']}")
    network.load_state_dict(state["network"])
    averaged.load_state_dict(state["averaged"])
    optimiser.load_state_dict(state["optimiser"])
    return int(state["step"])


def _log(folder: Path, entry: dict) -> None:
    with (folder / "log.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps(entry) + "\n")

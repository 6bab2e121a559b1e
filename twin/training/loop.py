"""The loop that trains a network: one thread, resumable, with averaged weights and a log."""

import contextlib
import copy
import json
import pickle
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor, nn

WARM_UP = 100  # steps in which the rate rises
DECLINE = 0.3  # of the steps, the last ones, in which the rate falls to nearly nothing
LAST_RATE = 0.02  # of the first
EMA = 0.998  # of the weights that are validated and exported
DECAY = 0.02  # of weights
CLIP = 10.0  # of the gradient's length
CHECKPOINT = "checkpoint.pt"
SAVE_EVERY, LOG_EVERY, VALIDATE_EVERY = 100, 20, 500  # steps

# What PyTorch and numpy raise at a file that is cut, of other shapes or no such file at all.
DAMAGE = (
    zipfile.BadZipFile, pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError,
    KeyError, TypeError, AttributeError,
)  # fmt: skip

Progress = Callable[[int, int, str], None]
N = TypeVar("N", bound=nn.Module)


class WeightsError(ValueError):
    """A file of weights that cannot be used. The message is one line."""


@dataclass(frozen=True)
class Plan:
    """How long and how fast."""

    steps: int
    batch: int = 32
    rate: float = 2e-3
    seed: int = 0


def fit(
    network: N,
    folder: Path,
    plan: Plan,
    loss: Callable[[N, np.random.Generator], dict[str, Tensor]],
    validate: Callable[[N], dict],
    design: dict,
    progress: Progress = lambda step, total, text: None,
) -> N:
    """Train, from the last checkpoint in `folder` if there is one.

    Args:
        network: with the weights to begin with, where there is no checkpoint.
        folder: of checkpoint.pt and log.jsonl.
        plan: how long and how fast.
        loss: of a batch drawn with this generator, by its parts and in "total".
        validate: figures of a network, for the log.
        design: of the network; a checkpoint must be of the same.
        progress: called with step, steps, and a word.

    Returns:
        The network with its averaged weights.

    Raises:
        WeightsError: the checkpoint is damaged, of another design, seed or batch, or further than
            the plan.
    """
    torch.set_num_threads(1)
    torch.manual_seed(plan.seed)
    folder.mkdir(parents=True, exist_ok=True)
    averaged = copy.deepcopy(network)
    network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimiser = torch.optim.AdamW(network.parameters(), lr=plan.rate, weight_decay=DECAY)
    state = {"network": network, "averaged": averaged, "optimiser": optimiser}
    run = {"design": design, "seed": plan.seed, "batch": plan.batch}
    first = _resume(folder / CHECKPOINT, run, plan.steps, state)
    for step in range(first, plan.steps):
        for group in optimiser.param_groups:
            group["lr"] = rate_at(plan, step)
        # A resumed run sees, and drops out, what it would have.
        rng = np.random.default_rng([plan.seed, step])
        torch.manual_seed(int(np.random.SeedSequence([plan.seed, step]).generate_state(1)[0]))
        network.train()
        parts = loss(network, rng)
        optimiser.zero_grad()
        parts["total"].backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), CLIP)
        optimiser.step()
        _average(averaged, network, step)
        done = step + 1
        if done % LOG_EVERY == 0:
            numbers = {k: round(v.item(), 4) for k, v in parts.items()}
            _log(folder, {"step": done, "rate": round(rate_at(plan, step), 6), **numbers})
            progress(done, plan.steps, f"loss {numbers['total']:.3f}")
        if done % VALIDATE_EVERY == 0 or done == plan.steps:
            _log(folder, {"step": done, **validate(averaged.eval())})
        if done % SAVE_EVERY == 0 or done == plan.steps:
            _save(folder / CHECKPOINT, done, run, state)
    return averaged.eval()


def save_weights(network: nn.Module, path: Path) -> None:
    """Weights alone, as arrays by name; about 1.3 MB."""
    arrays = {k: v.numpy() for k, v in network.state_dict().items() if "num_batches" not in k}
    np.savez(path, **arrays)  # type: ignore[arg-type]


def load_weights(network: nn.Module, path: Path) -> None:
    """Weights of `save_weights`.

    Raises:
        WeightsError: they are another network's, or damaged.
    """
    with _read(path):
        with np.load(path) as arrays:
            state = {k: torch.from_numpy(arrays[k]) for k in arrays.files}
        missing, surplus = network.load_state_dict(state, strict=False)
    missing = [k for k in missing if "num_batches" not in k]
    if missing or surplus:
        raise WeightsError(f"{path}: weights of another network ({(missing + surplus)[0]} differs)")


def rate_at(plan: Plan, step: int) -> float:
    """Warm-up, plateau, decline: the number of steps may be raised before the decline begins."""
    left = (plan.steps - step) / max(DECLINE * plan.steps, 1)
    return plan.rate * min((step + 1) / WARM_UP, 1.0, LAST_RATE + (1 - LAST_RATE) * left)


@torch.no_grad()
def _average(averaged: nn.Module, network: nn.Module, step: int) -> None:
    keep = min(EMA, (1 + step) / (10 + step))
    now = network.state_dict()
    for name, mean in averaged.state_dict().items():
        if mean.dtype.is_floating_point:
            mean.lerp_(now[name], 1 - keep)


def _save(path: Path, step: int, run: dict, state: dict) -> None:
    partial = path.with_suffix(".partial")
    kept = {name: each.state_dict() for name, each in state.items()}
    torch.save({"step": step, **run, **kept}, partial)
    partial.replace(path)


def _resume(path: Path, run: dict, steps: int, state: dict) -> int:
    """Load a checkpoint, if there is one; steps that it has behind it."""
    if not path.exists():
        return 0
    with _read(path):
        kept = torch.load(path, weights_only=True)
        done, other = int(kept["step"]), [name for name in run if kept.get(name) != run[name]]
    if other:
        said = ", ".join(f"{name} {kept.get(name)}, not {run[name]}" for name in other)
        raise WeightsError(f"{path}: checkpoint of another run ({said})")
    if done > steps:
        raise WeightsError(f"{path}: has {done} steps, more than the {steps} asked for")
    with _read(path):
        for name, each in state.items():
            each.load_state_dict(kept[name])
    return done


@contextlib.contextmanager
def _read(path: Path) -> Iterator[None]:
    try:
        yield
    except DAMAGE as error:
        raise WeightsError(f"{path}: damaged ({type(error).__name__})") from None


def _log(folder: Path, entry: dict) -> None:
    with (folder / "log.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps(entry) + "\n")

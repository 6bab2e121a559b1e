"""`twin train-detector`: pictures, training, ablation, export; each resumes where it was left."""

import importlib.util
import shutil
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

from evaluation.pictures import PictureSet
from twin.layout import Layout
from twin.stack.config import nominal_config
from twin.training.dataset import make_set
from twin.training.domain import HELD_OUT, TRAINING

DATA = Path("runs/detector")  # training/ and held-out/ are made in here, and the rest
HELD_OUT_PICTURES, HELD_OUT_SEED = 1000, 1
Progress = Callable[[float, float, str], None]


class TrainingError(ValueError):
    """Something asked for that cannot be done. The message is one line."""


@dataclass(frozen=True)
class TrainRequest:
    """What was asked for on the command line."""

    folder: Path
    seed: int
    pictures: int
    steps: int
    ablation_steps: int
    weights: Path | None
    progress: Progress


def held_out(folder: Path, layout: Layout, progress: Progress) -> PictureSet:
    """The held-out set, made if it is not there."""
    place = folder / "held-out"
    make_set(
        place,
        layout,
        HELD_OUT,
        HELD_OUT_SEED,
        HELD_OUT_PICTURES,
        lambda k, n: progress(k, n, "held-out pictures"),
    )
    return PictureSet(place)


def train_detector(request: TrainRequest, layout: Layout) -> Path:
    """Do what is still to be done.

    Returns:
        Folder of the exported network.

    Raises:
        TrainingError: PyTorch is missing, or the weights are another network's.
    """
    if importlib.util.find_spec("torch") is None:
        raise TrainingError(
            "train-detector: PyTorch is missing; pip install 'twin[train]' brings it (5 GB)"
        )
    config = nominal_config(layout.site, layout.options)
    data, network = request.folder / "training", request.folder / "network"
    request.progress(0, 1, "pictures")
    apart(make_set, data, layout, TRAINING, request.seed, request.pictures)
    place = request.folder / "held-out"
    apart(make_set, place, layout, HELD_OUT, HELD_OUT_SEED, HELD_OUT_PICTURES)
    judged_on = PictureSet(place).digest()
    from twin.training.ablation import ablate
    from twin.training.export import export, fix_threshold
    from twin.training.network import Design
    from twin.training.train import Plan, save_weights, train

    plan = Plan(request.steps, seed=request.seed)
    try:
        trained = train(
            request.folder / "run", data, config, Design(), plan, request.weights, request.progress
        )
    except (ValueError, OSError) as error:
        raise TrainingError(f"train-detector: {error}") from None
    about = {
        "seed": request.seed,
        "steps": plan.steps,
        "batch": plan.batch,
        "pictures": len(PictureSet(data, "t")),
        "pictures_sha256": PictureSet(data).digest(),
        "held_out_sha256": judged_on,
    }
    if request.ablation_steps:
        short = Plan(request.ablation_steps, seed=request.seed)
        about["ablation"] = ablate(
            request.folder / "ablation", data, config, short, request.progress
        )
    export(trained, network, about)
    fix_threshold(network, data, config)
    save_weights(trained, network / "weights.npz")
    shutil.copy(request.folder / "run" / "log.jsonl", network / "log.jsonl")
    return network


def apart(work: Callable[..., None], *arguments) -> None:
    """Do something in a process of its own: Mesa's LLVM and PyTorch's crash when they share one."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        pool.submit(work, *arguments).result()

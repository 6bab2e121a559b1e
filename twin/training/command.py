"""`twin train-detector`: pictures, training, ablation, export; each resumes where it was left."""

import importlib.util
import shutil
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from evaluation.pictures import PictureSet
from twin.arguments import InputError, TrainDetector
from twin.layout import Layout
from twin.stack.config import nominal_config
from twin.training.dataset import make_set
from twin.training.domain import HELD_OUT, TRAINING

DATA = Path("runs/detector")  # training/ and held-out/ are made in here, and the rest
HELD_OUT_PICTURES, HELD_OUT_SEED = 1000, 1
WEIGHTS, SECOND = "weights.npz", "second_look.npz"
Progress = Callable[[float, float, str], None]


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


def train_detector(asked: TrainDetector, layout: Layout, progress: Progress) -> Path:
    """Do what is still to be done.

    Returns:
        Folder of the exported network.

    Raises:
        InputError: a number is out of range, PyTorch is missing, or the weights are another
            network's.
    """
    _check(asked)
    folder = asked.out or DATA
    config = nominal_config(layout.site, layout.options)
    data, network = folder / "training", folder / "network"
    progress(0, 1, "pictures")
    apart(make_set, data, layout, TRAINING, asked.seed, asked.pictures)
    place = folder / "held-out"
    apart(make_set, place, layout, HELD_OUT, HELD_OUT_SEED, HELD_OUT_PICTURES)
    judged_on = PictureSet(place).digest()
    from twin.training.ablation import ablate
    from twin.training.export import export, fix_threshold
    from twin.training.loop import Plan, save_weights
    from twin.training.network import Design
    from twin.training.second_look import train_second_look
    from twin.training.train import train

    plan = Plan(asked.steps, seed=asked.seed)
    start, again = (
        asked.weights and asked.weights / WEIGHTS,
        asked.weights and asked.weights / SECOND,
    )
    try:
        first = train(folder / "run", data, config, Design(), plan, start, progress)
        second = train_second_look(
            folder / "second", data, config, first, asked.look_steps, asked.seed, again,
            lambda k, n, text: progress(k, n, f"second look: {text}"),
        )  # fmt: skip
    except (ValueError, OSError) as error:
        raise InputError(f"train-detector: {error}") from None
    about = {
        "seed": asked.seed,
        "steps": plan.steps,
        "batch": plan.batch,
        "look_steps": asked.look_steps,
        "pictures": len(PictureSet(data, "t")),
        "pictures_sha256": PictureSet(data).digest(),
        "held_out_sha256": judged_on,
    }
    if asked.ablation_steps:
        short = Plan(asked.ablation_steps, seed=asked.seed)
        about["ablation"] = ablate(folder / "ablation", data, config, short, progress)
    export(first, second, network, about)
    fix_threshold(network, data, config)
    save_weights(first, network / WEIGHTS)
    save_weights(second, network / SECOND)
    shutil.copy(folder / "run" / "log.jsonl", network / "log.jsonl")
    return network


def apart(work: Callable[..., None], *arguments) -> None:
    """Do something in a process of its own: Mesa's LLVM and PyTorch's crash when they share one."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        pool.submit(work, *arguments).result()


def _check(asked: TrainDetector) -> None:
    for name, least in (
        ("pictures", 1),
        ("steps", 1),
        ("look_steps", 1),
        ("seed", 0),
        ("ablation_steps", 0),
    ):
        value = getattr(asked, name)
        if value < least:
            raise InputError(f"--{name.replace('_', '-')} {value}: must be {least} or greater")
    if importlib.util.find_spec("torch") is None:
        raise InputError(
            "train-detector: PyTorch is missing; pip install 'twin[train]' brings it (5 GB)"
        )

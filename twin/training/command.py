"""`twin train-detector`: pictures, training, ablation, export; each resumes where it was left."""

import importlib.util
import shutil
import signal
from collections.abc import Callable
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

from evaluation.pictures import SPLIT, PictureSet, SetError
from twin.arguments import InputError, TrainDetector
from twin.layout import Layout
from twin.stack.config import nominal_config
from twin.training.dataset import make_set
from twin.training.domain import HELD_OUT, TRAINING, Domain

DATA = Path("runs/detector")  # training/ and held-out/ are made in here, and the rest
HELD_OUT_PICTURES, HELD_OUT_SEED = 1000, 1
WEIGHTS, SECOND = "weights.npz", "second_look.npz"
NEEDED = ("torch", "onnx", "onnxscript")  # of the extra "train"
Progress = Callable[[float, float, str], None]


def held_out(folder: Path, layout: Layout, progress: Progress) -> PictureSet:
    """The held-out set, made if it is not there.

    Raises:
        InputError: the folder holds other pictures, or cannot be read or written.
    """
    place = folder / "held-out"
    try:
        make_set(
            place,
            layout,
            HELD_OUT,
            HELD_OUT_SEED,
            HELD_OUT_PICTURES,
            lambda k, n: progress(k, n, "held-out pictures"),
        )
        return PictureSet(place)
    except (SetError, OSError) as error:
        raise InputError(str(error)) from None


def train_detector(asked: TrainDetector, layout: Layout, progress: Progress) -> Path:
    """Do what is still to be done.

    Returns:
        Folder of the exported network.

    Raises:
        InputError: a number is out of range, PyTorch is missing, or pictures, weights or checkpoint
            are not those that are wanted.
    """
    _check(asked)
    folder = asked.out or DATA
    data, place = folder / "training", folder / "held-out"
    try:
        make_apart(data, layout, TRAINING, asked.seed, asked.pictures, progress)
        make_apart(place, layout, HELD_OUT, HELD_OUT_SEED, HELD_OUT_PICTURES, progress)
        digests = {
            "pictures": len(PictureSet(data, "t")),
            "pictures_sha256": PictureSet(data).digest(),
            "held_out_sha256": PictureSet(place).digest(),
        }
    except SetError as error:
        raise InputError(f"train-detector: {error}") from None
    return _train(asked, folder, data, layout, digests, progress)


def _train(
    asked: TrainDetector,
    folder: Path,
    data: Path,
    layout: Layout,
    digests: dict,
    progress: Progress,
) -> Path:
    """Train and export; all that needs PyTorch."""
    from twin.training.ablation import ablate
    from twin.training.export import export, fix_threshold
    from twin.training.loop import Plan, WeightsError, save_weights
    from twin.training.network import Design
    from twin.training.second_look import train_second_look
    from twin.training.train import train

    config = nominal_config(layout.site, layout.options)
    network = folder / "network"
    plan = Plan(asked.steps, seed=asked.seed)
    start, again = (
        asked.weights and asked.weights / WEIGHTS,
        asked.weights and asked.weights / SECOND,
    )
    about = {
        "seed": asked.seed,
        "steps": plan.steps,
        "batch": plan.batch,
        "look_steps": asked.look_steps,
        **digests,
    }
    try:
        first = train(folder / "run", data, config, Design(), plan, start, progress)
        second = train_second_look(
            folder / "second", data, config, first, asked.look_steps, asked.seed, again,
            lambda k, n, text: progress(k, n, f"second look: {text}"),
        )  # fmt: skip
        if asked.ablation_steps:
            short = Plan(asked.ablation_steps, seed=asked.seed)
            about["ablation"] = ablate(folder / "ablation", data, config, short, progress)
    except WeightsError as error:
        raise InputError(f"train-detector: {error}") from None
    export(first, second, network, about)
    fix_threshold(network, data, config)
    save_weights(first, network / WEIGHTS)
    save_weights(second, network / SECOND)
    shutil.copy(folder / "run" / "log.jsonl", network / "log.jsonl")
    return network


def make_apart(
    folder: Path, layout: Layout, domain: Domain, seed: int, count: int, progress: Progress
) -> None:
    """`make_set` in a process of its own: Mesa's LLVM and PyTorch's crash when they share one.

    The process ends with whatever ends this one's wait for it.

    Raises:
        SetError: as `make_set`.
        OSError: a file cannot be written, or the process died.
    """
    spawn = get_context("spawn")
    ours, theirs = spawn.Pipe(duplex=False)
    process = spawn.Process(target=_make, args=(theirs, folder, layout, domain, seed, count))
    progress(0, count, f"{domain.name} pictures")
    try:
        process.start()
        theirs.close()  # the last end of it is the process's: with that the pipe ends
        while (said := ours.recv()) is not None:
            if isinstance(said, Exception):
                raise said
            done, total = said
            progress(done, total, f"{domain.name} pictures")
    except EOFError:
        raise OSError(f"{folder}: the process that makes the pictures died") from None
    finally:
        if process.pid is not None:
            process.terminate()
            process.join()


def _make(
    answer: Connection, folder: Path, layout: Layout, domain: Domain, seed: int, count: int
) -> None:
    """Send pictures done and to do, again and again; at last None, or the error."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to both; the other ends us
    try:
        make_set(folder, layout, domain, seed, count, lambda k, n: answer.send((k, n)))
        answer.send(None)
    except (SetError, OSError) as error:
        answer.send(error)


def _check(asked: TrainDetector) -> None:
    for name, least in (
        ("pictures", len(SPLIT)),  # fewer leave a part of the split empty
        ("steps", 1),
        ("look_steps", 1),
        ("seed", 0),
        ("ablation_steps", 0),
    ):
        value = getattr(asked, name)
        if value < least:
            raise InputError(f"--{name.replace('_', '-')} {value}: must be {least} or greater")
    if asked.weights is not None:
        for name in (WEIGHTS, SECOND):
            if not (asked.weights / name).is_file():
                raise InputError(f"--weights {asked.weights}: there is no {name}")
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            f"train-detector: {', '.join(missing)} missing; pip install 'twin[train]' brings it all"
            " (5 GB)"
        )

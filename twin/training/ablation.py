"""What each of the three improvements is worth: the same short training without it."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from evaluation.detection import average_precision, count, map50_95
from evaluation.judging import judge_pictures
from evaluation.pictures import PictureSet
from twin.stack.config import StackConfig
from twin.training.loop import Plan
from twin.training.network import Design, OneLook, parameters
from twin.training.train import SURE, train

DESIGNS: dict[str, Design] = {
    "all": Design(),
    "without_attention": Design(attention=False),
    "without_104_map": Design(fine_map=False),
    "without_ciou": Design(ciou=False),
    "none": Design(attention=False, fine_map=False, ciou=False),
}


def ablate(
    folder: Path,
    data: Path,
    config: StackConfig,
    plan: Plan,
    progress: Callable[[int, int, str], None],
) -> dict[str, dict[str, float]]:
    """Train every design for the same number of steps and judge it on the test part.

    Args:
        folder: one sub-folder a design; what is there already is not done again.
        data: of the training pictures.
        config: the drawing.
        plan: the short budget.
        progress: called with step, steps, and a word.

    Returns:
        Figures of each design; also in ablation.json.
    """
    lines: dict[str, dict[str, float]] = {}
    for name, design in DESIGNS.items():
        network = train(
            folder / name,
            data,
            config,
            design,
            plan,
            progress=lambda k, n, text, name=name: progress(k, n, f"{name}: {text}"),
        )
        judged = judge_pictures(PictureSet(data, "e"), config, OneLook(network))
        counts = count(judged, SURE)
        lines[name] = {
            "steps": plan.steps,
            "parameters": parameters(network),
            "map50": round(average_precision(judged), 4),
            "map50_95": round(map50_95(judged), 4),
            "map50_small": round(average_precision(judged, small=True), 4),
            "accuracy_mean": round(float(np.nanmean([c.accuracy for c in counts.classes])), 4),
        }
        (folder / "ablation.json").write_text(json.dumps(lines, indent=2) + "\n", encoding="utf-8")
    return lines

"""Trained weights to the file and the card that the stack takes."""

import hashlib
import json
import logging
import math
from dataclasses import asdict
from pathlib import Path

import onnx
import torch

from evaluation.detection import average_precision, count
from evaluation.judging import judge_pictures
from evaluation.pictures import PictureSet
from twin.messages import PART_CLASSES
from twin.stack.config import StackConfig
from twin.stack.detection.card import CARD
from twin.stack.detection.network import Network
from twin.stack.detection.roi import HEIGHT, WIDTH
from twin.stack.detection.second_look import SIDE
from twin.training.network import Detector, Exportable, multiplications, parameters
from twin.training.second_look import ExportableLook, SecondLook

OPSET = 18
FIRST, SECOND = "detector.onnx", "second_look.onnx"
COST = 0.001  # of the worst class's accuracy, in all lights, given for fewer false detections
THRESHOLDS = tuple(round(0.15 + 0.05 * k, 2) for k in range(16))  # tried on the validation part


def export(first: Detector, second: SecondLook, folder: Path, about: dict) -> None:
    """Write both networks and their card, whose threshold is still to be fixed.

    Args:
        first: with the weights to ship.
        second: with the weights to ship.
        folder: that receives all.
        about: how they were trained, for the card.
    """
    folder.mkdir(parents=True, exist_ok=True)
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    dim = torch.export.Dim
    sides = {1: 32 * dim("rows", min=1, max=64), 2: 32 * dim("columns", min=1, max=64)}
    picture = torch.zeros(1, HEIGHT, WIDTH, 3, dtype=torch.uint8)
    names = [f"map_{stride}" for stride in first.strides]
    _write(Exportable(first.eval()), picture, folder / FIRST, "image", names, sides)
    some = torch.zeros(2, SIDE, SIDE, 3, dtype=torch.uint8)
    count = {0: dim("count", min=1, max=300)}
    _write(ExportableLook(second.eval()), some, folder / SECOND, "patches", ["chances"], count)
    write_card(
        folder,
        {
            "first": {
                **_said_of(folder / FIRST, first),
                "mmac": round(multiplications(first, WIDTH, WIDTH) / 1e6, 1),
                "mmac_416x320": round(multiplications(first, HEIGHT, WIDTH) / 1e6, 1),
                "design": asdict(first.design),
            },
            "second": {
                **_said_of(folder / SECOND, second),
                "mmac": round(multiplications(second, SIDE, SIDE) / 1e6, 2),
            },
            "opset": OPSET,
            "classes": list(PART_CLASSES),
            "threshold": 0.5,
            "training": about,
        },
    )


def fix_threshold(folder: Path, data: Path, config: StackConfig) -> None:
    """Write into the card from which score on a detection counts.

    The highest that costs the worst class no more than one part in a thousand on the validation
    part: a part that is missed is lost; what is no part, the tracker sees again and drops. The
    held-out set has no say in it.
    """
    pictures = PictureSet(data, "v")
    judged = judge_pictures(pictures, config, Network(folder))
    at = {t: count(judged, t) for t in THRESHOLDS}
    least = max(x.accuracy_min for x in at.values()) - COST
    best = max(t for t in THRESHOLDS if at[t].accuracy_min >= least)
    card = json.loads((folder / CARD).read_text(encoding="utf-8"))
    card["threshold"] = best
    card["validation"] = known(
        {
            "pictures": len(judged),
            "accuracy_min": round(at[best].accuracy_min, 4),
            "recall_min": round(at[best].recall_min, 4),
            "precision_min": round(at[best].precision_min, 4),
            "map50": round(average_precision(judged), 4),
        }
    )
    write_card(folder, card)


def write_card(folder: Path, card: dict) -> None:
    """The machine's part of the model card."""
    text = json.dumps(card, indent=2, allow_nan=False)
    (folder / CARD).write_text(text + "\n", encoding="utf-8")


def known(figures: dict[str, float]) -> dict[str, float]:
    """Without those that are not a number, as the precision of a class that is never reported is:
    JSON has no word for them."""
    return {name: value for name, value in figures.items() if not math.isnan(value)}


def _write(model, example, path: Path, name: str, outputs: list[str], free: dict) -> None:
    torch.onnx.export(
        model.eval(),
        (example,),
        str(path),
        input_names=[name],
        output_names=outputs,
        opset_version=OPSET,
        dynamo=True,
        external_data=False,
        dynamic_shapes={name: free},
        verbose=False,
    )
    _strip(path)


def _said_of(path: Path, network: torch.nn.Module) -> dict:
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return {"file": path.name, "sha256": digest, "parameters": parameters(network)}


def _strip(path: Path) -> None:
    """Take out what the exporter notes at each node: where in whose folders its code stood."""
    model = onnx.load(path)
    graph = model.graph
    parts = (graph.node, graph.value_info, graph.input, graph.output, graph.initializer)
    for part in (each for group in parts for each in group):
        del part.metadata_props[:]
        part.doc_string = ""
    del graph.metadata_props[:]
    del model.metadata_props[:]
    onnx.save(model, path)

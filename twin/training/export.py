"""Trained weights to the file and the card that the stack takes."""

import hashlib
import json
import logging
from dataclasses import asdict
from pathlib import Path

import onnx
import torch

from evaluation.detection import average_precision, count
from evaluation.judging import judge_pictures
from evaluation.pictures import PictureSet
from twin.messages import PART_CLASSES
from twin.stack.config import StackConfig
from twin.stack.detection.network import CARD, Network
from twin.stack.detection.roi import HEIGHT, WIDTH
from twin.training.network import Detector, Exportable, multiplications, parameters

OPSET = 18
FILE = "detector.onnx"
VALIDATED = 400  # pictures of the validation part on which the threshold is fixed
THRESHOLDS = tuple(round(0.15 + 0.05 * k, 2) for k in range(16))  # tried on the validation part


def export(network: Detector, folder: Path, about: dict) -> None:
    """Write detector.onnx and its card, whose threshold is still to be fixed.

    Args:
        network: with the weights to ship.
        folder: that receives both.
        about: how it was trained, for the card.
    """
    folder.mkdir(parents=True, exist_ok=True)
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    rows, columns = (32 * torch.export.Dim(name, min=1, max=64) for name in ("rows", "columns"))
    torch.onnx.export(
        Exportable(network.eval()).eval(),
        (torch.zeros(1, HEIGHT, WIDTH, 3, dtype=torch.uint8),),
        str(folder / FILE),
        input_names=["image"],
        output_names=[f"map_{stride}" for stride in network.strides],
        opset_version=OPSET,
        dynamo=True,
        external_data=False,
        dynamic_shapes={"image": {1: rows, 2: columns}},
        verbose=False,
    )
    _strip(folder / FILE)
    write_card(
        folder,
        {
            "file": FILE,
            "sha256": hashlib.sha256((folder / FILE).read_bytes()).hexdigest(),
            "opset": OPSET,
            "classes": list(PART_CLASSES),
            "threshold": 0.5,
            "parameters": parameters(network),
            "mmac_416x320": round(multiplications(network, HEIGHT, WIDTH) / 1e6, 1),
            "mmac_416x416": round(multiplications(network, WIDTH, WIDTH) / 1e6, 1),
            "design": asdict(network.design),
            "training": about,
        },
    )


def fix_threshold(folder: Path, data: Path, config: StackConfig) -> None:
    """Write the threshold at which the worst class does best on the validation part into the card.

    The held-out set has no say in it.
    """
    pictures = PictureSet(data, "v")
    judged = judge_pictures(pictures, config, Network(folder), VALIDATED)
    at = {t: count(judged, t) for t in THRESHOLDS}
    best = max(THRESHOLDS, key=lambda t: at[t].accuracy_min + at[t].precision_min)
    card = json.loads((folder / CARD).read_text(encoding="utf-8"))
    card["threshold"] = best
    card["validation"] = {
        "pictures": len(judged),
        "accuracy_min": round(at[best].accuracy_min, 4),
        "recall_min": round(at[best].recall_min, 4),
        "precision_min": round(at[best].precision_min, 4),
        "map50": round(average_precision(judged), 4),
    }
    write_card(folder, card)


def write_card(folder: Path, card: dict) -> None:
    """The machine's part of the model card."""
    text = json.dumps(card, indent=2)
    (folder / CARD).write_text(text + "\n", encoding="utf-8")


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

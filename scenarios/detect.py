"""The connector detector on pictures with lights, belts and speeds it was never trained on.

Li & An 2025, table 2, row by row, on the held-out set; then poses at pick height against the truth,
and what a picture costs. The pictures are made on the first run (some minutes) in runs/detector.
"""

import time
from collections.abc import Callable

import cv2
import numpy as np

from evaluation.detection import count
from evaluation.detector_figures import by_condition, figures, table2_lines
from evaluation.detector_poses import pose_figures
from evaluation.judging import judge_pictures
from evaluation.run import Criterion, RunRequest, RunResult
from twin.layout import Layout, LayoutError
from twin.messages import CameraFrame
from twin.stack.config import nominal_config
from twin.stack.detection.card import NetworkError
from twin.stack.detection.network import Network
from twin.stack.detection.network_detector import NetworkDetector
from twin.training.command import DATA, held_out

TIMED = 60  # frames of which the time is taken
CRITERIA = [
    Criterion("accuracy_min", ">=", 0.99),
    Criterion("recall_min", ">=", 0.99),
    Criterion("accuracy_min_glare", ">=", 0.97),
    Criterion("map50", ">=", 0.97),
    Criterion("centroid_error_p95_mm", "<=", 1.0),
    Criterion("axis_error_p95_deg", "<=", 2.0),
    Criterion("latency_ms", "<=", 15.0),
    Criterion("parameters", "<=", 500_000.0),
    Criterion("part_size_median_px", "<=", 40.0),
    Criterion("saturated_min_glare", ">=", 0.20),
]


def run(request: RunRequest, layout: Layout) -> RunResult:
    """The held-out set from end to end.

    Raises:
        LayoutError: the networks are not those of their card, or an option has no sense here.
    """
    for name in ("record", "log", "viewer", "duration"):
        if getattr(request, name):
            raise LayoutError(f"detect: --{name} has no effect here: the cell does not run")
    config = nominal_config(layout.site, layout.options)
    try:
        network = Network()
    except NetworkError as error:
        raise LayoutError(str(error)) from None
    began = time.perf_counter()
    pictures = held_out(DATA, layout, request.progress)
    judged = judge_pictures(
        pictures,
        config,
        network,
        progress=lambda k, n: request.progress(k, n, "looking"),
    )
    threshold = network.card.threshold
    metrics = figures(judged, threshold)
    glare = [s.saturated for s in pictures.shots if s.condition.light == "glare" and s.labels]
    metrics["saturated_min_glare"] = min(glare, default=np.nan)
    metrics |= pose_figures(pictures, config, network)
    metrics |= latency(network, config, pictures, layout)
    metrics["parameters"] = float(network.card.parameters)
    notes = [
        *by_condition(judged, threshold),
        *ablation_lines(network),
        *table2_lines(count(judged, threshold)),
    ]
    same = pictures.digest() == network.card.held_out_sha256
    if not same:
        notes.insert(0, "the pictures are not those of the model card (another renderer?)")
    wall = time.perf_counter() - began
    return RunResult(metrics, CRITERIA, wall_time=wall, complete=True, notes=notes)


def latency(network: Network, config, pictures, layout: Layout) -> dict[str, float]:
    """Median time of one picture, ms of one core: to boxes and classes, and to poses as well.

    The thread's own time: what else the machine does is not the detector's.
    """
    cv2.setNumThreads(1)
    detector = NetworkDetector(config, network)
    pose = np.array(layout.site.pick)
    polygon = detector.window(pose)
    steps = {
        "latency_ms": lambda frame: detector.look(frame, polygon),
        "latency_with_poses_ms": lambda frame: detector.detect(frame, pose),
    }
    frames = [CameraFrame(0.0, pictures.image(k).copy()) for k in range(min(TIMED, len(pictures)))]
    return {name: 1e3 * float(np.median(_times(step, frames))) for name, step in steps.items()}


def _times(step: Callable[[CameraFrame], object], frames: list[CameraFrame]) -> list[float]:
    """Seconds of this thread that a step takes for each frame."""
    times = []
    for frame in frames:
        start = time.thread_time()
        step(frame)
        times.append(time.thread_time() - start)
    return times


def ablation_lines(network: Network) -> list[str]:
    """What each improvement was worth when the network was trained; from the model card."""
    return [
        f"ablation, {line['steps']:.0f} steps, {name}: mAP50 {line['map50']:.4f}, small parts"
        f" {line['map50_small']:.4f}, mAP50-95 {line['map50_95']:.4f}"
        for name, line in network.card.ablation.items()
    ]

"""Connector detectors: the network against the contour pipeline, onnxruntime against cv2.dnn.

    python -m evaluation.benchmarks.detection [--pictures 300]

Both see the same held-out pictures (`twin run detect` makes them) with the camera as calibrated. A
detection counts as right within 20 mm of a part of its class. One thread each.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from evaluation.pictures import PictureSet, SetError, Shot, region_of
from twin.geometry import between2
from twin.layout import load_layout, models_dir
from twin.messages import CameraFrame
from twin.stack.config import StackConfig, nominal_config
from twin.stack.detection.contour import ContourDetector
from twin.stack.detection.network import Network
from twin.stack.detection.network_detector import NetworkDetector
from twin.stack.detection.window import X_WINDOW

HELD_OUT = Path("runs/detector/held-out")
NEAR = 0.02  # m
INSIDE = 0.03  # m within the window's ends, where a part is surely whole in it
# Parameters in millions, GFLOPs (two a multiply-accumulate) and the input they are told for:
# README of dog-qiuqiu/Yolo-FastestV2; Wong et al. 2019, arXiv:1910.01271, for YOLO Nano.
PUBLISHED = (
    ("Yolo-Fastest-1.1", 0.35, 0.252, "320 x 320"),
    ("Yolo-FastestV2", 0.25, 0.238, "352 x 352"),
    ("YOLO Nano (4.0 MB)", 1.0, 4.57, "416 x 416"),
)


def main() -> None:
    """Print all comparisons."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pictures", type=int, default=300)
    asked = parser.parse_args()
    layout = load_layout()
    config = nominal_config(layout.site, layout.options)
    cv2.setNumThreads(1)
    network = Network()
    try:
        pictures = PictureSet(HELD_OUT)
    except SetError as error:
        raise SystemExit(str(error)) from None
    print("detector   light    right / wanted   wrong class   false   ms a picture")
    kinds: dict[str, Callable[[StackConfig], ContourDetector | NetworkDetector]] = {
        "contour": ContourDetector,
        "network": lambda c: NetworkDetector(c, network),
    }
    for name, make in kinds.items():
        for light in ("normal", "dim", "side", "glare"):
            chosen = [k for k, s in enumerate(pictures.shots) if s.condition.light == light]
            right, wanted, wrong, false, spent = judge(
                pictures, chosen[: asked.pictures // 4], config, make
            )
            print(
                f"{name:10s} {light:8s} {right:5d} / {wanted:<5d} {right / max(wanted, 1):6.3f}"
                f" {wrong:12d} {false:8d} {1e3 * spent:12.1f}"
            )
    print(f"\nnetwork alone, {len(pictures)} pictures at hand, ms:")
    for engine, spent in engines(network, pictures, config).items():
        print(f"  {engine:12s} {1e3 * spent:6.1f}")
    print("\n                    parameters M   GFLOPs   input")
    first, second = network.card.first, network.card.second
    for name, part, at in (
        ("first look", first, "416 x 416"),
        ("second, a patch", second, "64 x 64"),
    ):
        size, work = part.parameters / 1e6, 2 * part.mmac / 1e3
        print(f"{name:19s} {size:10.2f} {work:10.3f}   {at}")
    for name, size, work, at in PUBLISHED:
        print(f"{name:19s} {size:10.2f} {work:10.3f}   {at}")


def judge(pictures: PictureSet, chosen: list[int], config: StackConfig, make) -> tuple:
    """Right, wanted, of a wrong class, where nothing is; and median time of a picture, s."""
    right = wanted = wrong = false = 0
    times = []
    for k in chosen:
        shot = pictures.shots[k]
        detector = make(replace(config, camera=shot.camera))
        frame, pose = CameraFrame(0.0, pictures.image(k)), np.array(shot.pose)
        start = time.perf_counter()
        found = detector.detect(frame, pose)
        times.append(time.perf_counter() - start)
        truths = truths_of(shot)
        taken: set[int] = set()
        for d in found:
            apart = [float(np.hypot(p[0] - d.p_base[0], p[1] - d.p_base[1])) for _, p, _ in truths]
            i = int(np.argmin(apart)) if apart else -1
            if i < 0 or apart[i] > NEAR or i in taken:
                false += 1
                continue
            taken.add(i)
            same = truths[i][0] == d.part_class
            wrong += not same
            right += same and truths[i][2]
        wanted += sum(sure for *_, sure in truths)
    return right, wanted, wrong, false, statistics.median(times) if times else float("nan")


def truths_of(shot: Shot) -> list[tuple[str, np.ndarray, bool]]:
    """Class and pose in base of each part, and whether it ought to be found."""
    out = []
    for label in shot.labels:
        p = between2(shot.pose, label.pose)
        sure = X_WINDOW[0] + INSIDE < p[0] < X_WINDOW[1] - INSIDE and label.visible > 0.95
        out.append((label.part_class, p, sure))
    return out


def engines(network: Network, pictures: PictureSet, config: StackConfig) -> dict[str, float]:
    """Median time of the network alone, s, by what runs it."""
    image = region_of(pictures.shots[0], config).input(pictures.image(0))
    calls: dict[str, Callable[[], object]] = {"onnxruntime": lambda: network.maps(image)}
    out: dict[str, float] = {}
    try:
        other = cv2.dnn.readNetFromONNX(str(models_dir() / "detector" / network.card.first.file))
        other.setInput(image)
        other.forward(other.getUnconnectedOutLayersNames())
        calls["cv2.dnn"] = lambda: (
            other.setInput(image),
            other.forward(other.getUnconnectedOutLayersNames()),
        )
    except cv2.error as error:
        print(f"  cv2.dnn cannot run it: {str(error).splitlines()[0][:120]}")
    for name, call in calls.items():
        times = []
        for _ in range(40):
            start = time.perf_counter()
            call()
            times.append(time.perf_counter() - start)
        out[name] = statistics.median(times)
    return out


if __name__ == "__main__":
    main()

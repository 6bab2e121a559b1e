"""The report of `twin run detect`: table 2 of the source beside ours, and figures by condition."""

from collections.abc import Mapping, Sequence

import numpy as np

from evaluation.detection import Counts, Judged, average_precision, count, map50_95
from twin.messages import PART_CLASSES, PartClass

# Li & An 2025, table 2: total, right, accuracy and recall in percent.
SOURCE: Mapping[PartClass, tuple[int, int, float, float]] = {
    "sma_f_n_m": (8640, 8353, 96.68, 96.68),
    "sma_m_n_m": (5400, 5204, 96.37, 96.42),
    "tnc_m_sma_f": (9180, 8914, 97.10, 97.10),
    "n_tee_m_mm": (6750, 6447, 95.51, 95.51),
    "n_tee_fff": (6230, 5936, 95.28, 95.36),
}


def table2_lines(counts: Counts) -> list[str]:
    """Row by row as in the source, with ours beside it."""
    lines = [
        "table 2: total, right, accuracy %, recall %, precision % (Li & An 2025: the first four)"
    ]
    for name, row in zip(PART_CLASSES, counts.classes, strict=True):
        ours = (row.accuracy, row.recall, row.precision)
        shares = ", ".join(f"{100 * x:.2f}" for x in ours)
        theirs = ", ".join(str(x) for x in SOURCE[name])
        lines.append(f"{name}: {row.total}, {row.right}, {shares} ({theirs})")
    return lines


def by_condition(pictures: Sequence[Judged], threshold: float) -> list[str]:
    """One line a condition."""
    tags = sorted({tag for p in pictures for tag in p.tags})
    lines = []
    for tag in tags:
        counts = count(pictures, threshold, tag)
        total = sum(c.total for c in counts.classes)
        right = sum(c.right for c in counts.classes)
        if total == 0:
            lines.append(f"{tag}: {counts.pictures} pictures, {counts.false} false detections")
            continue
        lines.append(
            f"{tag}: {counts.pictures} pictures, {total} parts, accuracy {right / total:.4f} (worst"
            f" class {counts.accuracy_min:.4f}), {counts.false} false detections"
        )
    return lines


def figures(pictures: Sequence[Judged], threshold: float) -> dict[str, float]:
    """Metrics of a set of judged pictures."""
    everything = count(pictures, threshold)
    nominal = count(pictures, threshold, "light normal")
    glare = count(pictures, threshold, "light glare")
    empty = [p for p in pictures if len(p.truth) == 0]
    sizes = [(p.truth[:, 2:] - p.truth[:, :2]).max(axis=1) for p in pictures if len(p.truth)] or [
        np.array([np.nan])
    ]
    return {
        "pictures": float(len(pictures)),
        "parts": float(sum(c.total for c in everything.classes)),
        "part_size_median_px": float(np.median(np.concatenate(sizes))),
        "accuracy_min": nominal.accuracy_min,
        "recall_min": nominal.recall_min,
        "precision_min": nominal.precision_min,
        "accuracy_min_glare": glare.accuracy_min,
        "recall_min_glare": glare.recall_min,
        "accuracy_min_all": everything.accuracy_min,
        "recall_min_all": everything.recall_min,
        "map50": average_precision(pictures),
        "map50_95": map50_95(pictures),
        "map50_small": average_precision(pictures, small=True),
        "false_detections": float(everything.false),
        "false_on_empty": float(count(empty, threshold).false),
    }

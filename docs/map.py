"""Draws docs/map.png, the README's map and path, from the folder of a full mapping run.

twin run mapping --seed 0
python docs/map.py runs/mapping-seed0
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon

from evaluation.plots import plot_map
from evaluation.report import read_report
from scenarios.mapping import with_obstacles
from twin.geometry import rectangle
from twin.layout import Layout
from twin.plant.obstacles import OUTLINE
from twin.recording.tum import read_tum

PATH, THINGS = "tab:blue", "tab:red"
AROUND = 0.10  # m from an obstacle to the line around it


def main(folder: Path) -> None:
    report = read_report(folder / "report.json")
    layout = Layout.model_validate(report["layout"])
    layout = with_obstacles(layout, np.random.default_rng([report["seed"], 3]))  # as in the run
    figure, axes = plt.subplots(figsize=(9.0, 5.6))
    plot_map(axes, folder / "fused.yaml")
    _, poses = read_tum(folder / "truth.tum")
    axes.plot(poses[::20, 0], poses[::20, 1], color=PATH, linewidth=1.1)
    axes.plot(*layout.site.dock[:2], "o", color=PATH, markersize=5)
    for obstacle in layout.world.faults.obstacles:
        length, width = (size + 2 * AROUND for size in OUTLINE[obstacle.kind])
        axes.add_patch(
            Polygon(rectangle(*obstacle.pose, length, width), fill=False, edgecolor=THINGS)
        )
    key = [
        Line2D([], [], color=PATH, marker="o", label="driven path, from the dock"),
        Line2D([], [], color=THINGS, label="obstacles, which are in no drawing"),
    ]
    axes.legend(handles=key, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False)
    figure.tight_layout()
    figure.savefig(Path(__file__).parent / "map.png", dpi=90)


if __name__ == "__main__":
    main(Path(sys.argv[1]))

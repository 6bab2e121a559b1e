"""Plots of a run from the files in its folder."""

from math import cos, sin
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.patches import Polygon

from evaluation.ape import pose_errors
from twin.geometry import rectangle
from twin.recording.tum import read_tum
from twin.site import Site

LABELS = {
    "truth": "true",
    "estimate": "localised",
    "fused": "fused odometry",
    "odometry": "wheels alone",
}


def plot_paths(axes: Axes, folder: Path, site: Site | None = None) -> None:
    """Paths seen from above, metres in world; with the belt if the site is given."""
    if site is not None:
        line = site.line
        box = rectangle(line.length / 2, 0.0, 0.0, line.length, line.width)
        corners = [_to_world(site, x, y) for x, y in box]
        axes.add_patch(Polygon(corners, color="0.85", label="belt"))
    for name, label in LABELS.items():
        path = folder / f"{name}.tum"
        if path.exists():
            _, poses = read_tum(path)
            axes.plot(poses[:, 0], poses[:, 1], label=label)
    axes.set(xlabel="x (m)", ylabel="y (m)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend()


def plot_errors(axes: Axes, folder: Path) -> None:
    """Distance from the true position over time, of every estimate that there is."""
    truth = read_tum(folder / "truth.tum")
    for name, label in list(LABELS.items())[1:]:
        path = folder / f"{name}.tum"
        if path.exists():
            errors = pose_errors(truth, read_tum(path))
            axes.plot(errors.stamps, 1e3 * errors.translation, label=label)
    axes.set(xlabel="time (s)", ylabel="position error (mm)")
    axes.legend()


def _to_world(site: Site, along: float, across: float) -> tuple[float, float]:
    c, s = cos(site.line.direction), sin(site.line.direction)
    x, y = site.line.origin
    return x + c * along - s * across, y + s * along + c * across

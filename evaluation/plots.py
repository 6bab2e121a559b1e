"""Plots of a run from the files in its folder."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon

from evaluation.ape import pose_errors
from evaluation.detection import Judged, match
from evaluation.pictures import PictureSet, region_of
from twin.floor_plan import machines
from twin.messages import PART_CLASSES
from twin.recording.tum import read_tum
from twin.site import Site
from twin.stack.config import StackConfig
from twin.stack.estimation.map_file import load_map
from twin.stack.estimation.occupancy_grid import FREE, OCCUPIED, UNKNOWN

LABELS = {
    "truth": "true",
    "estimate": "localised",
    "fused": "fused odometry",
    "odometry": "wheels alone",
}


def plot_paths(axes: Axes, folder: Path, site: Site | None = None) -> None:
    """Paths seen from above, metres in world; with what stands in the hall if the site is given."""
    if site is not None:
        for boxes in machines(site).values():
            for box in boxes:
                axes.add_patch(Polygon(box, color="0.85"))
        (x0, x1), (y0, y1) = site.hall.x, site.hall.y
        axes.add_patch(Polygon([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], fill=False, color="0.6"))
        if site.tags:
            tags = [tag.pose[:2] for tag in site.tags]
            axes.plot(*zip(*tags, strict=True), "s", color="0.6", markersize=2, label="floor tags")
    for name, label in LABELS.items():
        path = folder / f"{name}.tum"
        if path.exists():
            _, poses = read_tum(path)
            axes.plot(poses[:, 0], poses[:, 1], label=label)
    axes.set(xlabel="x (m)", ylabel="y (m)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend()


def plot_map(axes: Axes, path: Path) -> None:
    """A map in the ROS map_server's format (its YAML): occupied black, free white, unknown grey."""
    grid = load_map(path)
    grey = {OCCUPIED: 0.0, FREE: 1.0, UNKNOWN: 0.8}
    states = grid.states()
    picture = np.select([states == value for value in grey], list(grey.values()))
    height, width = np.array(states.shape) * grid.resolution
    x, y = grid.origin
    axes.imshow(
        picture, cmap="gray", vmin=0, vmax=1, origin="lower", extent=(x, x + width, y, y + height)
    )
    axes.set(xlabel="x (m)", ylabel="y (m)")


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


def plot_repeat(axes: Axes, folder: Path, method: str) -> None:
    """Places of a vehicle at rest less their mean, by turn of the head: Liu et al. 2022, Fig. 11.

    Args:
        axes: to draw on.
        folder: of a `beacon_repeat` run.
        method: "source", "ours" or "filtered".
    """
    with np.load(folder / "series.npz") as series:
        places = 1e3 * (series[method] - series[method].mean(axis=0))
    for axis, values in zip("xyz", places.T, strict=True):
        axes.plot(values, linewidth=0.7, label=f"{axis}: sigma {values.std():.2f} mm")
    for size, shade, label in ((5, "0.95", "y, z"), (2, "0.88", "x")):
        axes.axhspan(-size, size, color=shade, zorder=0, label=f"{label} within, as printed")
    axes.set(xlabel="measurement", ylabel="error (mm)", title=method)
    axes.legend(fontsize=8)


def plot_moves(axes: Axes, folder: Path) -> None:
    """Residuals of the measured distance of moves, over the distance: Liu et al. 2022, Fig. 12.

    Args:
        axes: to draw on.
        folder: of a `beacon_parking` run.
    """
    with np.load(folder / "moves.npz") as moves:
        for name in ("source", "ours", "filtered"):
            distance, residual = 1e3 * moves["distance"], 1e3 * moves[f"residual_{name}"]
            axes.plot(distance, residual, "o", markersize=4, label=name)
    axes.axhspan(-10, 10, color="0.93", zorder=0, label="+-10 mm, as printed")
    axes.set(xlabel="moved distance (mm)", ylabel="residual (mm)")
    axes.legend()


def plot_detections(
    axes: Axes, pictures: PictureSet, k: int, config: StackConfig, judged: Judged, threshold: float
) -> None:
    """A picture as the network gets it, with boxes: right, wrong, and what it did not find."""
    image = region_of(pictures.shots[k], config).input(pictures.image(k))[0]
    axes.imshow(image)
    sure = judged.score >= threshold
    owner = match(judged.truth, judged.box[sure], judged.score[sure])
    for n, box in enumerate(judged.box[sure]):
        named = int(judged.box_class[sure][n])
        right = owner[n] >= 0 and judged.truth_class[owner[n]] == named
        _box(axes, box, "lime" if right else "red")
        axes.text(box[0], box[1] - 3, PART_CLASSES[named], color="w", fontsize=7)
    for i in set(range(len(judged.truth))) - set(owner.tolist()):
        _box(axes, judged.truth[i], "white")


def _box(axes: Axes, box, colour: str) -> None:
    left, top, right, bottom = box
    corners = [(left, top), (right, top), (right, bottom), (left, bottom)]
    axes.add_patch(Polygon(corners, fill=False, color=colour))

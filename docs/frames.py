"""Draws docs/frames.png, the README's figure of the frames, from the layout and the drawing.

Run it from the repository: `make docs`.
"""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Polygon

from twin.floor_plan import FOOTPRINT, machines
from twin.geometry import Array, apply, pose2_to_transform, rectangle, transform
from twin.layout import load_layout
from twin.stack.config import StackConfig

RED, GREEN, BLUE = "tab:red", "tab:green", "tab:blue"


def main() -> None:
    layout = load_layout()
    config = StackConfig(layout.site, layout.options)
    figure, (hall, vehicle) = plt.subplots(1, 2, figsize=(11, 5.4), width_ratios=(1.0, 1.15))
    draw_hall(hall, config)
    draw_vehicle(vehicle, config)
    for axes in (hall, vehicle):
        axes.set_aspect("equal")
        axes.text(
            0.99, 0.01, "x red, y green, z blue", transform=axes.transAxes, fontsize=7, ha="right"
        )
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(Path(__file__).parent / "frames.png", dpi=110)


def draw_hall(axes, config: StackConfig) -> None:
    """World, seen from above: hall, belt, way of the vehicle."""
    site = config.site
    axes.set_title("world: seen from above, metres")
    box = rectangle(
        np.mean(site.hall.x), np.mean(site.hall.y), 0, np.ptp(site.hall.x), np.ptp(site.hall.y)
    )
    axes.add_patch(Polygon(box, fill=False, color="0.6"))
    for boxes in machines(site).values():
        for box in boxes:
            axes.add_patch(Polygon(box, color="0.75"))
    draw_belt(axes, config, np.eye(4))
    tags = np.array([tag.pose[:2] for tag in site.tags])
    axes.plot(*tags.T, "s", color="0.4", markersize=2)
    for name, pose in (("dock", site.dock), ("pick", site.pick), ("receiving", site.receiving)):
        axes.add_patch(Polygon(rectangle(*pose, *FOOTPRINT), color="tab:orange", alpha=0.35))
        draw_frame(axes, pose2_to_transform(pose), f"base at {name}", 0.45)
    draw_frame(axes, transform(np.eye(3), (-0.8, -1.3, 0)), "", 0.6)
    axes.annotate("world axes (origin: dock)", (-0.75, -1.22), (-0.1, -1.35), fontsize=8)
    axes.set(xlim=(site.hall.x[0] - 0.2, site.hall.x[1] + 0.2))
    axes.set(ylim=(site.hall.y[0] - 0.2, site.hall.y[1] + 0.2))


def draw_vehicle(axes, config: StackConfig) -> None:
    """Base frame, seen from above, at the pick pose."""
    axes.set_title("base: seen from above at the pick pose, metres")
    axes.add_patch(Polygon(rectangle(0, 0, 0, *FOOTPRINT), color="tab:orange", alpha=0.2))
    T_world_base = pose2_to_transform(config.site.pick)
    draw_belt(axes, config, np.linalg.inv(T_world_base))
    wheels = config.wheels
    for i, name in enumerate(("fl", "fr", "rl", "rr")):
        x, y = wheels.half_base * (1 - i // 2 * 2), wheels.half_track * (1 - i % 2 * 2)
        axes.add_patch(Polygon(rectangle(x, y, 0, 2 * wheels.radius, 0.04), color="0.35"))
        axes.text(x, y, name, color="w", ha="center", va="center", fontsize=7)
    pitch = config.tray.pitch
    for x, y, _ in config.tray.slots():
        axes.add_patch(Polygon(rectangle(x, y, 0, pitch, pitch), fill=False, color="0.7", lw=0.6))
    draw_frame(axes, np.eye(4), "base", 0.14)
    for i, T in enumerate(config.T_base_arm):
        draw_frame(axes, T, f"arm{i}", 0.1)
    draw_frame(axes, config.T_base_lidar, "lidar", 0.1, below=-1.0)
    draw_frame(axes, config.camera.T_base_camera, "mast camera (z: view)", 0.1, optical=True)
    draw_frame(axes, config.rgbd.T_base_camera, "rgbd (z: view)", 0.1, optical=True)
    axes.set(xlim=(-0.75, 1.0), ylim=(-0.4, 0.75))


def draw_belt(axes, config: StackConfig, T_frame_world: Array) -> None:
    line = config.site.line
    along = np.array([np.cos(line.direction), np.sin(line.direction), 0.0])
    middle = np.array([*line.origin, 0.0]) + along * line.length / 2
    corners = np.array(rectangle(*middle[:2], line.direction, line.length, line.width))
    corners = apply(T_frame_world, np.column_stack([corners, np.zeros(4)]))
    axes.add_patch(Polygon(corners[:, :2], color="0.8"))
    start, end = apply(T_frame_world, np.array([middle - 0.3 * along, middle + 0.3 * along]))
    axes.annotate("", end[:2], start[:2], arrowprops={"arrowstyle": "->", "color": "0.3"})
    name = apply(T_frame_world, middle - 0.5 * along)
    axes.text(*name[:2], "belt", fontsize=8, color="0.3", ha="center", va="center")


def draw_frame(axes, T: Array, name: str, size: float, optical=False, below=0.3) -> None:
    """Axes of a frame (x red, y green, z blue); of an optical frame z and x: y points down."""
    origin = T[:2, 3]
    for i, colour in ((2, BLUE), (0, RED)) if optical else ((0, RED), (1, GREEN)):
        tip = origin + size * T[:2, i]
        style = {"arrowstyle": "-|>", "color": colour, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", tip, origin, arrowprops=style)
    axes.text(origin[0] + 0.05 * size, origin[1] - below * size, name, fontsize=8)


if __name__ == "__main__":
    main()

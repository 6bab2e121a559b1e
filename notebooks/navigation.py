# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#       format_version: '1.3'
#       jupytext_version: 1.19.6
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Maps and paths
#
# `twin run mapping` leaves maps in the ROS map_server format in its folder, `twin run navigate` the
# paths of a drive by the map. Here both are cut short; give `MAPPING` and `NAVIGATE` the folders of
# full runs, such as `runs/mapping-seed0`, to look at those instead.

# %%
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
from rich.console import Console

from evaluation.plots import plot_errors, plot_map, plot_paths
from evaluation.report import read_report, report_table
from twin.cli import main
from twin.layout import Layout

MAPPING = NAVIGATE = None

# %%
if MAPPING is None:
    MAPPING = Path(tempfile.mkdtemp()) / "mapping"
    main(["run", "mapping", "--duration", "25", "--out", str(MAPPING)])
if NAVIGATE is None:
    NAVIGATE = Path(tempfile.mkdtemp()) / "navigate"
    main(["run", "navigate", "--duration", "12", "--out", str(NAVIGATE)])

# %% [markdown]
# ## Maps
# The lidar sees the posts of a rack, the depth camera the edges of its decks; the fused map has
# both. What nobody has seen yet is grey.

# %%
figure, axes = plt.subplots(1, 3, figsize=(15, 4), sharey=True)
for axis, name in zip(axes, ("lidar", "rgbd", "fused"), strict=True):
    plot_map(axis, Path(MAPPING) / f"{name}.yaml")
    axis.set_title(name)
figure.tight_layout()

# %% [markdown]
# Scored against what was truly visible from the path: a run that is cut short has little to show.

# %%
Console().print(report_table(read_report(Path(MAPPING) / "report.json")))

# %% [markdown]
# ## Where the vehicle was, and where it thought it was

# %%
report = read_report(Path(NAVIGATE) / "report.json")
layout = Layout.model_validate(report["layout"])
figure, (left, right) = plt.subplots(1, 2, figsize=(14, 4.5))
plot_paths(left, Path(NAVIGATE), layout.site)
plot_errors(right, Path(NAVIGATE))
figure.tight_layout()

# %%
Console().print(report_table(report))

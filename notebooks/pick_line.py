# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Reading a run of `pick_line`
#
# A run leaves `report.json` and trajectories in its folder. Here a short run is made and read; give
# `FOLDER` the folder of a full one, such as `runs/demo`, to look at that instead.

# %%
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
from rich.console import Console

from evaluation.plots import plot_errors, plot_paths
from evaluation.report import read_report, report_table
from twin.cli import main
from twin.layout import Layout

FOLDER = None

# %%
if FOLDER is None:
    FOLDER = Path(tempfile.mkdtemp()) / "short"
    main(["run", "pick_line", "--duration", "4", "--out", str(FOLDER)])

# %% [markdown]
# ## Metrics
# A run that is cut short could not measure all of them.

# %%
report = read_report(Path(FOLDER) / "report.json")
Console().print(report_table(report))

# %% [markdown]
# ## Where the vehicle was, and where it thought it was

# %%
layout = Layout.model_validate(report["layout"])
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.5))
plot_paths(left, Path(FOLDER), layout.site)
plot_errors(right, Path(FOLDER))
figure.tight_layout()

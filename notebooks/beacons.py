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
# # The photoelectric network
#
# The two figures of Liu et al. 2022 beside ours. The source prints no data, only what its figures
# show: sigmas of 0.40, 2.62 and 2.80 mm along x, y and z, all errors of x within 2 mm and of y and
# z within 5 mm (Fig. 11), and residuals within 10 mm whatever the distance (Fig. 12). Those are the
# bands below. Our data are of full runs, kept beside this notebook, which these commands made:
#
# ```sh
# S="--set options.beacon_calibration=notebooks/beacon_calibration_seed0.json"
# twin run beacon_calibrate --seed 0  # leaves the calibration that is kept
# twin run beacon_repeat --seed 0 $S  # series.npz and report.json
# twin run beacon_parking --seed 0 $S  # moves.npz and report.json
# ```
#
# Give `REPEAT` and `PARKING` the folders of other runs to look at those instead.

# %%
from pathlib import Path

import matplotlib.pyplot as plt
from rich.console import Console

from evaluation.plots import plot_moves, plot_repeat
from evaluation.report import read_report, report_table

REPEAT, PARKING = Path("beacon_repeat_seed0"), Path("beacon_parking_seed0")

# %% [markdown]
# ## Figure 11: a vehicle at rest, measured 500 times
# Left the source's method, three nodes and one turn of the head. Then all nodes of the same turns,
# and the filter that goes on from turn to turn.

# %%
figure, axes = plt.subplots(1, 3, figsize=(15, 4), sharey=True)
for axis, method in zip(axes, ("source", "ours", "filtered"), strict=True):
    plot_repeat(axis, REPEAT, method)
figure.tight_layout()

# %%
Console().print(report_table(read_report(REPEAT / "report.json")))

# %% [markdown]
# ## Figure 12: 30 moves of 50 to 1000 mm
# Measured less true distance, by single turns of the head and by the filter.

# %%
figure, axis = plt.subplots(figsize=(8, 4))
plot_moves(axis, PARKING)

# %%
Console().print(report_table(read_report(PARKING / "report.json")))

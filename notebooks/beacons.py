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
# # The photoelectric network
#
# The two figures of Liu et al. 2022 beside ours. `twin run beacon_repeat` and `twin run
# beacon_parking` leave the data; here both are cut short and use a calibration that was measured
# before, of the vehicle of seed 0. Give `REPEAT` and `PARKING` the folders of full runs, such as
# `runs/beacon_repeat-seed0`, to look at those instead.

# %%
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
from rich.console import Console

from evaluation.plots import plot_moves, plot_repeat
from evaluation.report import read_report, report_table
from twin.cli import main

REPEAT = PARKING = None
CALIBRATION = "options.beacon_calibration=beacon_calibration_seed0.json"

# %%
out = Path(tempfile.mkdtemp())
if REPEAT is None:
    REPEAT = out / "repeat"
    main(["run", "beacon_repeat", "--duration", "8", "--out", str(REPEAT), "--set", CALIBRATION])
if PARKING is None:
    PARKING = out / "parking"
    main(["run", "beacon_parking", "--duration", "18", "--out", str(PARKING), "--set", CALIBRATION])

# %% [markdown]
# ## Figure 11: a vehicle at rest, measured again and again
# Left the source's method, three nodes and one turn of the head; it prints 0.40, 2.62 and 2.80 mm.
# Then all nodes of the same turns, and the filter that goes on from turn to turn.

# %%
figure, axes = plt.subplots(1, 3, figsize=(15, 4), sharey=True)
for axis, method in zip(axes, ("source", "ours", "filtered"), strict=True):
    plot_repeat(axis, Path(REPEAT), method)
figure.tight_layout()

# %%
Console().print(report_table(read_report(Path(REPEAT) / "report.json")))

# %% [markdown]
# ## Figure 12: moves of 50 to 1000 mm
# Measured less true distance, by single turns of the head and by the filter. The source finds all
# of its residuals within 10 mm, whatever the distance.

# %%
figure, axis = plt.subplots(figsize=(8, 4))
plot_moves(axis, Path(PARKING))

# %%
Console().print(report_table(read_report(Path(PARKING) / "report.json")))

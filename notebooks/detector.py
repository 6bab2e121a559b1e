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
# # What the connector detector sees
#
# Pictures with lights, belts and speeds that were never trained on, one for each kind of light,
# with what the networks report. `twin run detect` has the figures over the whole held-out set.

# %%
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from evaluation.detection import count
from evaluation.detector_figures import by_condition, table2_lines
from evaluation.judging import SEEN, judge_pictures
from evaluation.pictures import PictureSet
from evaluation.plots import plot_detections
from twin.layout import load_layout
from twin.stack.config import nominal_config
from twin.stack.detection.network import Network
from twin.stack.detection.second_look import patches
from twin.training.dataset import make_set
from twin.training.domain import HELD_OUT

COUNT = 12
layout = load_layout()
config = nominal_config(layout.site, layout.options)
folder = Path(tempfile.mkdtemp())
make_set(folder, layout, HELD_OUT, seed=1, count=COUNT)
pictures = PictureSet(folder)

# %%
network = Network()
judged = judge_pictures(pictures, config, network)
threshold = network.card.threshold
print("\n".join(table2_lines(count(judged, threshold))))
print("\n".join(by_condition(judged, threshold)))

# %% [markdown]
# Green: right. Red: wrong class, or nothing there. White: a part that was wanted and not found.

# %%
lights = ("normal", "dim", "side", "glare")
first = {
    light: next((k for k, s in enumerate(pictures.shots) if s.condition.light == light), None)
    for light in lights
}
figure, axes = plt.subplots(2, 2, figsize=(12, 9.5))
for axis, (light, k) in zip(axes.flat, first.items(), strict=True):
    if k is not None:
        plot_detections(axis, pictures, k, config, judged[k], threshold)
    axis.set_title(light)
    axis.axis("off")
figure.tight_layout()

# %% [markdown]
# The second look: each box again from the camera's full resolution, a square of 50 mm of the belt
# from near and far. Here are the two classes that are alike, male and female SMA end on the same N
# nut: what is there, and the chance that the second look gives it.

# %%
alike = ("sma_f_n_m", "sma_m_n_m")
z = config.site.line.height
figure, axes = plt.subplots(2, 6, figsize=(12, 4.6))
for row, name in zip(axes, alike, strict=True):
    spots = [
        (k, x)
        for k, s in enumerate(pictures.shots)
        for x in s.labels
        if x.part_class == name and x.visible >= SEEN
    ]
    for axis, (k, label) in zip(row, spots, strict=False):
        shown = patches(pictures.image(k), np.array([label.box]), pictures.shots[k].camera, z)
        chance = network.chances(shown)[0, label.index]
        axis.imshow(shown[0])
        axis.set_title(f"{name} {chance:.2f}", fontsize=9)
    for axis in row:
        axis.axis("off")
figure.tight_layout()

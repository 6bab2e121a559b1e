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
# # What the connector detector sees
#
# Pictures with lights, belts and speeds that were never trained on, one for each kind of light,
# with what the network reports. `twin run detect` has the figures over the whole held-out set.

# %%
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
from rich.console import Console

from evaluation.detection import count
from evaluation.detector_figures import by_condition, table2
from evaluation.judging import judge_pictures
from evaluation.pictures import PictureSet
from evaluation.plots import plot_detections
from twin.layout import load_layout
from twin.stack.config import nominal_config
from twin.stack.detection.network import Network
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
Console().print(table2(count(judged, threshold)))
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

"""Which lights, belts, textures and speeds a set of pictures is drawn from.

Training and held-out share no lamp direction, warmth of light, texture or belt speed. Two of the
held-out belts have colours of their own; the third, in both sets, is the cell's own green.
"""

from dataclasses import dataclass

import numpy as np

from evaluation.pictures import Angle, Condition, Height
from twin.training.textures import Texture

Span = tuple[float, float]

HEIGHTS: dict[Height, Span] = {"low": (-0.06, -0.03), "pick": (-0.004, 0.004), "high": (0.03, 0.08)}
ANGLES: dict[Angle, Span] = {"drawn": (0.0, 0.8), "tilted": (4.0, 9.0)}  # deg from the drawn axis


@dataclass(frozen=True)
class Domain:
    """Ranges of what differs between the two sets."""

    name: str
    azimuth_deg: tuple[Span, ...]  # where lamps stand, in world
    warmth: Span  # red over blue of a lamp
    textures: tuple[Texture, ...]
    belts: tuple[tuple[float, float, float], ...]  # colours about which belts are drawn
    speeds: tuple[Span, ...]  # m/s


TRAINING = Domain(
    name="training",
    azimuth_deg=((0, 70), (90, 160), (180, 250)),
    warmth=(0.90, 1.12),
    textures=("plain", "noise", "weave", "stripes", "scratches"),
    belts=((0.12, 0.22, 0.19), (0.05, 0.05, 0.06), (0.30, 0.31, 0.33), (0.10, 0.16, 0.30)),
    speeds=((0.0, 0.18), (0.30, 0.42)),
)
HELD_OUT = Domain(
    name="held-out",
    azimuth_deg=((262, 350), (72, 88)),
    warmth=(0.82, 0.90),
    textures=("diamonds", "blotches", "chevrons"),
    belts=((0.12, 0.22, 0.19), (0.22, 0.20, 0.17), (0.08, 0.13, 0.10)),
    speeds=((0.20, 0.28), (0.45, 0.50)),
)


def draw_condition(rng: np.random.Generator) -> Condition:
    """Normal light in four of ten pictures, parts in nine of ten."""
    pick = rng.choice
    return Condition(
        height=pick(["low", "pick", "high"], p=[0.25, 0.45, 0.30]),
        angle=pick(["drawn", "tilted"], p=[0.6, 0.4]),
        light=pick(["normal", "dim", "side", "glare"], p=[0.4, 0.15, 0.15, 0.3]),
        content=pick(["parts", "clutter", "empty"], p=[0.92, 0.05, 0.03]),
    )

"""Puts a model into the world: where it stands, and what its geoms may touch.

Collision classes are bit masks: floor for the rollers, things that stand, vehicle, arms, parts.
They are set here, so that every model keeps to them whatever its own file says.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from twin.geometry import Array
from twin.site import Pose2

FLOOR, STANDING, VEHICLE, ARM, PART = 1, 2, 4, 8, 16  # bits of the collision masks


@dataclass(frozen=True)
class Mask:
    """A pair of geoms is looked at when the type of one meets the affinity of the other."""

    contype: int
    conaffinity: int


MASKS = {
    "standing": Mask(STANDING, 0),  # fixed to the floor
    "loose": Mask(STANDING, STANDING | PART),  # stands on the floor by its weight, and can be hit
    "vehicle": Mask(VEHICLE, STANDING | ARM | PART),
    "arm": Mask(ARM, STANDING | VEHICLE | ARM | PART),
    "part": Mask(PART, STANDING | VEHICLE | ARM | PART),
}


def attach(
    spec: mujoco.MjSpec, child: mujoco.MjSpec, pose: Array | Pose2, prefix: str, mask: Mask
) -> None:
    """Put a model on the floor, its frame at `pose` in world, under names with a prefix."""
    set_masks(child, mask)
    spec.attach(child, frame=floor_frame(spec, pose), prefix=prefix)


def floor_frame(spec: mujoco.MjSpec, pose: Array | Pose2):
    """A frame on the floor at x, y, yaw in world."""
    half = pose[2] / 2
    return spec.worldbody.add_frame(
        pos=(pose[0], pose[1], 0), quat=(np.cos(half), 0, 0, np.sin(half))
    )


def set_masks(spec: mujoco.MjSpec, mask: Mask) -> None:
    """Give every geom that collides the masks of its class; rollers meet the floor alone."""
    for geom in spec.geoms:
        if geom.name.startswith("roller_"):
            geom.contype, geom.conaffinity = 0, FLOOR
        elif geom.contype or geom.conaffinity:
            geom.contype, geom.conaffinity = mask.contype, mask.conaffinity

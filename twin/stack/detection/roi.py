"""Fits the part of a picture that matters to the network's input, and boxes back to the picture."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.geometry import Array

WIDTH, HEIGHT = 416, 320  # px of the network's input: the mast camera's 4:3
MAX_SCALE = 1.25  # a picture is enlarged no further
GREY = 114  # what fills up the rest


@dataclass(frozen=True)
class Region:
    """A rectangle of the picture and its scale in the input, whose origins coincide."""

    left: int
    top: int
    width: int
    height: int
    scale: float  # px of the input a px of the picture

    @classmethod
    def around(cls, polygon: Array, size: tuple[int, int]) -> "Region":
        """The bounding box of a polygon, (k, 2), within a picture of this height and width."""
        low = np.clip(np.floor(polygon.min(axis=0)), 0, (size[1] - 1, size[0] - 1)).astype(int)
        high = np.clip(np.ceil(polygon.max(axis=0)) + 1, low + 1, (size[1], size[0])).astype(int)
        width, height = map(int, high - low)
        scale = min(WIDTH / width, HEIGHT / height, MAX_SCALE)
        return cls(int(low[0]), int(low[1]), width, height, scale)

    def input(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The network's input. Shape (1, 320, 416, 3)."""
        crop = image[self.top : self.top + self.height, self.left : self.left + self.width]
        size = max(1, round(self.width * self.scale)), max(1, round(self.height * self.scale))
        out = np.full((1, HEIGHT, WIDTH, 3), GREY, np.uint8)
        out[0, : size[1], : size[0]] = cv2.resize(crop, size, interpolation=cv2.INTER_LINEAR)
        return out

    def points_to_input(self, points: Array) -> Array:
        """Points of the picture in the input. Shape (k, 2)."""
        return (points - (self.left, self.top)) * self.scale

    def to_image(self, boxes: Array) -> Array:
        """Boxes of the input (left, top, right, bottom) in the picture. Shape (k, 4)."""
        return boxes / self.scale + (self.left, self.top, self.left, self.top)

    def to_input(self, boxes: Array) -> Array:
        """Boxes of the picture in the input. Shape (k, 4)."""
        return (boxes - (self.left, self.top, self.left, self.top)) * self.scale

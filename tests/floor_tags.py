"""Pictures of a floor tag as a downward camera takes them, drawn by its homography."""

import cv2
import numpy as np
import segno

from twin.geometry import Array, inverse, look_at, pose2_to_transform
from twin.stack.config import Camera
from twin.stack.detection.qr import TagDrawing
from twin.tag_text import TagText, format_tag

DRAWING = TagDrawing()
# 0.25 m up at the vehicle's tail, looking down; x of the picture to the vehicle's right.
DOWN = Camera(640, 480, 60.0, look_at((-0.20, 0.0, 0.25), (-0.20, 0.0, 0.0), up=(1.0, 0.0, 0.0)))
TILTED = Camera(640, 480, 60.0, look_at((-0.2, 0.0, 0.25), (-0.15, 0.03, 0.0), up=(1.0, 0.0, 0.0)))
TAG = TagText("G7", (12.35, -3.2, np.pi / 2), ("N4", "N5"))
FINE = 16  # texels a module
QUIET = 4  # modules of light rim
OVER = 3  # samples a pixel and axis


def code_image(text: str):
    """Texture with its quiet zone, and modules along an edge without it."""
    matrix = np.array([list(r) for r in segno.make(text, error="m", micro=False).matrix], np.uint8)
    light = 30 + 200 * (1 - np.pad(matrix, QUIET).astype(np.uint8))
    return np.kron(light, np.ones((FINE, FINE), np.uint8)), matrix.shape[0]


def picture(pose_base_tag, camera=DOWN, tag=TAG, rng=None, side=DRAWING.side, text=None) -> Array:
    """RGB picture of a tag at x, y, yaw in base. Shape (h, w, 3), uint8."""
    texture, modules = code_image(text or format_tag(tag))
    metres = side / (modules * FINE)  # a texel
    half = 0.5 * texture.shape[0]
    # Texel centres to tag: middle of texel 0 is at 0.5 from the corner; rows go down.
    tag_of_texel = np.array(
        [
            [metres, 0, (0.5 - half) * metres],
            [0, -metres, (half - 0.5) * metres],
            [0, 0, 1],
        ]
    )
    T_camera_tag = inverse(camera.T_base_camera) @ pose2_to_transform(pose_base_tag)
    H = camera.matrix @ T_camera_tag[:3, [0, 1, 3]] @ tag_of_texel
    finer = np.array([[OVER, 0, (OVER - 1) / 2], [0, OVER, (OVER - 1) / 2], [0, 0, 1.0]])
    size = (OVER * camera.width, OVER * camera.height)
    big = cv2.warpPerspective(
        texture, finer @ H, size, flags=cv2.INTER_AREA, borderMode=cv2.BORDER_CONSTANT,
        borderValue=110,
    )  # fmt: skip
    grey = big.reshape(camera.height, OVER, camera.width, OVER).mean(axis=(1, 3))
    grey = cv2.GaussianBlur(grey, (0, 0), 0.7)
    if rng is not None:
        grey = grey + rng.normal(0, 3.0, grey.shape)
    return np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8)[..., None], 3, axis=2)

"""Floor tags: from a picture of a downward camera to the pose of the vehicle.

The codes' finder patterns are carried through the calibrated camera onto the floor (Xu et al.,
Eq. 6), where their middle is the tag's place (Eq. 7) and their sides its direction. Frame `tag`:
origin at the middle of the code, x along its upper edge from left to right, y from its lower to its
upper edge, z up.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import zxingcpp

from twin.geometry import Array, compose2, rot2
from twin.messages import CameraFrame, FloorFrame
from twin.stack.config import Camera
from twin.stack.detection.finder_patterns import drawn_centres, finder_centres
from twin.tag_text import TagText, parse_tag

CODES = zxingcpp.BarcodeFormats([zxingcpp.BarcodeFormat.QRCode])


@dataclass(frozen=True)
class TagDrawing:
    """How floor tags are printed, and how exactly they are seen.

    Attributes:
        side: outer edge of the code without its quiet zone, m.
        scale: relative error of the seen size beyond which it was no tag on the floor.
        sigma: of a fix in x and y, m, and in yaw, rad. The tag's placement (2 mm, 0.3 degrees, as
            tags of this kind are stuck down) and the camera's mount after calibration (0.5 mm,
            1 mrad) make all of it: reading adds 0.1 mm and 0.2 mrad at any speed (rendered
            pictures; tests/test_floor_camera.py).
    """

    side: float = 0.100
    scale: float = 0.05
    sigma: tuple[float, float, float] = (0.0022, 0.0022, 0.0054)


@dataclass(frozen=True)
class TagFix:
    """One floor tag in one picture."""

    stamp: float  # of exposure, s
    text: TagText
    pose_base_tag: Array  # x, y (m), yaw (rad) of the tag in base. Shape (3,)
    centres_px: Array  # of the finder patterns. Shape (3, 2)
    covariance: Array  # of the vehicle's pose, in base axes. Shape (3, 3)

    def vehicle_pose(self, tag_pose: Array) -> Array:
        """Pose of the base in world, given the tag's. Shape (3,)."""
        x, y, yaw = self.pose_base_tag
        back = rot2(yaw).T @ (-x, -y)
        return compose2(tag_pose, (back[0], back[1], -yaw))


def to_floor(pixels: Array, camera: Camera) -> Array:
    """Points of the floor that pixels show (Xu et al., Eq. 6). Shape (n, 2) to (n, 2), m in base.

    The inverse of the intrinsic matrix makes a ray of the pixel, that of the extrinsic one turns it
    into base, and the floor, z = 0, sets its length. A pixel that shows no floor gives NaN.
    """
    homogeneous = np.column_stack([pixels, np.ones(len(pixels))])
    rays = homogeneous @ np.linalg.inv(camera.matrix).T @ camera.T_base_camera[:3, :3].T
    eye = camera.T_base_camera[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        length = -eye[2] / rays[:, 2:]
    return np.where(length > 0, eye[:2] + length * rays[:, :2], np.nan)


def tag_pose_in_base(points: Array, modules: int, side: float) -> tuple[Array, float]:
    """Pose of a tag from its finder centres on the floor, and its seen size over the drawn one.

    Args:
        points: upper left, upper right, lower left; in base, m. Shape (3, 2).
        modules: along an edge of the code.
        side: outer edge of the code, m.

    Returns:
        x, y, yaw of the tag in base, shape (3,), and the ratio of sizes.
    """
    # Xu et al., Eq. 7, on the floor rather than in the picture, where perspective bends the middle.
    middle = 0.5 * (points[1] + points[2])
    drawn = (drawn_centres(modules) / modules - 0.5) * (side, -side)
    a, b = drawn - drawn.mean(axis=0), points - points.mean(axis=0)
    # Best turn and size in the least-squares sense, as one complex number.
    ratio = np.sum((b[:, 0] + 1j * b[:, 1]) * (a[:, 0] - 1j * a[:, 1])) / np.sum(a**2)
    return np.array([*middle, np.angle(ratio)]), float(np.abs(ratio))


class TagReader:
    """Finds floor tags in pictures.

    Args:
        camera: downward camera as calibrated.
        drawing: of the tags.
    """

    def __init__(self, camera: Camera, drawing: TagDrawing | None = None):
        self._camera, self._drawing = camera, drawing or TagDrawing()
        self.refused = ""  # why the last code seen was no tag

    def read(self, frame: FloorFrame | CameraFrame) -> tuple[TagFix, ...]:
        """Tags in a picture; those that cannot be read or are no tag on the floor are left out."""
        image = np.asarray(frame.image)
        wanted = (self._camera.height, self._camera.width)
        if image.dtype != np.uint8 or image.shape[:2] != wanted:
            self.refused = f"picture of shape {image.shape}, {image.dtype}; wanted uint8 {wanted}"
            return ()
        if not np.isfinite(frame.stamp):
            self.refused = "picture without a finite stamp"
            return ()
        grey = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        codes = zxingcpp.read_barcodes(grey, formats=CODES)
        fixes = (self._fix(frame.stamp, np.ascontiguousarray(grey), code) for code in codes)
        return tuple(fix for fix in fixes if fix is not None)

    def _fix(self, stamp: float, grey, code: zxingcpp.Barcode) -> TagFix | None:
        text = parse_tag(code.text)
        if text is None:
            return self._refuse("a code that is no tag's")
        extra: Any = code.extra  # the binding types it as object
        modules = 17 + 4 * int(extra["Version"])
        at = code.position
        corners = np.array(
            [(p.x, p.y) for p in (at.top_left, at.top_right, at.bottom_right, at.bottom_left)],
            dtype=float,
        )
        centres = finder_centres(grey, corners, modules)
        if centres is None:
            return self._refuse(f"tag {text.tag_id}: its finder patterns are not clear")
        points = to_floor(centres, self._camera)
        pose, size = tag_pose_in_base(points, modules, self._drawing.side)
        if not abs(size - 1) <= self._drawing.scale:
            return self._refuse(f"tag {text.tag_id}: {size:.2f} of the drawn size")
        return TagFix(stamp, text, pose, centres, self._covariance(pose))

    def _covariance(self, pose: Array) -> Array:
        """Of the vehicle's pose: an error of the tag's yaw swings the vehicle about the tag."""
        x, y, yaw = self._drawing.sigma
        swing = np.array([pose[1], -pose[0], 1.0])
        return np.diag([x**2, y**2, 0.0]) + yaw**2 * np.outer(swing, swing)

    def _refuse(self, why: str) -> None:
        self.refused = why

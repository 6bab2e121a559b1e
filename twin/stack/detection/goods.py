"""Goods codes: what the mast camera reads on a parcel's lid, and where the parcel lies.

At the mast camera's distance a module of the code is two pixels, seen at a slant: too little for
the decoder. Where the lid is, is known, though: on a plane of known height. So the picture is laid
out on that plane first, at a scale of its own, which takes the slant away; in it places are metres.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import zxingcpp

from twin.geometry import Array, inverse
from twin.goods_text import parse_goods
from twin.messages import CameraFrame
from twin.stack.config import StackConfig
from twin.stack.detection.finder_patterns import finder_centres
from twin.stack.detection.qr import CODES, tag_pose_in_base

SCALE = 0.0005  # m a pixel of the picture laid out: a third of a module
WINDOW = (0.28, 0.20)  # m along x and y of base that are laid out, about where a parcel should be
SIZE_TOLERANCE = 0.08  # relative error of the seen size beyond which it lies on another plane


@dataclass(frozen=True)
class GoodsSight:
    """A goods code in one picture."""

    stamp: float  # of exposure, s
    rack: int  # that it names
    pose: Array  # x, y (m), yaw (rad) of the parcel in base at the exposure. Shape (3,)


class GoodsReader:
    """Reads the code of a parcel that stands at a known height.

    Args:
        config: camera, parcel and heights as drawn.
    """

    def __init__(self, config: StackConfig):
        self._camera, self._parcel = config.camera, config.parcel
        self._lid = config.stand_height + config.parcel.height
        self.refused = ""  # why the last picture gave nothing

    def read(self, frame: CameraFrame, about: Array) -> GoodsSight | None:
        """The parcel about x, y in base, m; None, and `refused`, if there is none to be read."""
        image = np.asarray(frame.image)
        wanted = (self._camera.height, self._camera.width, 3)
        if image.dtype != np.uint8 or image.shape != wanted:
            return self._refuse(f"picture of shape {image.shape}, {image.dtype}; wanted {wanted}")
        corner = np.asarray(about, dtype=float)[:2] + np.array([-WINDOW[0], WINDOW[1]]) / 2
        flat = self._lay_out(np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)), corner)
        codes = zxingcpp.read_barcodes(flat, formats=CODES)
        if not codes:
            return self._refuse("no code in sight")
        sights = [
            sight for code in codes if (sight := self._sight(frame.stamp, flat, code, corner))
        ]
        if len(sights) > 1:
            return self._refuse("more than one goods code in sight")
        return sights[0] if sights else None

    def _lay_out(self, grey, corner: Array):
        """The picture on the lid's plane: first row at the largest y, first column at `corner`."""
        width, height = (round(side / SCALE) for side in WINDOW)
        base_of_pixel = np.array(
            [[SCALE, 0, corner[0]], [0, -SCALE, corner[1]], [0, 0, self._lid], [0, 0, 1]]
        )
        H = self._camera.matrix @ (inverse(self._camera.T_base_camera) @ base_of_pixel)[:3]
        how = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpPerspective(grey, H, (width, height), flags=how), np.uint8)

    def _sight(
        self, stamp: float, flat, code: zxingcpp.Barcode, corner: Array
    ) -> GoodsSight | None:
        rack = parse_goods(code.text)
        extra: Any = code.extra  # the binding types it as object
        modules = 17 + 4 * int(extra["Version"])
        if rack is None or modules != self._parcel.code_modules:
            return self._refuse(f"'{code.text[:40]}' is no goods code")
        at = code.position
        outline = np.array(
            [(p.x, p.y) for p in (at.top_left, at.top_right, at.bottom_right, at.bottom_left)],
            dtype=float,
        )
        centres = finder_centres(flat, outline, modules)
        if centres is None:
            return self._refuse("its finder patterns are not clear")
        points = corner + SCALE * centres * (1, -1)
        pose, size = tag_pose_in_base(points, modules, self._parcel.code_side)
        if not abs(size - 1) <= SIZE_TOLERANCE:
            return self._refuse(f"{size:.2f} of the drawn size: it lies elsewhere")
        return GoodsSight(stamp, rack, pose)

    def _refuse(self, why: str) -> None:
        self.refused = why

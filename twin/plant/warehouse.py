"""The warehouse: racks with their number plates, and the stand at goods-in."""

from pathlib import Path

import cv2
import mujoco
import numpy as np

from twin.geometry import Array
from twin.layout import Layout, Tolerances
from twin.plant.assembly import MASKS, attach
from twin.plant.model_files import load_model
from twin.plant.site_as_built import SiteAsBuilt
from twin.site import Rack

RACK_YAW = np.radians(0.2)  # rad, 1 sigma: 4 mm at each end of a rack of 2.4 m; guess
RACKS = 1  # stream of the floor's seed that is theirs
PLATE_PIXELS = (96, 160)  # rows, columns of a number plate's print


def add_warehouse(
    spec: mujoco.MjSpec, layout: Layout, floor_seed: int, built: SiteAsBuilt, root: Path
) -> None:
    """Put racks and goods-in stand into the world, under `rack<number>/` and `goods_in/`.

    Args:
        spec: the world.
        layout: its drawing and tolerances.
        floor_seed: of this floor: of how far each rack stands off the drawing.
        built: where the stand is.
        root: folder of the models.
    """
    for i, rack in enumerate(layout.site.racks):
        model = load_model(root, "warehouse/rack.xml")
        _print_number(model, rack.number)
        rng = np.random.default_rng((floor_seed, RACKS, i))
        pose = rack_pose(rack, layout.world.tolerances, rng)
        attach(spec, model, pose, f"rack{rack.number}/", MASKS["standing"])
    if layout.site.goods_in is not None:
        stand = load_model(root, "warehouse/stand.xml")
        pose = built.machine("goods-in", layout.site.goods_in)
        attach(spec, stand, pose, "goods_in/", MASKS["standing"])


def rack_pose(rack: Rack, tolerances: Tolerances, rng: np.random.Generator) -> Array:
    """Where a rack really stands. Shape (3,): x, y, yaw in world."""
    sigma = np.array([tolerances.rack_xy, tolerances.rack_xy, RACK_YAW])
    return np.asarray(rack.pose) + tolerances.scale * sigma * rng.standard_normal(3)


def _print_number(rack: mujoco.MjSpec, number: int) -> None:
    """Print the rack's number, black on yellow, on its plate."""
    rows, columns = PLATE_PIXELS
    plate = np.full((rows, columns, 3), (245, 200, 40), np.uint8)
    text, font, scale, stroke = str(number), cv2.FONT_HERSHEY_SIMPLEX, 2.6, 8
    (width, height), _ = cv2.getTextSize(text, font, scale, stroke)
    corner = ((columns - width) // 2, (rows + height) // 2)
    cv2.putText(plate, text, corner, font, scale, (20, 20, 20), stroke, cv2.LINE_AA)
    texture = rack.texture("number")
    texture.width, texture.height, texture.nchannel = columns, rows, 3
    texture.data = plate.tobytes()

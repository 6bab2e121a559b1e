"""The parcel that waits at goods-in, with the code that names its rack on its lid."""

from pathlib import Path

import mujoco
import numpy as np

from twin.geometry import Array, compose2, quat_wxyz, rot_z
from twin.goods_text import format_goods
from twin.layout import Layout
from twin.plant.assembly import MASKS, set_masks
from twin.plant.floor_tags import printed_code
from twin.plant.model_files import load_model
from twin.plant.site_as_built import SiteAsBuilt
from twin.site import Pose2

NAME = "part_parcel_0"  # of its body and free joint
PLACE = (0.12, 0.45, 0.0)  # in the vehicle's frame at goods-in: before the front arm
FACE = 0.70  # m, of the stand
PARCEL = 2  # stream of the floor's seed that is the parcel's
QUIET = 2  # modules of light rim: the lid has no more


def add_parcel(
    spec: mujoco.MjSpec, layout: Layout, floor_seed: int, built: SiteAsBuilt, root: Path
) -> None:
    """Put the parcel of a transport order on the goods-in stand, not quite where it should lie.

    Args:
        spec: the world.
        layout: its drawing and `world.parcel`.
        floor_seed: of this floor: of how the parcel was put down.
        built: where the stand is.
        root: folder of the models.
    """
    if layout.site.goods_in is None:
        return
    model = load_model(root, "parcel/parcel.xml")
    set_masks(model, MASKS["part"])
    code = printed_code(format_goods(layout.world.parcel.rack), QUIET)
    texture = model.texture("goods_code")
    texture.height, texture.width, texture.nchannel = *code.shape, 3
    texture.data = np.repeat(code[:, :, None], 3, axis=2).tobytes()
    stand = built.machine("goods-in", layout.site.goods_in)
    x, y, yaw = parcel_pose(layout, stand, floor_seed)
    frame = spec.worldbody.add_frame(pos=(x, y, FACE), quat=quat_wxyz(rot_z(yaw)))
    body = frame.attach_body(model.worldbody.first_body(), f"{NAME}/", "")
    body.name = NAME
    body.add_freejoint(name=NAME)


def parcel_pose(layout: Layout, goods_in: Array | Pose2, floor_seed: int) -> Array:
    """Where the parcel lies: about its place on a stand served from `goods_in`, drawn by seed.

    x, y, yaw in world. Shape (3,).
    """
    drawn = layout.world.parcel
    rng = np.random.default_rng((floor_seed, PARCEL))
    most = np.array([drawn.xy, drawn.xy, np.radians(drawn.yaw_deg)])
    return compose2(compose2(goods_in, PLACE), rng.uniform(-most, most))

"""Floor tags: printed plates with QR codes, stuck down about where the drawing has them.

Each plate carries a code of its own, as a texture that only a camera can read. Frame of a plate:
origin at the middle of the code, x along its upper edge from left to right, y from its lower to its
upper edge, z up.
"""

import mujoco
import numpy as np
import segno
from numpy.typing import NDArray

from twin.geometry import Array, compose2
from twin.layout import Layout, TagFault, Tolerances
from twin.site import Tag
from twin.tag_text import TagText, format_tag

SIDE = 0.100  # outer edge of the code, m
QUIET = 4  # modules of light rim, ISO/IEC 18004
TEXELS = 8  # a module
THICKNESS = 0.0005  # m, laminated foil: guess
INK, PAPER = 20, 235  # grey values of print on white vinyl: guess
TORN = 0.6  # share of a damaged code's width that is gone: more than any correction makes good
FOREIGN_TEXT = "HTTPS://EXAMPLE.ORG/PALLET/17"  # what a carton may have left behind


def printed_code(text: str, quiet: int = QUIET) -> NDArray[np.uint8]:
    """A QR code with its quiet zone of so many modules, first row on top. Shape (n, n), grey."""
    rows = segno.make(text, error="m", micro=False).matrix
    dark = np.pad(np.array([list(row) for row in rows], dtype=bool), quiet)
    grey = np.where(dark, INK, PAPER).astype(np.uint8)
    return np.kron(grey, np.ones((TEXELS, TEXELS), np.uint8))


def plate_side(texture: NDArray[np.uint8], code_side: float = SIDE) -> float:
    """Edge of the whole plate so that the code in it has `code_side`, m."""
    modules = texture.shape[0] / TEXELS
    return code_side * modules / (modules - 2 * QUIET)


def add_floor_tags(spec: mujoco.MjSpec, layout: Layout, floor_seed: int) -> None:
    """Stick down the tags of a site.

    Args:
        spec: the world.
        layout: its drawing, tolerances and faults.
        floor_seed: of this floor; a tag keeps its place whatever is done to the others.
    """
    faults = {fault.tag: fault for fault in layout.world.faults.tags}
    for i, tag in enumerate(layout.site.tags):
        fault = faults.get(tag.name)
        texture = printed_code(_text(tag, fault, layout.site.tags))
        if fault is not None and fault.kind == "damaged":
            texture[:, : int(TORN * texture.shape[1])] = PAPER
        rng = np.random.default_rng((floor_seed, i))
        pose = true_pose(tag, fault, layout.world.tolerances, rng)
        add_plate(spec, f"tag_{tag.name}", texture, plate_side(texture), pose)


def true_pose(
    tag: Tag, fault: TagFault | None, tolerances: Tolerances, rng: np.random.Generator
) -> Array:
    """Where a tag lies: the drawing's pose, less than exactly, and shifted if misplaced. (3,)."""
    x, y, yaw = rng.standard_normal(3) * tolerances.scale
    off = (x * tolerances.tag_xy, y * tolerances.tag_xy, yaw * np.radians(tolerances.tag_yaw_deg))
    pose = compose2(tag.pose, off)
    return compose2(pose, fault.shift) if fault is not None and fault.kind == "misplaced" else pose


def _text(tag: Tag, fault: TagFault | None, tags: tuple[Tag, ...]) -> str:
    """What a tag's code says. A foreign one says what the next tag of the drawing should say."""
    if fault is not None and fault.kind == "foreign":
        if len(tags) == 1:
            return FOREIGN_TEXT
        tag = tags[(tags.index(tag) + 1) % len(tags)]
    yaw = float(np.arctan2(np.sin(tag.pose[2]), np.cos(tag.pose[2])))
    return format_tag(TagText(tag.name, (tag.pose[0], tag.pose[1], yaw), tag.next))


def add_plate(
    spec: mujoco.MjSpec, name: str, texture: NDArray[np.uint8], side: float, pose: Array
) -> None:
    """A thin plate on the floor, of which cameras see the upper face and nothing feels anything."""
    material = add_printed(spec, name, texture)
    x, y, yaw = pose
    spec.worldbody.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=(x, y, THICKNESS / 2),
        quat=(np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)),
        size=(side / 2, side / 2, THICKNESS / 2),
        material=material,
        group=0,
        contype=0,
        conaffinity=0,
    )


def add_printed(spec: mujoco.MjSpec, name: str, texture: NDArray[np.uint8]) -> str:
    """A material that shows a texture once over the x-y face of a box; its name."""
    image = spec.add_texture(
        name=name,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        height=texture.shape[0],
        width=texture.shape[1],
        nchannel=3,
    )
    # MuJoCo lays the first row along the box's upper edge (+y), from -x to +x.
    image.data = np.repeat(texture[:, :, None], 3, axis=2).tobytes()
    material = spec.add_material(name=name, specular=0.05, shininess=0.05)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    return name

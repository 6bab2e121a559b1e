"""The photoelectric network as built: nodes on a wall truss, and the head on the vehicle.

A node stands where the laser tracker measured it, less the tracker's error: the drawing is what was
measured, and only the plant knows what is true.
"""

from pathlib import Path

import mujoco
import numpy as np

from twin.geometry import Array, quat_wxyz, rot_z, transform
from twin.layout import Layout
from twin.plant.as_built import AsBuilt
from twin.plant.assembly import MASKS, set_masks
from twin.plant.model_files import load_model
from twin.site import BeaconNetwork

STREAM = 3  # of the floor's seed that is the survey's
# The head's axis and T0 behind it, as drawn; `twin/stack/config.py` has the same.
T_BASE_HEAD = transform(rot_z(np.pi), (0.318, -0.218, 0.92))
PROFILE = 0.020, 0.009  # m, half width and depth of the truss's aluminium profile, 40 x 18 mm
BEHIND = 0.049  # m from the diodes' plane to the middle of the profiles
OVERHANG = 0.08  # m of profile beyond the outermost nodes


def node_positions(network: BeaconNetwork, floor_seed: int, scale: float) -> Array:
    """True places of the diodes in world, m. Shape (n, 3)."""
    surveyed = np.array([node.position for node in network.nodes])
    return surveyed - survey_error(network, np.random.default_rng((floor_seed, STREAM)), scale)


def survey_error(network: BeaconNetwork, rng: np.random.Generator, scale: float) -> Array:
    """Surveyed less true places, m. Shape (n, 3)."""
    sigma = np.array([[network.survey_sigma(node)] for node in network.nodes])
    return np.asarray(scale * sigma * rng.standard_normal((len(sigma), 3)), dtype=np.float64)


def add_network(spec: mujoco.MjSpec, layout: Layout, as_built: AsBuilt, root: Path) -> None:
    """Put nodes and truss on the wall, under `beacons/`, and the head on the vehicle, `head/`."""
    network = layout.site.beacons
    assert network is not None
    true = node_positions(network, as_built.floor_seed, layout.world.tolerances.scale)
    for node, position in zip(network.nodes, true, strict=True):
        model = load_model(root, "beacon/node.xml")
        set_masks(model, MASKS["standing"])
        quat = quat_wxyz(rot_z(node.facing))
        frame = spec.worldbody.add_frame(pos=position, quat=quat)
        spec.attach(model, frame=frame, prefix=f"beacons/{node.name}/")
    _add_truss(spec, network)
    head = load_model(root, "beacon/head.xml")
    set_masks(head, MASKS["vehicle"])
    T = T_BASE_HEAD @ as_built.beacon_mount
    frame = spec.body("agv/base").add_frame(pos=T[:3, 3], quat=quat_wxyz(T[:3, :3]))
    spec.attach(head, frame=frame, prefix="head/")


def _add_truss(spec: mujoco.MjSpec, network: BeaconNetwork) -> None:
    """A frame of profiles behind the nodes that look the same way as the first."""
    facing = network.nodes[0].facing
    R = rot_z(facing)
    p = np.array([n.position for n in network.nodes if n.facing == facing]) @ R
    (x, low_y, low_z), (_, high_y, high_z) = p.min(axis=0), p.max(axis=0)
    x, middle = x - BEHIND, ((low_y + high_y) / 2, (low_z + high_z) / 2)
    half_y, half_z = (high_y - low_y) / 2 + OVERHANG, (high_z - low_z) / 2 + OVERHANG
    spec.add_material(name="profile", rgba=(0.36, 0.40, 0.46, 1), specular=0.5, shininess=0.4)
    wide, deep = PROFILE
    uprights = [(y, middle[1], wide, half_z) for y in (low_y, middle[0], high_y)]
    rails = [(middle[0], z, half_y, wide) for z in (low_z, high_z)]
    for i, (y, z, size_y, size_z) in enumerate([*uprights, *rails]):
        depth = 0.0 if i < len(uprights) else 0.002  # so that the rails' faces are seen
        spec.worldbody.add_geom(
            name=f"beacons/profile_{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=R @ np.array([x + depth, y, z]),
            quat=quat_wxyz(R),
            size=(deep, size_y, size_z),
            material="profile",
            group=1,
            contype=MASKS["standing"].contype,
            conaffinity=0,
        )

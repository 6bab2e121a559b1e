"""Draws what stands before the camera: parts, clutter, lamps and where the camera is."""

import numpy as np

from evaluation.pictures import Condition
from twin.geometry import Array, pose2_to_transform, rot2, rot_x, rot_y, rot_z, transform
from twin.messages import PartClass
from twin.plant.feeder import class_of
from twin.plant.studio import Lamp, Scene
from twin.plant.studio_clutter import OCCLUDER
from twin.stack.config import StackConfig
from twin.training.domain import ANGLES, HEIGHTS, Domain

APART = 0.050  # m between parts that the feeder laid; real ones are 0.08 m apart
CROWDED = 0.036  # m between parts in a tenth of the pictures: they touch
BEYOND = 0.05  # m of the belt past the window, on which parts lie as well
WINDOW_LENGTH = 0.47  # m of belt within the window
POSE_SIGMA = (0.010, 0.005, 0.010)  # m, m, rad: where the vehicle stops


def draw_scene(
    config: StackConfig,
    part_names: tuple[str, ...],
    clutter_names: tuple[str, ...],
    domain: Domain,
    condition: Condition,
    rng: np.random.Generator,
) -> tuple[Scene, Array]:
    """A scene and the pose of the base from which it is seen, (3,) in world."""
    pose = np.array(config.site.pick) + rng.normal(0, POSE_SIGMA)
    T_world_camera = pose2_to_transform(pose) @ config.camera.T_base_camera @ _moved(condition, rng)
    T_world_camera[2, 3] += rng.uniform(*HEIGHTS[condition.height])
    parts: dict[str, Array] = {}
    clutter: dict[str, Array] = {}
    spots = _spots(config, pose, rng)
    if condition.content == "parts":
        for name in _choose(part_names, int(rng.integers(4, 10)), rng):
            if spots:
                parts[name] = np.array([*spots.pop(), rng.uniform(-np.pi, np.pi)])
    lying = [n for n in clutter_names if n != OCCLUDER]
    some = {"parts": int(rng.integers(0, 3)), "clutter": int(rng.integers(3, 9)), "empty": 0}
    for name in rng.permutation(lying)[: some[condition.content]]:
        if spots:
            clutter[str(name)] = np.array([*spots.pop(), rng.uniform(-np.pi, np.pi), 0.0])
    if parts and rng.random() < 0.2:
        x, y, _ = next(iter(parts.values()))
        towards = T_world_camera[:2, 3] - (x, y)
        height = rng.uniform(0.04, 0.10)
        shift = towards * height / (T_world_camera[2, 3] - config.site.line.height)
        place = np.array([x, y]) + shift + rng.normal(0, 0.015, 2)
        clutter[OCCLUDER] = np.array([*place, rng.uniform(-np.pi, np.pi), height])
    dim = {"normal": rng.uniform(0.8, 1.15), "dim": rng.uniform(0.3, 0.55)}
    scene = Scene(
        T_world_camera=T_world_camera,
        fovy_deg=config.camera.fovy_deg * float(rng.uniform(0.998, 1.002)),
        parts=parts,
        clutter=clutter,
        clutter_colour={name: _colour(rng) for name in clutter},
        lamps=_lamps(domain, condition, dim.get(condition.light, 1.0), rng),
        ambient=float(rng.uniform(0.22, 0.42)) * dim.get(condition.light, 0.8),
        belt=_near(domain.belts[rng.integers(len(domain.belts))], 0.25, rng),
        shine=float(rng.uniform(0.2, 0.7) if condition.light != "glare" else rng.uniform(0.7, 1)),
        tint=_near((1.0, 1.0, 1.0), 0.07, rng),
    )
    return scene, pose


def _moved(condition: Condition, rng: np.random.Generator) -> Array:
    """Camera turned off its drawn axis, about any direction, and a little about it."""
    angle = np.radians(rng.uniform(*ANGLES[condition.angle]))
    about = rng.uniform(0, 2 * np.pi)
    roll = np.radians(rng.normal(0, 0.3 if condition.angle == "drawn" else 4.0))
    R = rot_x(angle * np.cos(about)) @ rot_y(angle * np.sin(about)) @ rot_z(roll)
    return transform(R, (0.0, 0.0, 0.0))


def _spots(config: StackConfig, pose: Array, rng: np.random.Generator) -> list[Array]:
    """Free places on the belt in view of the window, in random order, in world."""
    line = config.site.line
    along = rot2(line.direction)
    # The window's ends along the belt: base x falls as the belt runs.
    ahead = rot2(pose[2]) @ (0.33, 0.0) + pose[:2] - line.origin
    end = float((along.T @ ahead)[0])
    low, high = end - WINDOW_LENGTH - BEYOND, end + BEYOND
    across = line.width / 2 - 0.03
    apart = CROWDED if rng.random() < 0.1 else APART
    taken: list[Array] = []
    for _ in range(120):
        spot = rng.uniform((low, -across), (high, across))
        if all(np.hypot(*(spot - t)) > apart for t in taken):
            taken.append(spot)
    return [np.asarray(line.origin) + along @ s for s in taken]


def _choose(names: tuple[str, ...], count: int, rng: np.random.Generator) -> list[str]:
    """Parts of random classes, every class as often as any other."""
    left: dict[PartClass, list[str]] = {}
    for name in names:
        left.setdefault(class_of(name), []).append(name)
    chosen = []
    for _ in range(count):
        some = [names for names in left.values() if names]
        chosen.append(some[rng.integers(len(some))].pop())
    return chosen


def _lamps(domain: Domain, condition: Condition, dim: float, rng) -> tuple[Lamp, Lamp]:
    side = condition.light == "side"
    glare = condition.light == "glare"
    lamps = []
    for k in range(2):
        span = domain.azimuth_deg[rng.integers(len(domain.azimuth_deg))]
        azimuth = np.radians(rng.uniform(*span))
        elevation = np.radians(rng.uniform(12, 35) if side else rng.uniform(40, 80))
        direction = (
            -np.cos(elevation) * np.cos(azimuth),
            -np.cos(elevation) * np.sin(azimuth),
            -np.sin(elevation),
        )
        strength = dim * rng.uniform(0.25, 0.42)
        if side:
            strength = rng.uniform(0.45, 0.7) if k == 0 else rng.uniform(0.0, 0.12)
        warmth = float(np.sqrt(rng.uniform(*domain.warmth)))
        colour = (strength * warmth, strength, strength / warmth)
        shine = rng.uniform(0.6, 1.0) if glare else rng.uniform(0.1, 0.4) * dim
        lamps.append(Lamp(direction, colour, (shine,) * 3))
    return lamps[0], lamps[1]


def _colour(rng: np.random.Generator) -> tuple[float, float, float]:
    """Of clutter: mostly metal, now and then brass or plastic."""
    kind = rng.random()
    if kind < 0.6:
        return _near((0.72, 0.72, 0.70), 0.12, rng)
    if kind < 0.75:
        return _near((0.85, 0.65, 0.25), 0.1, rng)
    return tuple(map(float, rng.uniform(0.05, 0.9, 3)))  # type: ignore[return-value]


def _near(colour, spread: float, rng) -> tuple[float, float, float]:
    factor = rng.uniform(1 - spread, 1 + spread) * rng.uniform(1 - spread / 3, 1 + spread / 3, 3)
    return tuple(map(float, np.clip(np.array(colour) * factor, 0, 1)))  # type: ignore

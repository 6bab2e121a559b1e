"""What stands where. A layout file has three parts: `site`, `world` and `options`.

`Site` (`twin.site`) is the surveyed drawing: the stack may know it. `World` is everything else
about the plant (belt speed, what is fed, tolerances, faults): the stack never sees it. `Options`
choose how the stack works.
"""

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import Field, ValidationError, model_validator

from twin.messages import PART_CLASSES, PartClass
from twin.site import (
    Angle,
    Interval,
    Name,
    Pose2,
    Position2,
    Position3,
    Segment,
    Site,
    Strict,
)

TRAY_SLOTS, ONE_ARM_SLOTS = 28, 26  # parts that the tray takes, and that one arm alone can place


class LayoutError(ValueError):
    """A layout that cannot be built. The message is one line."""


class LineWorld(Strict):
    speed: Annotated[float, Field(ge=0.05, le=0.5)]
    friction: Annotated[float, Field(gt=0.1, le=2.0)] = 0.9


class Feeder(Strict):
    rate: Annotated[float, Field(gt=0, le=3.0)]
    min_spacing: Annotated[float, Field(ge=0.08, le=1.0)]
    lateral: Annotated[float, Field(ge=0.0, le=0.08)]


class Tolerances(Strict):
    """Of what was built, against the drawing; 0 = exactly the drawing."""

    scale: Annotated[float, Field(ge=0.0, le=5.0)] = 1.0
    dock_xy: Annotated[float, Field(ge=0.0, le=0.1)] = 0.010
    dock_yaw_deg: Annotated[float, Field(ge=0.0, le=5.0)] = 0.3
    wall_xy: Annotated[float, Field(ge=0.0, le=0.05)] = 0.005  # +-m, walls and partitions
    machine_xy: Annotated[float, Field(ge=0.0, le=0.05)] = 0.003  # +-m, belt, stations, stand
    rack_xy: Annotated[float, Field(ge=0.0, le=0.05)] = 0.004  # 1 sigma, m
    tag_xy: Annotated[float, Field(ge=0.0, le=0.05)] = 0.002  # 1 sigma, m
    tag_yaw_deg: Annotated[float, Field(ge=0.0, le=5.0)] = 0.3  # 1 sigma


class Sensors(Strict):
    latency_scale: Annotated[float, Field(ge=0.0, le=10.0)] = 1.0
    noise_scale: Annotated[float, Field(ge=0.0, le=10.0)] = 1.0
    cameras: bool = True


class BeaconHardware(Strict):
    """Head on the vehicle and truss on the wall, and how steady their clocks and spin are."""

    fitted: bool = False
    crossing_noise: Annotated[float, Field(ge=0.0, le=1e-4)] = 0.387e-6  # s, 1 sigma of a stamp
    sync_noise: Annotated[float, Field(ge=0.0, le=1e-4)] = 0.05e-6  # s, likewise; guess
    spin_jitter: Annotated[float, Field(ge=0.0, le=1e-2)] = 1e-5  # of the speed, by turn; guess
    clock_drift: Annotated[float, Field(ge=0.0, le=2e-4)] = 50e-6  # relative, 1 sigma of a quartz
    missed: Annotated[float, Field(ge=0.0, le=1.0)] = 0.001  # share of light pulses unseen; guess


class Obstacle(Strict):
    """Something that stands on the floor and is not in the drawing.

    Lidar and depth camera each miss some: a low box lies under the lidar's plane, a table's top
    above it, a black panel throws its light back too weakly, a glass panel not at all.
    """

    kind: Literal[
        "carton", "pillar", "low_box", "table", "black_panel", "glass_panel", "calibration_board"
    ]
    pose: Pose2
    appears: Annotated[float, Field(ge=0.0, le=3600.0)] = 0.0  # s; 0: there from the start
    near: Annotated[float, Field(ge=0.0, le=20.0)] = 0.0  # m: appears when the vehicle is so near


class Mover(Strict):
    """A cart that goes to and fro along a path.

    It brakes for a vehicle in its protective field (`twin.plant.mover`) and gives way to nobody.
    """

    path: Annotated[tuple[Position2, ...], Field(min_length=2, max_length=50)]
    speed: Annotated[float, Field(gt=0.0, le=2.0)] = 0.5
    starts: Annotated[float, Field(ge=0.0, le=3600.0)] = 0.0


class WetPatch(Strict):
    """A rectangle of the floor on which wheels slip."""

    x: Interval
    y: Interval
    friction: Annotated[float, Field(ge=0.005, le=1.0)] = 0.04

    @model_validator(mode="after")
    def _intervals_rise(self):
        for name, (low, high) in (("x", self.x), ("y", self.y)):
            if low >= high:
                raise ValueError(f"{name}: [{low}, {high}] must go from low to high")
        return self


class TagFault(Strict):
    """A floor tag that is stuck down elsewhere, torn, or printed for another place."""

    tag: Name
    kind: Literal["misplaced", "damaged", "foreign"]
    shift: Pose2 = (0.0, 0.0, 0.0)  # of a misplaced one, in its own axes


class Kidnap(Strict):
    """The vehicle is carried to another place while it stands or drives."""

    at: Annotated[float, Field(gt=0.0, le=3600.0)]  # s
    pose: Pose2


class Parcel(Strict):
    """What a transport order finds at goods-in."""

    rack: Annotated[int, Field(ge=1, le=999)] = 7  # that its code names
    xy: Annotated[float, Field(ge=0.0, le=0.02)] = 0.010  # m, +- off its place
    yaw_deg: Annotated[float, Field(ge=0.0, le=15.0)] = 5.0  # +-


class Reflection(Strict):
    """A node also sees the head's planes by way of something that mirrors them."""

    node: Name
    shift: Position3  # of the node's image from the node, m
    hides: bool = False  # the direct light is blocked, the mirrored alone arrives
    share: Annotated[float, Field(ge=0.0, le=1.0)] = 1.0  # of the head's turns that show it


class BeaconFaults(Strict):
    """What goes wrong in the photoelectric network."""

    blocked: tuple[Name, ...] = ()  # nodes to which no light of the head comes
    reflections: Annotated[tuple[Reflection, ...], Field(max_length=32)] = ()
    # turns of the head after which the lot makes another node blocked and another one reflect,
    # besides those above; 0: never
    shuffle: Annotated[int, Field(ge=0, le=1_000_000)] = 0


class Faults(Strict):
    """What goes wrong, and where: only the plant knows."""

    obstacles: tuple[Obstacle, ...] = ()
    movers: tuple[Mover, ...] = ()
    wet: tuple[WetPatch, ...] = ()
    tags: tuple[TagFault, ...] = ()
    kidnaps: tuple[Kidnap, ...] = ()
    beacons: BeaconFaults = BeaconFaults()


class Panel(Strict):
    """A panel that is put somewhere on a line."""

    kind: Literal["black_panel", "glass_panel"]
    line: Segment  # of its middle
    yaw: Angle


class Hazards(Strict):
    """Where scenarios may put what comes in the way; what and when is drawn by the run's seed.

    Whatever stands there must leave the vehicle a way: nothing checks that.
    """

    mouths: tuple[Pose2, ...] = ()  # middles of aisles, yaw along them: things stand beside
    panels: tuple[Panel, ...] = ()
    carts: tuple[Annotated[tuple[Position2, ...], Field(min_length=2, max_length=50)], ...] = ()


class World(Strict):
    """What only the plant knows."""

    line: LineWorld
    feeder: Feeder
    tolerances: Tolerances = Tolerances()
    sensors: Sensors = Sensors()
    beacons: BeaconHardware = BeaconHardware()
    faults: Faults = Faults()
    hazards: Hazards = Hazards()
    parcel: Parcel = Parcel()
    order: dict[PartClass, Annotated[int, Field(ge=0, le=20)]]

    @model_validator(mode="after")
    def _order_fits(self):
        total = sum(self.order.values())
        if not 1 <= total <= TRAY_SLOTS:
            raise ValueError(f"order: {total} parts; the tray takes 1 to {TRAY_SLOTS}")
        return self


class Options(Strict):
    """How the stack is to work."""

    grasp_timing: bool = True
    arms: Annotated[int, Field(ge=1, le=2)] = 2
    tags: bool = True  # floor tags correct the pose
    start_known: bool = True  # the vehicle is told that it starts in its dock
    map: str | None = None  # folder of a `mapping` run to drive by; else by the drawing
    calibration: str | None = None  # its calibration.json: where the depth camera really hangs
    motion_model: Literal["omni", "turn_path_turn"] = "omni"  # of AMCL's particles
    # How the photoelectric network corrects the pose: by all nodes, or by Liu et al.'s method.
    beacons: Literal["off", "all", "source"] = "off"
    beacon_calibration: str | None = None  # file of a `beacon_calibrate` run; else the drawing
    aisle: Literal["pose", "line"] = "pose"  # what steers on long straights: pose or seen wall
    detector: Literal["network", "contour"] = "network"  # what tells the connectors apart


class Layout(Strict):
    site: Site
    world: World
    options: Options = Options()

    @model_validator(mode="after")
    def _one_arm_can_place_the_order(self):
        total = sum(self.world.order.values())
        if self.options.arms == 1 and total > ONE_ARM_SLOTS:
            raise ValueError(f"world.order: {total} parts; one arm alone can place {ONE_ARM_SLOTS}")
        return self

    @model_validator(mode="after")
    def _faults_name_what_there_is(self):
        known, seen = [tag.name for tag in self.site.tags], set()
        for fault in self.world.faults.tags:
            if fault.tag not in known:
                raise ValueError(f"world.faults.tags: no tag '{fault.tag}' in the drawing")
            if fault.tag in seen:
                raise ValueError(f"world.faults.tags: two faults of tag '{fault.tag}'")
            seen.add(fault.tag)
        return self

    @model_validator(mode="after")
    def _the_network_is_drawn(self):
        network, world = self.site.beacons, self.world
        if network is None:
            if world.beacons.fitted or self.options.beacons != "off":
                raise ValueError("site.beacons: there is no photoelectric network in the drawing")
            return self
        if self.options.beacons != "off" and not world.beacons.fitted:
            raise ValueError("options.beacons: wants world.beacons.fitted = true")
        known = [node.name for node in network.nodes]
        faults = world.faults.beacons
        for name in (*faults.blocked, *(r.node for r in faults.reflections)):
            if name not in known:
                raise ValueError(f"world.faults.beacons: no node '{name}'; there are {known}")
        ill = {*faults.blocked, *(r.node for r in faults.reflections)}
        if faults.shuffle and len(known) - len(ill) < 2:
            raise ValueError("world.faults.beacons.shuffle: wants two nodes without a fault")
        return self

    @model_validator(mode="after")
    def _parts_stay_on_the_belt(self):
        most = self.site.line.width / 2 - 0.04
        if self.world.feeder.lateral > most + 1e-9:
            raise ValueError(
                f"world.feeder.lateral: {self.world.feeder.lateral} m;"
                f" a belt this wide takes at most {most:.3f} m"
            )
        return self


SHORT_NAMES = {
    "belt_speed": "world.line.speed",
    "feed_rate": "world.feeder.rate",
    "order": "world.order",
    "grasp_timing": "options.grasp_timing",
    "arms": "options.arms",
}


def models_dir() -> Path:
    """Folder of the models: inside the installed package, else at the repository's root."""
    packaged = Path(__file__).parent / "_models"
    return packaged if packaged.is_dir() else Path(__file__).parent.parent / "models"


def load_layout(path: Path | None = None, overrides: tuple[str, ...] = ()) -> Layout:
    """Layout of a TOML file (the default cell without one) with `key=value` overrides applied last.

    Raises:
        LayoutError: one line naming what is wrong, where, and the valid choices.
    """
    path = path or models_dir() / "cell" / "default.toml"
    try:
        tree = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise LayoutError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError) as error:  # of tomllib, of decoding, of nesting
        raise LayoutError(f"{path}: not a TOML file ({error})") from None
    for override in overrides:
        _set(tree, override)
    try:
        return Layout.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "layout"
        source = f"{path.name} with --set" if overrides else path.name
        raise LayoutError(f"{source}: {where}: {_explain(first)}") from None


def _explain(error: Any) -> str:
    """What pydantic found wrong, with the valid keys or the value that was given."""
    if error["type"] == "extra_forbidden":
        model: Any = Layout
        for part in error["loc"][:-1]:
            # a number is a place in a tuple of models
            field = isinstance(part, str)
            model = model.model_fields[part].annotation if field else get_args(model)[0]
        return f"unknown key; choose from {', '.join(model.model_fields)}"
    message = error["msg"].removeprefix("Value error, ")
    given = error["input"]
    if not isinstance(given, int | float | str):
        return message
    shown = repr(given)
    return f"{message}, not {shown if len(shown) < 60 else shown[:60] + '...'}"


def _set(tree: dict[str, Any], override: str) -> None:
    key, sign, text = override.partition("=")
    if not sign or not key:
        raise LayoutError(f"--set {override}: expected key=value")
    dotted = SHORT_NAMES.get(key, key)
    if "." not in dotted:
        raise LayoutError(
            f"--set {key}: unknown; give a dotted layout path or one of {', '.join(SHORT_NAMES)}"
        )
    *path, last = dotted.split(".")
    node = tree
    for part in path:
        node = node.setdefault(part, {})
        if not isinstance(node, dict):
            raise LayoutError(f"--set {key}: {part} has no parts of its own")
    node[last] = _parse_order(text) if dotted == "world.order" else _parse(text)


def _parse(text: str) -> Any:
    if text in ("on", "off"):
        return text == "on"
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text


def _parse_order(text: str) -> dict[str, Any]:
    """`sma_f_n_m:3,n_tee_fff:2`, or a single number of parts spread evenly over the classes."""
    if text.isascii() and text.isdigit() and len(text) < 5:
        total, n = int(text), len(PART_CLASSES)
        return {c: total // n + (i < total % n) for i, c in enumerate(PART_CLASSES)}
    order: dict[str, Any] = {}
    for item in text.strip("{} ").split(","):
        name, _, count = item.replace("=", ":").partition(":")
        name = name.strip()
        if name not in PART_CLASSES:
            raise LayoutError(
                f"--set order: unknown class '{name[:40]}'; choose from {', '.join(PART_CLASSES)}"
            )
        if name in order:
            raise LayoutError(f"--set order: {name} stands there twice")
        order[name] = _parse(count.strip())
    return order

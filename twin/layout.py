"""What stands where. A layout file has three parts: `site`, `world` and `options`.

`Site` is the surveyed drawing: the stack may know it. `World` is everything else about the plant
(belt speed, what is fed, tolerances): the stack never sees it. `Options` choose how the stack
works.
"""

import math
import tomllib
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from twin.geometry import rectangle, rectangles_overlap, swept_rectangles
from twin.messages import PART_CLASSES, PartClass

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Pose2 = tuple[Finite, Finite, Finite]  # x, y, yaw
Interval = tuple[Finite, Finite]

FOOTPRINT = (0.70, 0.50)  # vehicle, m
BIN_LENGTH = 0.45  # m past the belt's end
BELT_LEFT = 0.45  # m from the vehicle's centre to the belt's: what the arms reach best
BELT_AHEAD, BELT_BEHIND = 1.2, 0.7  # m of belt that camera and hood, and the rear arm need


class LayoutError(ValueError):
    """A layout that cannot be built. The message is one line."""


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Line(_Model):
    """The belt as drawn."""

    origin: tuple[Finite, Finite]
    direction: Finite
    length: Annotated[float, Field(ge=1.5, le=4.0)]
    width: Annotated[float, Field(ge=0.12, le=0.30)]
    height: Annotated[float, Field(ge=0.66, le=0.74)]


class Hall(_Model):
    x: Interval
    y: Interval


class Site(_Model):
    """The surveyed drawing, known to plant and stack."""

    dock: Pose2
    pick: Pose2
    receiving: Pose2
    route_to_pick: tuple[Pose2, ...]
    route_to_receiving: tuple[Pose2, ...]
    line: Line
    hall: Hall

    @model_validator(mode="after")
    def _can_be_built(self):
        x, y = self.hall.x, self.hall.y
        if x[0] >= x[1] or y[0] >= y[1]:
            raise ValueError("hall: each interval must go from low to high")
        # The belt with its rails and, past its end, the bin.
        length = self.line.length + BIN_LENGTH
        machine = rectangle(
            *_along(self.line, length / 2), self.line.direction, length, self.line.width + 0.04
        )
        if not self._inside(machine):
            raise ValueError("line: belt and bin reach outside the hall")
        for name, pose in self._stations().items():
            box = rectangle(*pose, *FOOTPRINT)
            if rectangles_overlap(box, machine):
                raise ValueError(f"{name}: the vehicle would stand in the belt")
            if not self._inside(box):
                raise ValueError(f"{name}: the vehicle would stand outside the hall")
        for (first, a), (second, b) in self._legs():
            if any(rectangles_overlap(box, machine) for box in swept_rectangles(a, b, *FOOTPRINT)):
                raise ValueError(f"from {first} to {second} the vehicle would run into the belt")
        return self

    @model_validator(mode="after")
    def _belt_is_within_reach(self):
        """The vehicle picks off a belt on its left that comes towards it."""
        dx, dy = self.line.origin[0] - self.pick[0], self.line.origin[1] - self.pick[1]
        c, s = math.cos(self.pick[2]), math.sin(self.pick[2])
        ahead, left = c * dx + s * dy, -s * dx + c * dy
        turn = math.remainder(self.line.direction - self.pick[2] - math.pi, 2 * math.pi)
        if abs(turn) > math.radians(1.0):
            raise ValueError("pick: the belt must run against the vehicle's heading (yaw + pi)")
        if abs(left - BELT_LEFT) > 0.02:
            raise ValueError(
                f"pick: the belt's centre line must run {BELT_LEFT} m to the left of the vehicle,"
                f" give or take 0.02 (it runs {left:.2f} m to the left)"
            )
        if ahead < BELT_AHEAD or self.line.length - ahead < BELT_BEHIND:
            raise ValueError(
                f"pick: the belt must reach {BELT_AHEAD} m ahead of the vehicle and {BELT_BEHIND} m"
                f" behind (it reaches {ahead:.2f} and {self.line.length - ahead:.2f} m)"
            )
        return self

    def _stations(self) -> dict[str, Pose2]:
        named = {"dock": self.dock, "pick": self.pick, "receiving": self.receiving}
        named |= {f"route_to_pick[{i}]": p for i, p in enumerate(self.route_to_pick)}
        return named | {
            f"route_to_receiving[{i}]": p for i, p in enumerate(self.route_to_receiving)
        }

    def _legs(self):
        """Pairs of named poses between which the vehicle drives."""
        named = self._stations()
        there = ["dock", *(n for n in named if n.startswith("route_to_pick")), "pick"]
        away = ["pick", *(n for n in named if n.startswith("route_to_receiving")), "receiving"]
        for names in (there, away):
            yield from pairwise((n, named[n]) for n in names)

    def _inside(self, box) -> bool:
        x, y = self.hall.x, self.hall.y
        return all(x[0] < px < x[1] and y[0] < py < y[1] for px, py in box)


class LineWorld(_Model):
    speed: Annotated[float, Field(ge=0.0, le=0.5)]
    friction: Annotated[float, Field(gt=0.1, le=2.0)] = 0.9


class Feeder(_Model):
    rate: Annotated[float, Field(gt=0, le=3.0)]
    min_spacing: Annotated[float, Field(ge=0.08, le=1.0)]
    lateral: Annotated[float, Field(ge=0.0, le=0.08)]


class Tolerances(_Model):
    scale: Annotated[float, Field(ge=0.0, le=5.0)] = 1.0
    dock_xy: Annotated[float, Field(ge=0.0, le=0.1)] = 0.010
    dock_yaw_deg: Annotated[float, Field(ge=0.0, le=5.0)] = 0.3


class Sensors(_Model):
    latency_scale: Annotated[float, Field(ge=0.0, le=10.0)] = 1.0
    noise_scale: Annotated[float, Field(ge=0.0, le=10.0)] = 1.0


class World(_Model):
    """What only the plant knows."""

    line: LineWorld
    feeder: Feeder
    tolerances: Tolerances = Tolerances()
    sensors: Sensors = Sensors()
    order: dict[PartClass, Annotated[int, Field(ge=0, le=20)]]

    @model_validator(mode="after")
    def _order_fits(self):
        total = sum(self.order.values())
        if not 1 <= total <= 28:
            raise ValueError(f"order: {total} parts; the tray takes 1 to 28")
        return self


class Options(_Model):
    """How the stack is to work."""

    grasp_timing: bool = True
    arms: Annotated[int, Field(ge=1, le=2)] = 2


class Layout(_Model):
    site: Site
    world: World
    options: Options = Options()

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
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
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
            model = model.model_fields[part].annotation
        return f"unknown key; choose from {', '.join(model.model_fields)}"
    message = error["msg"].removeprefix("Value error, ")
    given = error["input"]
    return f"{message}, not {given!r}" if isinstance(given, int | float | str) else message


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
    except tomllib.TOMLDecodeError:
        return text


def _parse_order(text: str) -> dict[str, Any]:
    """`sma_f_n_m:3,n_tee_fff:2`, or a single number of parts spread evenly over the classes."""
    if text.isdigit():
        total, n = int(text), len(PART_CLASSES)
        return {c: total // n + (i < total % n) for i, c in enumerate(PART_CLASSES)}
    order: dict[str, Any] = {}
    for item in text.strip("{} ").split(","):
        name, _, count = item.replace("=", ":").partition(":")
        name = name.strip()
        if name not in PART_CLASSES:
            raise LayoutError(
                f"--set order: unknown class '{name}'; choose from {', '.join(PART_CLASSES)}"
            )
        order[name] = _parse(count.strip())
    return order


def _along(line: Line, distance: float) -> tuple[float, float]:
    return (
        line.origin[0] + distance * math.cos(line.direction),
        line.origin[1] + distance * math.sin(line.direction),
    )

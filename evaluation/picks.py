"""Pick metrics from plant truth: what was gripped, dropped, missed, delivered, and how exactly.

Definitions: an attempt is a gripper close command; time at the line runs from the first stop in
the pick zone to leaving it; a part is delivered when it lies at rest in a slot with the vehicle
stopped within 10 cm of the receiving point; missed is a still-wanted part that left the pick
window.
"""

from collections import Counter
from dataclasses import dataclass
from typing import cast

import numpy as np

from twin.geometry import apply, inverse, rot_z
from twin.layout import Layout
from twin.loop import Tick
from twin.messages import PartClass
from twin.stack.config import StackConfig

STOPPED = 0.01  # m/s: slower than this the vehicle stands
ZONE = 0.30  # m from the drawn pick pose: the pick zone
LEFT = 0.10  # m from where it stopped: it has left
AT_RECEIVING = 0.10  # m
AT_REST = 0.02  # m/s
LIFTED = 0.02  # m above the resting height: held, not lying
LET_GO = 0.10  # s without contact after which the fingers have let go


@dataclass
class _Held:
    """A part between the fingers of an arm."""

    part: str
    seen: float  # when the fingers last held it
    lifted: bool = False


class PickMonitor:
    """Watches truth and commands tick by tick; `metrics()` at the end."""

    def __init__(self, layout: Layout, config: StackConfig):
        self.layout, self.config = layout, config
        # m along x of the base: what is behind it no working arm can reach any more.
        self._window_end = min(w[0] for w in config.pick_windows[: config.options.arms])
        self.stopped_at: float | None = None
        self.left_at: float | None = None
        self.stop_pose = np.zeros(3)
        self.first_grip: float | None = None
        self.attempts = 0
        self.grip_force_max = 0.0
        self.intercept_errors: list[float] = []
        self.timing_errors: list[float] = []
        self.missed: list[str] = []
        self.lifted: list[str] = []  # once for each time that a part was lifted
        self.dropped: list[str] = []
        self.events: list[tuple[float, str]] = []
        self._width = {0: np.inf, 1: np.inf}
        self._held: dict[int, _Held] = {}
        self._before: dict[str, float] = {}
        self._last: Tick | None = None

    def observe(self, tick: Tick) -> None:
        self._last = tick
        self._watch_vehicle(tick)
        self._watch_grippers(tick)
        if self.stopped_at is not None and self.left_at is None:
            self._watch_window(tick)

    # --- the vehicle ---------------------------------------------------------------------------

    def _watch_vehicle(self, tick: Tick) -> None:
        pose, t = tick.truth.pose, tick.stamp
        speed = float(np.hypot(*tick.truth.velocity[:2]))
        near = np.hypot(*(pose[:2] - np.array(self.layout.site.pick[:2]))) < ZONE
        if self.stopped_at is None and near and speed < STOPPED:
            self.stopped_at, self.stop_pose = t, pose.copy()
            self.events.append((t, "stopped at the line"))
        away = np.hypot(*(pose[:2] - self.stop_pose[:2])) > LEFT
        if self.stopped_at is not None and self.left_at is None and away:
            self.left_at = t
            self.events.append((t, "left the line"))

    # --- the grippers --------------------------------------------------------------------------

    def _watch_grippers(self, tick: Tick) -> None:
        truth = tick.truth
        for command in tick.commands.grippers:
            # A close command is one below the opening last asked for; opening again ends it.
            closer = command.width < self._width[command.arm] - 0.002 and command.force > 0
            if closer and self._closing(command.width):
                self._attempt(tick, command.arm)
            self._width[command.arm] = command.width
        for arm, grip in enumerate(truth.grips):
            self.grip_force_max = max(self.grip_force_max, grip.force)
            held = self._held.get(arm)
            if held and grip.part != held.part and tick.stamp - held.seen > LET_GO:
                self._let_go(tick, self._held.pop(arm))
                held = None
            if grip.part is None or (held and held.part != grip.part):
                continue
            if self.first_grip is None and self.stopped_at is not None:
                self.first_grip = tick.stamp
            held = self._held.setdefault(arm, _Held(grip.part, tick.stamp))
            held.seen = tick.stamp
            height = truth.T_world_part(grip.part)[2, 3] - self.config.site.line.height
            if height > LIFTED and not held.lifted:
                held.lifted = True
                self.lifted.append(grip.part)

    def _let_go(self, tick: Tick, held: _Held) -> None:
        """A lifted part that leaves the fingers anywhere but in a slot was dropped."""
        if held.lifted and held.part not in self._in_slots(tick):
            self.dropped.append(held.part)
            self.events.append((tick.stamp, f"dropped {held.part}"))

    def _closing(self, width: float) -> bool:
        """Whether a command of this opening closes on a part (and is not just a pre-opening)."""
        return width < min(p.grip_width for p in self.config.parts.values())

    def _attempt(self, tick: Tick, arm: int) -> None:
        self.attempts += 1
        tcp, best = tick.truth.T_world_tcp[arm], None
        for name in tick.truth.part_names:
            T = tick.truth.T_world_part(name)
            drawing = self.config.parts[part_class(name)]
            yaw = np.arctan2(T[1, 0], T[0, 0])
            grasp = T[:3, 3] + rot_z(yaw) @ (drawing.grasp_x, drawing.grasp_y, 0.0)
            error = tcp[:2, 3] - grasp[:2]
            if best is None or np.hypot(*error) < np.hypot(*best):
                best = error
        if best is None or np.hypot(*best) > 0.08:
            return  # closed on nothing at all: the attempt counts, an error cannot be told
        heading = self.layout.site.line.direction
        along = best @ np.array([np.cos(heading), np.sin(heading)])
        self.intercept_errors.append(float(np.hypot(*best)))
        if self.layout.world.line.speed > 0:
            self.timing_errors.append(abs(float(along)) / self.layout.world.line.speed)

    # --- the pick window -----------------------------------------------------------------------

    def _watch_window(self, tick: Tick) -> None:
        """Parts that pass the window's end while their class is still wanted."""
        T_base_world = inverse(tick.truth.T_world_base)
        held = {h.part for h in self._held.values()}
        in_tray = Counter(part_class(n) for n in self._in_slots(tick))
        in_hand = Counter(part_class(n) for n in held)
        line = self.layout.site.line
        p_base = apply(T_base_world, tick.truth.part_position)
        for name, x, z in zip(tick.truth.part_names, p_base[:, 0], p_base[:, 2], strict=True):
            before = self._before.get(name)
            self._before[name] = x
            on_belt = abs(z - line.height) < 0.05 and name not in held
            if before is None or not on_belt or not before >= self._window_end > x:
                continue
            c = part_class(name)
            if in_tray[c] + in_hand[c] < self.layout.world.order.get(c, 0):
                self.missed.append(name)
                self.events.append((tick.stamp, f"missed {name}"))

    def _in_slots(self, tick: Tick) -> dict[str, float]:
        """Parts lying in a slot, one a slot: name to distance from the slot's centre, m."""
        slots, tray = self.config.tray.slots(), self.config.tray
        held = {h.part for h in self._held.values()}
        p_base = apply(inverse(tick.truth.T_world_base), tick.truth.part_position)
        best: dict[int, tuple[float, str]] = {}
        for name, p in zip(tick.truth.part_names, p_base, strict=True):
            offset = slots[:, :2] - p[:2]
            i = int(np.argmin(np.hypot(*offset.T)))
            within = np.all(np.abs(offset[i]) < tray.pitch / 2)
            if within and abs(p[2] - tray.floor) < 0.04 and name not in held:
                distance = float(np.hypot(*offset[i]))
                best[i] = min(best.get(i, (np.inf, "")), (distance, name))
        return {name: distance for distance, name in best.values()}

    def counts(self) -> dict[str, float]:
        """What has happened so far, for plots over time."""
        seen = {"attempts": self.attempts, "lifted": len(self.lifted), "missed": len(self.missed)}
        return {name: float(n) for name, n in seen.items()}

    # --- the end -------------------------------------------------------------------------------

    def metrics(self) -> dict[str, float]:
        """All pick metrics; NaN where the run did not get far enough to tell."""
        tick, nan = self._last, float("nan")
        if tick is None:
            return {}
        pose, target = tick.truth.pose, self.layout.site.receiving
        there = np.hypot(pose[0] - target[0], pose[1] - target[1]) <= AT_RECEIVING
        there = there and float(np.hypot(*tick.truth.velocity[:2])) < STOPPED
        lying = self._in_slots(tick)
        # Also what was laid down well and has left its slot since.
        gone = set(self.lifted) - set(lying) - set(self.dropped)
        gone -= {h.part for h in self._held.values()}
        speed = np.linalg.norm(tick.truth.part_velocity, axis=1)
        at_rest = {n for n, v in zip(tick.truth.part_names, speed, strict=True) if v < AT_REST}
        at_rest &= set(lying)
        slotted: Counter[PartClass] = Counter(part_class(n) for n in at_rest if there)
        order = self.layout.world.order
        delivered = sum(min(slotted[c], order.get(c, 0)) for c in slotted)
        stopped = nan if self.stopped_at is None else self.stopped_at
        at_line = (nan if self.left_at is None else self.left_at) - stopped
        rate = delivered / at_line * 3600 if at_line > 0 else nan
        return {
            "ordered": float(sum(order.values())),
            "delivered": float(delivered),
            "time_at_line_s": at_line,
            "pick_rate_per_hour": rate,
            "cycle_time_s": at_line / delivered if delivered else nan,
            "attempts": float(self.attempts),
            "pick_success": delivered / self.attempts if self.attempts else nan,
            "dropped": float(len(self.dropped) + len(gone)),
            "missed": float(len(self.missed)),
            "wrong_class": float(sum(slotted.values()) - delivered),
            "placement_error_max_mm": 1e3 * max((lying[n] for n in at_rest), default=nan),
            "grip_force_max_n": self.grip_force_max,
            "intercept_error_p95_mm": 1e3 * _p95(self.intercept_errors),
            "close_time_error_p95_ms": 1e3 * _p95(self.timing_errors),
            "first_grip_delay_s": (nan if self.first_grip is None else self.first_grip) - stopped,
        }


def part_class(name: str) -> PartClass:
    """Class of a part by its name `part_<class>_<k>`."""
    return cast(PartClass, name.removeprefix("part_").rpartition("_")[0])


def _p95(values: list[float]) -> float:
    return float(np.percentile(values, 95)) if values else float("nan")

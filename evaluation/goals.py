"""Whether the vehicle stood where it was sent, by the plant's truth.

A goal counts as reached when the stack says so and the true pose is near enough at that instant.
"""

from collections.abc import Sequence

import numpy as np

from evaluation.trajectories import MOVING
from twin.geometry import wrap_angle
from twin.loop import Tick
from twin.messages import Goal

NEAR, NEAR_YAW_DEG = 0.05, 3.0  # m, degrees of a goal that was truly reached
BLOCKED = "the way is blocked"  # how the navigator's event of a new way begins


class GoalMonitor:
    """Follows a drive order; `metrics()` at the end.

    Args:
        goals: in the order in which they were given.
    """

    def __init__(self, goals: Sequence[Goal]):
        self.goals = tuple(goals)
        self.reached = 0
        self.replans = self.recoveries = 0
        self.distance = self.moving = 0.0
        self.notes: list[str] = []
        self._off: list[tuple[float, float]] = []  # m, degrees, of those that the stack calls so
        self._told, self._recovering = 0, False
        self._last: Tick | None = None

    def observe(self, tick: Tick) -> None:
        navigation = tick.state.navigation
        for i in range(self._told, len(navigation.outcomes)):
            self._judge(tick, self.goals[i], *navigation.outcomes[i])
        self._told = len(navigation.outcomes)
        self.recoveries += bool(navigation.recovery) and not self._recovering
        self._recovering = bool(navigation.recovery)
        self.replans += sum(e.startswith(BLOCKED) for e in tick.state.events)
        if self._last is not None:
            step = tick.truth.pose[:2] - self._last.truth.pose[:2]
            self.distance += float(np.hypot(*step))
            if np.any(np.abs(tick.truth.velocity) > MOVING):
                self.moving += tick.stamp - self._last.stamp
        self._last = tick

    def _judge(self, tick: Tick, goal: Goal, name: str, outcome: str) -> None:
        if outcome != "reached":
            self.notes.append(f"{tick.stamp:.2f} s: {name}: {outcome}")
            return
        away = float(np.hypot(*(tick.truth.pose[:2] - np.array(goal.pose[:2]))))
        turn = abs(float(np.degrees(wrap_angle(tick.truth.pose[2] - goal.pose[2]))))
        self._off.append((away, turn))
        good = away <= NEAR and turn <= NEAR_YAW_DEG
        self.reached += good
        word = "reached" if good else "NOT reached, though the stack says so"
        self.notes.append(
            f"{tick.stamp:.2f} s: {name}: {word}, {1e3 * away:.0f} mm and {turn:.1f} deg off"
        )

    def metrics(self) -> dict[str, float]:
        """Figures for the report; NaN for what did not occur."""
        off = np.array(self._off).reshape(-1, 2)
        nothing = float("nan")
        time = self._last.stamp if self._last is not None else nothing
        return {
            "goals_reached": self.reached / len(self.goals),
            "goals": float(len(self.goals)),
            "goal_error_max_mm": 1e3 * float(off[:, 0].max()) if len(off) else nothing,
            "goal_error_rms_mm": 1e3 * float(np.sqrt(np.mean(off[:, 0] ** 2)))
            if len(off)
            else nothing,
            "goal_yaw_error_max_deg": float(off[:, 1].max()) if len(off) else nothing,
            "distance_m": self.distance,
            "time_s": time,
            "moving_speed_mean": self.distance / self.moving if self.moving else nothing,
            "replans": float(self.replans),
            "recoveries": float(self.recoveries),
        }

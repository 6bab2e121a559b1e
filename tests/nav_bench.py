"""Bench of navigation without a plant: wheel loops as drawn, a lidar in a room of segments."""

import numpy as np
from flat_world import scan

from twin.geometry import compose2
from twin.layout import load_layout
from twin.stack.config import DriveLimits, nominal_config
from twin.stack.estimation.odometry import exp2
from twin.stack.estimation.site_map import floor_map
from twin.stack.planning.navigator import Navigator

DT = 0.01
LIMITS = DriveLimits()
LAYOUT = load_layout()
CONFIG = nominal_config(LAYOUT.site, LAYOUT.options)


class WheelLoops:
    """Velocity answer (T s + 1) / (L T s^2 + T s + 1) after a dead time, as the drawing has it."""

    def __init__(self):
        self.velocity, self._integral = np.zeros(3), np.zeros(3)
        self._delayed = [np.zeros(3)] * 2

    def step(self, command: np.ndarray) -> np.ndarray:
        lag, washout = np.array(LIMITS.velocity_lag), LIMITS.lag_washout
        self._delayed.append(command)
        wanted = self._delayed.pop(0)
        for _ in range(10):
            error = wanted - self.velocity
            self._integral += error / (lag * washout) * DT / 10
            self.velocity = self.velocity + (error / lag + self._integral) * DT / 10
        return self.velocity


def walls():
    """Everything of the drawing as segments in world. Shape (n, 2, 2)."""
    from twin.floor_plan import machines
    from twin.geometry import rectangle

    (x0, x1), (y0, y1) = LAYOUT.site.hall.x, LAYOUT.site.hall.y
    boxes = [box for each in machines(LAYOUT.site).values() for box in each]
    boxes.append(rectangle((x0 + x1) / 2, (y0 + y1) / 2, 0.0, x1 - x0, y1 - y0))
    return np.array([[b[i - 1], b[i]] for b in boxes for i in range(4)])


def block(x, y, size=0.3):
    """A square box. Shape (4, 2, 2)."""
    c = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * size / 2 + [x, y]
    return np.stack([c, np.roll(c, -1, axis=0)], axis=1)


class NavBench:
    """One vehicle that drives by what its lidar sees.

    Args:
        start: x, y, yaw in world.
        seed: of the noise of scans and poses.
        more: segments that the drawing does not have, by time. Shape (n, 2, 2).
        noise: m, of the localised pose that the navigator is told.
    """

    def __init__(self, start, seed=0, more=lambda now: np.zeros((0, 2, 2)), noise=0.003):
        self.pose, self.now = np.array(start, dtype=float), 0.0
        self.navigator = Navigator(CONFIG, floor_map(LAYOUT.site))
        self.loops, self.rng = WheelLoops(), np.random.default_rng(seed)
        self.more, self.noise, self.walls = more, noise, walls()
        self.rows, self.events = [], []
        self._scan, self._tick = None, 0

    def tick(self):
        if self._tick % 10 == 0:
            lidar = compose2(self.pose, (0.300, 0.0, 0.0))
            seen = np.vstack([self.walls, self.more(self.now)])
            self._scan = (scan(seen, lidar, self.rng, self.now), self.believed())
        if self._tick % 10 == 3:
            self.navigator.hear(*self._scan)
        command = self.navigator.step(self.now, self.believed(), self.loops.velocity)
        self.pose = compose2(self.pose, exp2(self.loops.step(command.as_array()) * DT))
        self.rows.append([self.now, *self.pose, *self.loops.velocity])
        self.events += [(self.now, e) for e in self.navigator.events]
        self.navigator.events.clear()
        self._tick += 1
        self.now = self._tick * DT

    def believed(self):
        error = self.noise * np.array([1.0, 1.0, 0.3])
        wander = np.sin(self.now * np.array([1.3, 0.9, 1.7]))
        return self.pose + error * wander

    def go(self, goal, limit=60.0):
        """Drive to a goal; returns its outcome."""
        self.navigator.go(self.now, goal)
        end = self.now + limit
        while self.navigator.active and self.now < end:
            self.tick()
        return self.navigator.outcome

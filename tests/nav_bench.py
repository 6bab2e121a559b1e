"""Bench of navigation without a plant: wheel loops as drawn, lidar and depth by plain geometry.

It takes the faults of a layout: obstacles of all kinds, late ones, carts. Racks are closed to the
lidar here, and nobody is ever lost; the plant is for that.
"""

import numpy as np
from flat_world import cast, scan

from twin.floor_plan import FOOTPRINT, machines
from twin.geometry import compose2, rectangle, rectangles_overlap, rot2
from twin.layout import Faults, load_layout
from twin.messages import LidarScan, RgbdFrame
from twin.plant.mover import MoverWay
from twin.plant.obstacles import MOVER_OUTLINE, OUTLINE
from twin.stack.config import DriveLimits, nominal_config
from twin.stack.estimation.depth_to_scan import DepthScan
from twin.stack.estimation.odometry import exp2
from twin.stack.estimation.site_map import floor_map
from twin.stack.planning.navigator import Navigator

DT = 0.01
LIMITS = DriveLimits()
LAYOUT = load_layout()
CONFIG = nominal_config(LAYOUT.site, LAYOUT.options)
UNDER = 0.90  # m from the camera within which a low box lies under its picture
NO_BOX = np.zeros((0, 2, 2))


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


def sides(box):
    """Four walls of a rectangle given by its corners. Shape (4, 2, 2)."""
    return np.array([[box[i - 1], box[i]] for i in range(4)])


def walls():
    """Everything of the drawing as segments in world. Shape (n, 2, 2)."""
    (x0, x1), (y0, y1) = LAYOUT.site.hall.x, LAYOUT.site.hall.y
    boxes = [box for each in machines(LAYOUT.site).values() for box in each]
    boxes.append(rectangle((x0 + x1) / 2, (y0 + y1) / 2, 0.0, x1 - x0, y1 - y0))
    return np.concatenate([sides(box) for box in boxes])


class Cart:
    """To and fro along a path by the plant's rule, as if its servos had no lag."""

    def __init__(self, mover):
        self.way = MoverWay(mover)

    def box(self):
        return rectangle(*self.way.here()[0], self.way.yaw, *MOVER_OUTLINE)

    def step(self, now, pose):
        self.way.choose_speed(now, pose, DT)
        self.way.advance(DT)


class NavBench:
    """One vehicle that drives by what it sees.

    Args:
        start: x, y, yaw in world.
        seed: of the noise of scans.
        faults: what stands and goes in the way.
        noise: m, of the localised pose that the navigator is told.
    """

    def __init__(self, start, seed=0, faults=None, noise=0.003):
        self.pose, self.now = np.array(start, dtype=float), 0.0
        self.navigator = Navigator(CONFIG, floor_map(LAYOUT.site))
        self.loops, self.rng = WheelLoops(), np.random.default_rng(seed)
        self.noise, self.walls = noise, walls()
        faults = faults or Faults()
        self.waiting = list(faults.obstacles)
        self.obstacles = []
        self.carts = [Cart(m) for m in faults.movers]
        self._drawn = [box for each in machines(LAYOUT.site).values() for box in each]
        self._touching = set()
        self.rows, self.events, self.collisions = [], [], []
        self._pending, self._tick = [], 0
        self._convert = self.navigator.surroundings.layer._convert
        self._convert.convert = lambda frame: frame.depth_mm  # the bench sends scans instead
        self.navigator.surroundings.layer._solid.find = lambda frame: self._tops
        self._tops = np.zeros((0, 2))

    def tick(self):
        self._appear()
        if self._tick % 10 == 0:
            self._pending.append((self.now + 0.03, self._lidar(), self.believed()))
            self._pending.append((self.now + 0.05, self._depth(), self.believed()))
        for due in [p for p in self._pending if p[0] <= self.now + 1e-9]:
            self._pending.remove(due)
            self.navigator.hear(*due[1:])
        command = self.navigator.step(self.now, self.believed(), self.loops.velocity)
        self.pose = compose2(self.pose, exp2(self.loops.step(command.as_array()) * DT))
        for cart in self.carts:
            cart.step(self.now, self.pose)
        self.rows.append([self.now, *self.pose, *self.loops.velocity])
        self.events += [(round(self.now, 2), e) for e in self.navigator.events]
        self.navigator.events.clear()
        self._count()
        self._tick += 1
        self.now = self._tick * DT

    def _appear(self):
        for o in list(self.waiting):
            away = np.hypot(*(self.pose[:2] - o.pose[:2]))
            if self.now >= o.appears and (not o.near or away <= o.near):
                grown = 2 * (0.3 + float(self.loops.velocity[0] ** 2) / 1.6)
                body = rectangle(*self.pose, FOOTPRINT[0] + grown, FOOTPRINT[1] + grown)
                box = rectangle(*o.pose, *OUTLINE[o.kind])
                if not (o.near and rectangles_overlap(body, box)):
                    self.waiting.remove(o)
                    self.obstacles.append((o.kind, box))
                    self.events.append((round(self.now, 2), f"* {o.kind} at {o.pose}"))

    def _lidar(self):
        seen = [self.walls]
        seen += [sides(b) for k, b in self.obstacles if k in ("carton", "pillar")]
        seen += [sides(cart.box()) for cart in self.carts]
        sensor = compose2(self.pose, (0.300, 0.0, 0.0))
        return scan(np.concatenate(seen), sensor, self.rng, self.now)

    def _depth(self):
        c = self._convert
        sensor = compose2(self.pose, c.sensor_pose)
        angles = c._start + (0.5 + np.arange(c.beams)) * c.increment
        high = [self.walls] + [sides(b) for k, b in self.obstacles if k != "low_box"]
        high += [sides(cart.box()) for cart in self.carts]
        low = [NO_BOX] + [sides(b) for k, b in self.obstacles if k == "low_box"]
        ranges = cast(np.concatenate(high), sensor, angles)
        under = cast(np.concatenate(low), sensor, angles) if len(low) > 1 else ranges + 1
        ranges = np.where((under < ranges) & (under > UNDER), under, ranges)
        ranges = ranges + 0.003 * ranges**2 * self.rng.standard_normal(len(ranges))
        clear = np.minimum(ranges, 3.0)
        self._tops = self._low_tops(angles, ranges)
        found = LidarScan(self.now, angles[0], c.increment, np.where(ranges < 3, ranges, np.inf), 3)
        frame = DepthScan(found, clear, c.sensor_pose)
        return RgbdFrame(self.now, np.zeros((1, 1, 3), np.uint8), frame)

    def _low_tops(self, angles, ranges):
        """Points of low boxes' tops in base that the camera sees."""
        tops = [np.zeros((0, 2))]
        grid = np.stack(np.meshgrid(*[np.linspace(0, 1, 11)] * 2), -1).reshape(-1, 2)
        for kind, box in self.obstacles:
            if kind == "low_box":
                a, b, _, d = np.array(box)
                p = a + grid[:, :1] * (b - a) + grid[:, 1:] * (d - a)
                p = (p - self.pose[:2]) @ rot2(self.pose[2])
                far, at = np.hypot(p[:, 0] - 0.335, p[:, 1]), np.arctan2(p[:, 1], p[:, 0] - 0.335)
                i = np.rint((at - angles[0]) / (angles[1] - angles[0])).astype(int)
                seen = (far > UNDER) & (far < 2.3) & (np.abs(at) < 0.77)
                i = i.clip(0, len(angles) - 1)
                tops.append(p[seen & (far < ranges[i] + 0.5)])
        return np.concatenate(tops)

    def _count(self):
        body = rectangle(*self.pose, *FOOTPRINT)
        things = {f"{k} {i}": b for i, (k, b) in enumerate(self.obstacles)}
        things |= {f"cart {i}": cart.box() for i, cart in enumerate(self.carts)}
        things |= {f"drawn {i}": b for i, b in enumerate(self._drawn)}
        touching = {name for name, b in things.items() if rectangles_overlap(body, b)}
        for name in sorted(touching - self._touching):
            self.collisions.append((round(self.now, 2), name, np.round(self.pose, 2).tolist()))
        self._touching = touching

    def believed(self):
        error = self.noise * np.array([1.0, 1.0, 0.3])
        wander = np.sin(self.now * np.array([1.3, 0.9, 1.7]))
        return self.pose + error * wander

    def go(self, goal, limit=90.0):
        """Drive to a goal; returns its outcome."""
        self.navigator.go(self.now, goal)
        end = self.now + limit
        while self.navigator.active and self.now < end:
            self.tick()
        return self.navigator.outcome

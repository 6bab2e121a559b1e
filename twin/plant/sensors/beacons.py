"""Photoelectric network: what the clocks of T0 and of each node count as light passes them.

Liu et al. 2022, Figs. 2 and 3. The head turns, and two planes of light with it; a node stamps the
instant at which each plane passes, T0 that at which plane 1 does, and all of them the pulses of the
synchronising lamp. Between two physics steps (2 ms, a fifteenth of a turn) the vehicle's motion is
interpolated, and each crossing is sought at its own instant. Sources of the numbers:
models/beacon/README.md.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from twin.geometry import Array
from twin.layout import BeaconHardware, Layout
from twin.messages import BeaconStamps
from twin.plant.as_built import AsBuilt
from twin.plant.beacon_trouble import BeaconTrouble, Image
from twin.plant.beacons import T_BASE_HEAD
from twin.plant.sensors.beacon_clock import NodeClock, Spin, SyncLamp
from twin.plant.sensors.mount import Mount
from twin.site import BeaconNetwork

SYNC, PLANE_1, PLANE_2 = 0, 1, 2
PHI = np.array([np.pi / 4, np.pi / 4, np.pi / 2])  # rad, as drawn: phi_1, phi_2, phi_r
FAN = math.tan(math.radians(40.0))  # elevation over and under the head that the planes reach
VIEW = np.cos(np.radians(60.0))  # of the angle between a diode's axis and the light
NEAR, FAR = 0.5, 10.0  # m
MARGIN = 6e-3  # s before and after a turn that a batch reaches: six pulses at 50 turns a second
HOUSING = 0.03  # m before a diode at which a ray may end: on its own housing
TRIGGER = 20e-6  # s, 1 sigma, of the vehicle's own stamp of the turn's end; guess
GROUPS = np.array([1, 1, 1, 0, 1, 0], dtype=np.uint8)  # all that is solid; 3 is collision only
TURN = 2 * np.pi


@dataclass(frozen=True)
class Ailing:
    """What went wrong in a turn of the head, by names of nodes: known to the plant alone.

    Attributes:
        dark: to which no direct light came, by a fault of the layout.
        false: that stamped a reflected crossing.
    """

    dark: frozenset[str]
    false: frozenset[str]


class BeaconSensor:
    """Head at `head/origin`, nodes at `beacons/<name>/diode`. Asked at every physics step.

    Args:
        model: the compiled cell.
        rng: this network's own noise.
        network: its drawing.
        hardware: how steady it is.
        planes: rad by which phi_1, phi_2, phi_r are off the drawing. Shape (3,).
        mount: `T_base_head` as built. Shape (4, 4).
        trouble: what is blocked and what reflects.
        noise_scale: factor on all noise.
    """

    period = 0.002
    latency = 0.010

    def __init__(
        self,
        model: mujoco.MjModel,
        rng: np.random.Generator,
        network: BeaconNetwork,
        hardware: BeaconHardware,
        planes: Array,
        mount: Array,
        trouble: BeaconTrouble,
        noise_scale: float = 1.0,
    ):
        self._rng, spin_rng, *clocks = rng.spawn(3 + len(network.nodes))
        k = noise_scale
        self._crossing, self._sync = k * hardware.crossing_noise, k * hardware.sync_noise
        self._missed, self._trigger = hardware.missed, k * TRIGGER
        self.names = tuple(node.name for node in network.nodes)
        self._sites = [model.site(f"beacons/{name}/diode").id for name in self.names]
        facing = np.array([node.facing for node in network.nodes])
        self._facing = np.stack([np.cos(facing), np.sin(facing), 0 * facing], axis=1)
        self.spin = Spin(spin_rng, network.spin_rate, k * hardware.spin_jitter)
        self._clocks = [NodeClock(r, hardware.clock_drift) for r in clocks]
        self._lamp = SyncLamp(self._rng)
        phi = PHI + planes
        self._tilt = np.array([phi[0], -phi[1]])
        self._lead = np.array([0.0, phi[2]])
        self._mount = Mount(model, "agv/imu")
        self._mount.T_base_sensor = mount
        self._head = model.body("head/head").id
        self.trouble = trouble
        self._before: tuple[float, Array] | None = None
        self._turns = 0  # whole turns so far
        self._passes: list[float] = []  # true times at which plane 1 passed T0
        self._events: list[tuple[float, int, int, float]] = []  # time, channel, kind, as stamped
        self._false: set[str] = set()  # nodes that stamped a reflection in this turn
        self.ailing = Ailing(frozenset(), frozenset())  # in the turn of the last message

    def sample(self, stamp: float, model, data) -> BeaconStamps | None:
        """Take in what happened since the last step; a batch once a turn is over."""
        now = stamp, self._mount.pose(data)
        if self._before is not None:
            self._advance(self._before, now, model, data)
        self._before = now
        if len(self._passes) < 2 or stamp < self._passes[1] + MARGIN:
            return None
        start, end = self._passes[0], self._passes.pop(1)
        self._passes[0] = end
        batch = [e for e in self._events if start - MARGIN <= e[0] <= end + MARGIN]
        self._events = [e for e in self._events if e[0] >= end - MARGIN]
        return self._message(end, batch)

    # --- one physics step ------------------------------------------------------------------------

    def _advance(self, before, now, model, data) -> None:
        t0, t1 = before[0], now[0]
        for pulse in self._lamp.between(t0, t1):
            for channel in range(len(self._clocks)):
                self._note(pulse, channel, SYNC, self._sync)
        places = data.site_xpos[self._sites]
        if self.spin.turns(t1) < self._turns + 1:
            self._sweep(before, now, (t0, t1), places, model, data)
            return
        passed = _root(lambda t: self.spin.turns(t) - self._turns - 1, t0, t1)
        self._sweep(before, now, (t0, passed), places, model, data)
        self._turns += 1
        self._passes.append(passed)
        self._note(passed, 0, PLANE_1, self._crossing)
        self.ailing, self._false = Ailing(self.trouble.dark, frozenset(self._false)), set()
        self.trouble.begin(self._turns)
        self._sweep(before, now, (passed, t1), places, model, data)

    def _sweep(self, before, now, span: tuple[float, float], places: Array, model, data) -> None:
        """Crossings within a part of a step that lies in one turn; places: of the nodes, (n, 3)."""
        (t0, T0), (t1, T1) = before, now
        images = self.trouble.images(places)
        nodes = np.array([image.place for image in images]).reshape(-1, 3)
        ends = [(nodes - T[:3, 3]) @ T[:3, :3] for T in (T0, T1)]
        sides = self._sides(ends[0], t0), self._sides(ends[1], t1)
        for i, plane in np.argwhere(sides[0] * sides[1] < 0).tolist():
            p0, p1, image = ends[0][i].tolist(), ends[1][i].tolist(), images[i]
            time = self._crossing_time(plane, p0, p1, t0, t1)
            if time is None or not span[0] < time <= span[1]:
                continue
            if not self._seen(image, T1, model, data):
                continue
            stamped = self._note(time, image.node + 1, PLANE_1 + plane, self._crossing)
            if stamped and not image.direct:
                self._false.add(self.names[image.node])

    def _sides(self, p_head: Array, t: float) -> Array:
        """How far points stand over each plane. Shape (n, 2), m."""
        angle = TURN * self.spin.turns(t) + self._lead
        across = np.outer(p_head[:, 1], np.cos(angle)) - np.outer(p_head[:, 0], np.sin(angle))
        return np.cos(self._tilt) * p_head[:, 2:] - np.sin(self._tilt) * across

    def _crossing_time(self, plane: int, p0, p1, t0: float, t1: float) -> float | None:
        """When a plane meets a point that goes from p0 to p1 in the head's frame without the spin.

        Between two steps it goes straight and evenly: at 1 rad/s and 4 m that is right to 2 um.
        None if the light does not reach there.
        """
        lead, c, s = self._lead[plane], math.cos(self._tilt[plane]), math.sin(self._tilt[plane])

        def at(t: float) -> tuple[float, float, float]:
            """Along the fan, across it and up."""
            k, angle = (t - t0) / (t1 - t0), TURN * self.spin.turns(t) + lead
            x, y = p0[0] + k * (p1[0] - p0[0]), p0[1] + k * (p1[1] - p0[1])
            ca, sa = math.cos(angle), math.sin(angle)
            return ca * x + sa * y, ca * y - sa * x, p0[2] + k * (p1[2] - p0[2])

        def side(t: float) -> float:
            _, across, up = at(t)
            return c * up - s * across

        time = _root(side, t0, t1)
        along, across, up = at(time)  # behind the fan there is no light
        return time if along > 0 and abs(up) < FAN * math.hypot(along, across) else None

    def _seen(self, image: Image, T_world_head: Array, model, data) -> bool:
        """Whether light from the head reaches a diode: near enough, before it, nothing between.

        Of a reflection, the way to the image counts, up to where the mirror may stand.
        """
        origin = T_world_head[:3, 3]
        way = image.place - origin
        distance = float(np.linalg.norm(way))
        if not (NEAR <= distance <= FAR and -way @ self._facing[image.node] >= VIEW * distance):
            return False
        hit = np.array([-1], dtype=np.int32)
        ray = way / distance
        free = mujoco.mj_ray(model, data, origin, ray, GROUPS, 1, self._head, hit)
        return bool(hit[0] < 0 or free >= distance - HOUSING - image.mirror)

    # --- stamps ----------------------------------------------------------------------------------

    def _note(self, time: float, channel: int, kind: int, sigma: float) -> bool:
        """Whether the channel did not miss it."""
        if self._rng.random() < self._missed:
            return False
        self._events.append((time, channel, kind, time + self._noise(sigma)))
        return True

    def _noise(self, sigma: float) -> float:
        return sigma * float(self._rng.standard_normal())

    def _message(self, end: float, batch) -> BeaconStamps:
        batch = sorted(batch, key=lambda e: (e[1], e[3]))
        channel = np.array([e[1] for e in batch], dtype=np.int64)
        kind = np.array([e[2] for e in batch], dtype=np.int64)
        ticks = np.array([self._clocks[e[1]].ticks(e[3]) for e in batch], dtype=np.int64)
        stamp = end + self._noise(self._trigger)
        return BeaconStamps(stamp, self.names, channel, kind, ticks)


def fitted_network(
    model: mujoco.MjModel,
    layout: Layout,
    as_built: AsBuilt,
    rng: np.random.Generator,
    lot: np.random.Generator,
) -> tuple[BeaconSensor, ...]:
    """The network of a layout: one sensor, or none if it is not fitted.

    Args:
        model: the compiled cell.
        layout: gives drawing, hardware and faults.
        as_built: gives head and mount.
        rng: of its noise.
        lot: of the faults that the layout leaves open.
    """
    world, network = layout.world, layout.site.beacons
    if network is None or not world.beacons.fitted:
        return ()
    trouble = BeaconTrouble(world.faults.beacons, tuple(n.name for n in network.nodes), lot)
    mount, scale = T_BASE_HEAD @ as_built.beacon_mount, world.sensors.noise_scale
    planes = as_built.beacon_planes
    return (BeaconSensor(model, rng, network, world.beacons, planes, mount, trouble, scale),)


def _root(f: Callable[[float], float], low: float, high: float) -> float:
    """Where a smooth function that changes its sign between low and high is zero (Illinois)."""
    a, b, fa, fb = low, high, f(low), f(high)
    for _ in range(30):
        t = (a * fb - b * fa) / (fb - fa)
        if abs(t - b) < 1e-12:
            return t
        ft = f(t)
        if (ft < 0) == (fb < 0):
            fa *= 0.5
        else:
            a, fa = b, fb
        b, fb = t, ft
        if ft == 0.0:
            break
    return b

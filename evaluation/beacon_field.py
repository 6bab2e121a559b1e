"""The field before the truss of the photoelectric network: set-up and calibration for scenarios.

The vehicle starts in a dock that faces the truss; what it must know of its head it measures in a
calibration drive first, unless the layout's options name the file of an earlier one.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from evaluation.run import RunRequest
from evaluation.simulation import Simulation
from twin.geometry import pose2_to_transform, wrap_angle
from twin.layout import Layout, LayoutError
from twin.messages import BeaconOrder
from twin.plant.beacons import T_BASE_HEAD
from twin.plant.sensors.beacons import FAN, FAR, NEAR, VIEW
from twin.site import BeaconNetwork, Pose2
from twin.stack.estimation.beacon_calibration import (
    load_beacon_calibration,
    save_beacon_calibration,
)

DOCK = (2.5, 2.6, float(np.pi))  # x, y, yaw: the truss is 3.1 m ahead of the head
LEAST_SEEN = 4  # nodes that tell the head's pose
FILE = "beacon_calibration.json"
WEST = float(np.pi)  # yaw that faces the truss
# Where a layout's own dock is kept: m, and rad about facing the truss
FIELD_X, FIELD_Y, FACING = (0.9, 2.5), (1.4, 3.8), 0.5
# Turns on the spot show where on the vehicle the head is, ways its yaw, changes of range and
# bearing the planes' angles.
STOPS = (
    (2.3, 2.6, WEST),
    (2.3, 2.6, WEST + 0.8),
    (2.3, 2.6, WEST + 1.6),
    (1.5, 2.2, WEST + 1.6),
    (1.5, 2.2, WEST + 0.7),
    (1.5, 2.2, WEST - 0.3),
    (1.5, 3.4, WEST + 0.2),
    (1.5, 3.4, WEST + 1.0),
    (0.9, 2.8, WEST + 0.4),
    (0.9, 2.8, WEST - 0.4),
    (2.2, 2.0, WEST - 0.4),
    (2.2, 2.0, WEST + 0.5),
)
DWELL = 1.7  # s at each stop: 50 turns of the head
BROKEN_OFF = "the calibration drive was broken off"
LONGEST = 240.0  # s of simulated time after which a calibration drive is given up


def in_the_field(layout: Layout) -> Layout:
    """The layout with head and truss fitted and used, and the dock before the truss.

    A dock that the layout has there already is kept. Cameras are off: nothing here looks at
    pictures, and they cost most of the time.

    Raises:
        LayoutError: one line, for a layout without a network, whose field is not free, or whose
            nodes are out of sight of the stops.
    """
    world, site, options = layout.world, layout.site, layout.options
    if site.beacons is None:
        raise LayoutError("site.beacons: there is no photoelectric network in this layout")
    if world.beacons.missed >= 1.0:
        raise LayoutError("world.beacons.missed: 1 leaves no light pulse to hear")
    _check_view(site.beacons)
    beacons = world.beacons.model_copy(update={"fitted": True})
    sensors = world.sensors.model_copy(update={"cameras": False})
    world = world.model_copy(update={"beacons": beacons, "sensors": sensors})
    if not _before_the_truss(site.dock):
        site = site.model_copy(update={"dock": DOCK})
    method = "all" if options.beacons == "off" else options.beacons
    options = options.model_copy(update={"beacons": method})
    tree = {"site": site, "world": world, "options": options}
    try:
        return Layout.model_validate({key: value.model_dump() for key, value in tree.items()})
    except ValidationError as error:
        why = error.errors()[0]["msg"].removeprefix("Value error, ")
        raise LayoutError(f"the field before the truss, dock at {site.dock[:2]}: {why}") from None


def _check_view(network: BeaconNetwork) -> None:
    """Most nodes must be in range and view of the head at every stop of the calibration.

    What stands in between is not looked at: whether light passes shows when it is driven.
    """
    p = np.array([node.position for node in network.nodes])
    facing = np.array([node.facing for node in network.nodes])
    axis = np.stack([np.cos(facing), np.sin(facing), 0 * facing], axis=1)
    wanted = max(LEAST_SEEN, len(p) // 2 + 1)
    for stop in STOPS:
        way = p - (pose2_to_transform(stop) @ T_BASE_HEAD)[:3, 3]
        far = np.linalg.norm(way, axis=1)
        seen = (far >= NEAR) & (far <= FAR) & (-np.sum(way * axis, axis=1) >= VIEW * far)
        seen &= (np.abs(way[:, 2]) < FAN * np.hypot(way[:, 0], way[:, 1])) & (p[:, 2] > 0.0)
        if seen.sum() < wanted:
            raise LayoutError(
                f"site.beacons.nodes: {seen.sum()} of {len(p)} in range and view of the head at "
                f"({stop[0]}, {stop[1]}), wanted {wanted}"
            )


def _before_the_truss(pose: Pose2) -> bool:
    x, y, yaw = pose
    turned = abs(float(wrap_angle(yaw - WEST)))
    return FIELD_X[0] <= x <= FIELD_X[1] and FIELD_Y[0] <= y <= FIELD_Y[1] and turned <= FACING


def calibrated_field(request: RunRequest, layout: Layout) -> tuple[RunRequest, Layout] | str:
    """The field with a calibration of this vehicle's head, and what of the run is left to do.

    Without a file in the options the drive is made first, on a day without faults of the network,
    and its file left in the run's folder. Its time counts: a `--duration` that ends within it
    breaks it off. If there is no calibration in the end, one line says why.

    Raises:
        LayoutError: the file that the options name cannot be read.
    """
    layout = in_the_field(layout)
    if layout.options.beacon_calibration is not None:
        try:
            load_beacon_calibration(Path(layout.options.beacon_calibration))
        except ValueError as error:
            raise LayoutError(f"options: {error}") from None
        return request, layout

    def progress(time: float, total: float, text: str) -> None:
        request.progress(time, total, f"calibration: {text}")

    quiet = replace(request, record=False, log=False, viewer=False, progress=progress)
    bare = without_network(layout)
    faults = bare.world.faults.model_copy(update={"beacons": type(bare.world.faults.beacons)()})
    bare = bare.model_copy(update={"world": bare.world.model_copy(update={"faults": faults})})
    with Simulation(quiet, bare, BeaconOrder(0.0, STOPS, DWELL)) as sim:
        if not sim.run(LONGEST, lambda tick: sim.stack.done) or sim.stack.head is None:
            return BROKEN_OFF
        path = request.out / FILE
        try:
            save_beacon_calibration(sim.stack.head.solve(), path)
        except ValueError as error:
            return f"the calibration drive found nothing: {error}"
        spent = sim.plant.time
    left = None if request.duration is None else request.duration - spent
    if left is not None and left <= 0.0:
        return BROKEN_OFF
    options = layout.options.model_copy(update={"beacon_calibration": str(path)})
    return replace(request, duration=left), layout.model_copy(update={"options": options})


def without_network(layout: Layout) -> Layout:
    """The layout with the network heard, but not used for the pose."""
    options = layout.options.model_copy(update={"beacons": "off"})
    return layout.model_copy(update={"options": options})

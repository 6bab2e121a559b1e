"""The scanning head calibrates itself: its planes and where it sits on the vehicle.

Liu et al. 2022, section 2.2: bundle adjustment over stops. The vehicle drives from stop to stop
and listens to 200 turns of the head at each. All of them make the calibration that is kept, in
`beacon_calibration.json`; besides, one turn of each stop and a survey drawn anew make one of 200
calibrations, whose errors are held against their Cramer-Rao bound. Metrics are from plant truth.
"""

from dataclasses import replace

import numpy as np

from evaluation.beacon_field import FILE, STOPS, in_the_field, without_network
from evaluation.beacons import (
    BeaconMonitor,
    errors6,
    rms,
    true_mount,
    true_planes,
    true_setting,
)
from evaluation.run import Criterion, RunRequest, RunResult
from evaluation.simulation import Simulation
from twin.layout import Layout
from twin.messages import BeaconOrder
from twin.plant.beacons import survey_error
from twin.stack.estimation.beacon_calibration import save_beacon_calibration
from twin.stack.estimation.beacons.bound import calibration_bound
from twin.stack.estimation.beacons.calibration import calibrate
from twin.stack.estimation.beacons.rigid import euler_xyz

CALIBRATIONS = 200
DWELL = 7.0  # s at each stop
LONGEST = 400.0  # s of simulated time after which the run is given up
NAMES = ("phi_1", "phi_2", "phi_r")

CRITERIA = [
    Criterion("angles_over_bound", "<=", 1.2),
    *[Criterion(f"{name}_over_bound", "<=", 1.2) for name in NAMES],
    Criterion("calibrations", "==", float(CALIBRATIONS)),
    Criterion("collisions", "==", 0.0),
]


def run(request: RunRequest, layout: Layout) -> RunResult:
    """One drive over all stops."""
    layout = without_network(in_the_field(layout))
    watch = BeaconMonitor()
    with Simulation(request, layout, BeaconOrder(0.0, STOPS, DWELL), (watch,)) as sim:
        complete = sim.run(LONGEST, lambda tick: sim.stack.done)
        figures, notes = metrics(sim, request, watch)
        return sim.result(figures, CRITERIA, complete, notes)


def metrics(
    sim: Simulation, request: RunRequest, watch: BeaconMonitor
) -> tuple[dict[str, float], list[str]]:
    """All figures; the calibration goes into the run's folder."""
    figures = {"collisions": float(len(sim.plant.world.collisions))}
    head = sim.stack.head
    if head is None or len(head.stops) < len(STOPS):
        return figures, ["the stops were not all reached"]
    try:
        found = head.solve()
    except ValueError as error:
        return figures, [str(error)]
    save_beacon_calibration(found, request.out / FILE)
    planes = np.array(found.planes) - true_planes(sim.plant).as_array()
    T, true = found.applied(sim.config).beacons.T_base_head, true_mount(sim.plant)
    mount, turned = errors6(T, true), euler_xyz(true[:3, :3].T @ T[:3, :3])
    ratios, notes = against_bound(sim, watch, np.random.default_rng([request.seed, 4]))
    figures = {
        "angles_over_bound": rms(ratios),
        **{f"{n}_over_bound": rms(r) for n, r in zip(NAMES, ratios.T, strict=True)},
        "calibrations": float(len(ratios)),
        **{f"{n}_error_urad": 1e6 * float(e) for n, e in zip(NAMES, planes, strict=True)},
        "mount_error_mm": 1e3 * float(np.linalg.norm(mount[:3])),
        "mount_error_plane_mm": 1e3 * float(np.hypot(*mount[:2])),
        "mount_error_mrad": 1e3 * float(np.linalg.norm(mount[3:])),
        **{f"mount_error_r{a}_mrad": 1e3 * float(e) for a, e in zip("xyz", turned, strict=True)},
        "turns": float(found.turns),
        **figures,
    }
    return figures, notes


def against_bound(sim: Simulation, watch: BeaconMonitor, rng: np.random.Generator):
    """Errors of many calibrations in units of their bound, (k, 3), and notes of those that failed.

    Each has one turn at each stop that heard all nodes, and a survey of its own.
    """
    head, network = sim.stack.head, sim.plant.layout.site.beacons
    assert head is not None and network is not None
    setting, start = true_setting(sim.plant), sim.config.beacons.planes
    sizes = 2 * len(network.nodes)
    stops = [[turn for turn in stop if len(turn.theta) == sizes] for stop in head.stops]
    heads = [watch.truth_at(t) @ true_mount(sim.plant) for t in head.times]
    bound = np.sqrt(np.diag(calibration_bound(heads, setting)))
    ratios, notes = [], []
    for k in range(min(CALIBRATIONS, *map(len, stops))):
        error = survey_error(network, rng, sim.plant.layout.world.tolerances.scale)
        survey = replace(setting.survey, p_world=setting.survey.p_world + error)
        try:
            found = calibrate([stop[k] for stop in stops], survey, start)
        except ValueError as fault:
            notes.append(f"calibration {k}: {fault}")
            continue
        ratios.append((found.head.as_array() - true_planes(sim.plant).as_array()) / bound)
    return np.array(ratios).reshape(-1, 3), notes

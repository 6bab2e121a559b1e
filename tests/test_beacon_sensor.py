"""Photoelectric network of the plant: crossings, clocks, line of sight, faults, as built."""

import mujoco
import numpy as np
import pytest

from twin.geometry import rot_z, rotation_from_quat, transform
from twin.layout import BeaconFaults, BeaconHardware, Reflection, load_layout
from twin.plant.beacon_trouble import BeaconTrouble
from twin.plant.beacons import T_BASE_HEAD, node_positions, survey_error
from twin.plant.sensors import beacon_clock, beacons
from twin.plant.sensors.beacon_clock import NodeClock, Spin, SyncLamp
from twin.plant.sensors.beacons import PHI, BeaconSensor
from twin.stack.config import BeaconHead
from twin.stack.estimation.beacons.angles import angles_of
from twin.stack.estimation.beacons.fix import Fix, Locator
from twin.stack.estimation.beacons.stamps import HeadParameters, NodeSurvey, StampBatch

NETWORK = load_layout().site.beacons
assert NETWORK is not None
NAMES = tuple(node.name for node in NETWORK.nodes)
NODES = np.array([node.position for node in NETWORK.nodes])
QUIET = BeaconHardware(crossing_noise=0.0, sync_noise=0.0, spin_jitter=0.0, missed=0.0)
PLANES = np.array([0.004, -0.003, 0.005])
START = transform(rot_z(np.pi - 0.1), (2.3, 2.6, 0.0))
STEP = 0.002


def scene(extra: str = "") -> mujoco.MjModel:
    """A free body that carries the head, and the nodes of the default cell."""
    nodes = "".join(
        f'<body name="{n}" pos="{x} {y} {z}"><site name="beacons/{n}/diode"/></body>'
        for n, (x, y, z) in zip(NAMES, NODES, strict=True)
    )
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="{STEP}" gravity="0 0 0"/><worldbody>
        <body name="agv/base"><freejoint/><geom size="0.1" mass="1" group="3"/>
        <site name="agv/imu"/><body name="head/head"><geom size="0.01" mass="0"/></body></body>
        {nodes}{extra}</worldbody></mujoco>"""
    )


def batches(
    seconds=0.2,
    velocity=(0, 0, 0),
    rate=0.0,
    hardware=QUIET,
    faults: BeaconFaults | None = None,
    seed=0,
    extra="",
    scale=1.0,
):
    """Messages of a vehicle that moves evenly, with the true pose of its base at each step."""
    model = scene(extra)
    data = mujoco.MjData(model)
    data.qpos[:3] = START[:3, 3]
    angle = (np.pi - 0.1) / 2
    data.qpos[3:7] = np.cos(angle), 0, 0, np.sin(angle)
    data.qvel[:3], data.qvel[5] = velocity, rate
    mujoco.mj_forward(model, data)
    rng, lot = np.random.default_rng(seed).spawn(2)
    trouble = BeaconTrouble(faults or BeaconFaults(), NAMES, lot)
    assert NETWORK is not None
    args = (model, rng, NETWORK, hardware, PLANES, T_BASE_HEAD, trouble, scale)
    sensor = BeaconSensor(*args)
    found, poses = [], []
    for k in range(round(seconds / STEP) + 1):
        if k:
            mujoco.mj_step(model, data)
            mujoco.mj_forward(model, data)
        poses.append(transform(rotation_from_quat(data.qpos[3:7]), data.qpos[:3]))
        message = sensor.sample(data.time, model, data)
        if message is not None:
            found.append(message)
    return found, poses


def place(**kwargs) -> Locator:
    survey = NodeSurvey(NAMES, NODES, np.full(len(NAMES), 30e-6))
    head = HeadParameters(*(PHI + PLANES))
    return Locator(survey, head, T_BASE_HEAD, noise=BeaconHead().noise, **kwargs)


def stamps(message) -> StampBatch:
    return StampBatch(message.nodes, message.channel, message.kind, message.ticks)


def crossings(message, name) -> list[int]:
    """Kinds of the planes' crossings that a node stamped."""
    mine = (message.channel == NAMES.index(name) + 1) & (message.kind > 0)
    return message.kind[mine].tolist()


def test_a_turn_is_what_the_closed_form_says():
    """Expected: angles of all crossings by the stack's formula, to a tick; T0 at both ends."""
    found, _ = batches()
    p_head = (NODES - (START @ T_BASE_HEAD)[:3, 3]) @ (START @ T_BASE_HEAD)[:3, :3]
    expected = angles_of(p_head, HeadParameters(*(PHI + PLANES)))
    for message in found:
        assert message.nodes == NAMES
        assert np.sum((message.channel == 0) & (message.kind == 1)) == 2
        measured = place().crossings(stamps(message))
        assert isinstance(measured, tuple)
        seen = measured[0]
        assert len(seen.theta) == 12
        np.testing.assert_allclose(seen.theta, expected[seen.node, seen.plane], atol=5e-6)


def test_each_crossing_has_its_own_instant():
    """Driving at 0.5 m/s and turning: the fix at the middle of the turn is the true pose then."""
    velocity, rate = np.array([-0.4, 0.3, 0.0]), 0.5
    found, poses = batches(0.3, velocity, rate)
    assert len(found) >= 7
    for message in found[1:]:
        middle = message.stamp - 0.5 / 30.0
        T = poses[int(middle / STEP)]
        twist = np.zeros(6)
        twist[:3], twist[5] = T[:3, :3].T @ velocity, rate
        fix = place().fix(stamps(message), twist)
        assert isinstance(fix, Fix)
        after = T[:3, 3] + velocity * (middle - int(middle / STEP) * STEP)
        assert fix.T_world_base[:3, 3] == pytest.approx(after, abs=3e-4)
        still = place().fix(stamps(message))
        assert not isinstance(still, Fix) or np.abs(still.T_world_base[:3, 3] - after).max() > 2e-3


@pytest.mark.parametrize("seed", range(3))
def test_clocks_of_100_ppm_do_no_harm(seed):
    found, _ = batches(0.12, hardware=QUIET.model_copy(update={"clock_drift": 100e-6}), seed=seed)
    fix = place().fix(stamps(found[-1]))
    assert isinstance(fix, Fix)
    assert fix.T_world_base == pytest.approx(START, abs=2e-4)


def test_noise_is_what_the_hardware_says():
    """Crossing stamps scatter by the noise that was asked for, once clocks are aligned."""
    hardware = BeaconHardware(missed=0.0, spin_jitter=0.0, sync_noise=0.0)
    found, _ = batches(3.0, hardware=hardware)
    theta = []
    for message in found:
        measured = place().crossings(stamps(message))
        assert isinstance(measured, tuple)
        order = np.argsort(2 * measured[0].node + measured[0].plane)
        theta.append(measured[0].theta[order])
    spread = np.std(theta, axis=0) / (2 * np.pi * 30.0)
    # T0's two passes add to it: their noise moves all angles of the turn.
    expected = hardware.crossing_noise * np.sqrt(1.5)
    assert np.sqrt(np.mean(spread**2)) == pytest.approx(expected, rel=0.12)
    quiet, _ = batches(0.1, hardware=hardware, scale=0.0)
    exact, _ = batches(0.1)
    np.testing.assert_array_equal(quiet[0].ticks, exact[0].ticks)


def test_line_of_sight_is_the_real_geometry():
    """A board before T1 hides it; one that misses the line does not."""
    board = '<geom type="box" size="0.01 0.1 0.1" pos="-0.4 {} 0.5"/>'
    hidden, _ = batches(0.1, extra=board.format(1.99))
    clear, _ = batches(0.1, extra=board.format(1.3))
    assert crossings(hidden[0], "T1") == [] and sorted(crossings(hidden[0], "T2")) == [1, 2]
    assert sorted(crossings(clear[0], "T1")) == [1, 2]


@pytest.mark.parametrize(("limit", "value"), [("FAR", 3.0), ("VIEW", 0.999), ("FAN", 0.01)])
def test_range_and_field_of_view_are_limited(limit, value, monkeypatch):
    monkeypatch.setattr(beacons, limit, value)
    found, _ = batches(0.1)
    assert sum(len(crossings(found[0], name)) for name in NAMES) < 12


def test_pulses_are_missed_now_and_then():
    found, _ = batches(2.0, hardware=QUIET.model_copy(update={"missed": 0.2}))
    share = np.mean([len(crossings(m, name)) / 2 for m in found for name in NAMES])
    assert share == pytest.approx(0.8, abs=0.05)


def test_blocked_and_reflecting_nodes():
    shift = (0.0, 0.3, 0.2)
    faults = BeaconFaults(
        blocked=("T1",),
        reflections=(
            Reflection(node="T2", shift=shift),
            Reflection(node="T3", shift=shift, hides=True),
        ),
    )
    found, _ = batches(0.1, faults=faults)
    assert crossings(found[0], "T1") == []
    assert sorted(crossings(found[0], "T2")) == [1, 1, 2, 2]
    assert sorted(crossings(found[0], "T3")) == [1, 2]
    own = found[0].channel == 1
    assert np.all(found[0].kind[own] == 0) and own.any()  # the lamp still reaches it
    fix = place().fix(stamps(found[0]))
    assert isinstance(fix, Fix) and {n for n, _ in fix.rejected} == {"T2", "T3"}


def test_the_lot_moves_the_trouble_about():
    faults = BeaconFaults(blocked=("T1",), shuffle=1)
    trouble = BeaconTrouble(faults, NAMES, np.random.default_rng(0))
    drawn, mirrored, sizes = set(), set(), []
    for turn in range(400):
        trouble.begin(turn)
        first, second = trouble.blocked
        assert first == "T1" and second != "T1"
        drawn.add(second)
        for reflection in trouble.reflections:
            assert reflection.node not in trouble.blocked
            mirrored.add(reflection.node)
            sizes.append(np.linalg.norm(reflection.shift))
    assert drawn == mirrored == set(NAMES) - {"T1"}
    assert len(sizes) == pytest.approx(0.8 * 400, abs=30)
    assert min(sizes) < 0.002 and max(sizes) > 0.3


def test_a_mirror_that_trembles_shows_in_whole_turns():
    """Expected: both false crossings of a turn or none; what was stamped is told for evaluation."""
    faults = BeaconFaults(reflections=(Reflection(node="T2", shift=(0.0, 0.3, 0.2), share=0.5),))
    found, _ = batches(1.5, faults=faults)
    counts = [len(crossings(message, "T2")) for message in found]
    assert set(counts) == {2, 4} and 0.2 < np.mean(np.array(counts) == 4) < 0.8
    model = scene()
    data = mujoco.MjData(model)
    data.qpos[:3], data.qpos[3:7] = START[:3, 3], (np.cos(1.52), 0, 0, np.sin(1.52))
    mujoco.mj_forward(model, data)
    rng, lot = np.random.default_rng(1).spawn(2)
    assert NETWORK is not None
    trouble = BeaconTrouble(BeaconFaults(shuffle=2), NAMES, lot)
    sensor = BeaconSensor(model, rng, NETWORK, QUIET, PLANES, T_BASE_HEAD, trouble)
    turns = 0
    for k in range(500):
        message = sensor.sample(k * STEP, model, data)
        if message is None:
            continue
        turns += 1
        dark, false = sensor.ailing.dark, sensor.ailing.false
        for name in NAMES:
            kinds = crossings(message, name)
            assert len(kinds) == 2 * (name not in dark) + 2 * (name in false)
    assert turns > 20


def test_the_reference_misses_pulses_too():
    found, _ = batches(2.0, hardware=QUIET.model_copy(update={"missed": 0.2}))
    passes = [int(np.sum((m.channel == 0) & (m.kind == 1))) for m in found]
    assert np.mean(passes) == pytest.approx(1.6, abs=0.25)


def test_same_seed_same_bits():
    noisy = BeaconHardware(missed=0.01)
    (a, _), (b, _), (c, _) = (batches(0.2, hardware=noisy, seed=s) for s in (5, 5, 6))
    assert [m.stamp for m in a] == [m.stamp for m in b]
    assert all(np.array_equal(x.ticks, y.ticks) for x, y in zip(a, b, strict=True))
    assert not np.array_equal(a[0].ticks, c[0].ticks)


# --- clocks ---------------------------------------------------------------------------------------


def test_a_counter_wraps():
    clock = NodeClock(np.random.default_rng(0), 50e-6)
    turn = 2**beacon_clock.BITS * beacon_clock.TICK / clock.rate
    assert clock.ticks(1.0 + turn) == pytest.approx(clock.ticks(1.0), abs=1)
    assert max(clock.ticks(t) for t in np.linspace(0, 2 * turn, 50)) < 2**beacon_clock.BITS


def test_spin_turns_evenly_but_for_its_jitter():
    spin = Spin(np.random.default_rng(0), 30.0, 1e-4)
    t = np.arange(3001) * 1e-3
    turns = np.array([spin.turns(x) for x in t])
    speed = np.diff(turns) / 1e-3 / 30.0
    assert np.std(speed) == pytest.approx(1e-4 * np.sqrt(2 / 3), rel=0.2)
    assert np.abs(np.diff(speed)).max() < 2e-5  # no jumps


def test_lamp_leaves_no_pulse_out():
    lamp = SyncLamp(np.random.default_rng(0))
    pieces = [t for k in range(500) for t in lamp.between(k * 0.002, (k + 1) * 0.002)]
    assert pieces == lamp.between(0.0, 1.0) and len(pieces) in (200, 199, 201)


# --- as built -------------------------------------------------------------------------------------


def test_nodes_stand_where_they_were_measured_less_the_trackers_error():
    assert NETWORK is not None
    np.testing.assert_array_equal(node_positions(NETWORK, 7, 0.0), NODES)
    errors = np.array([survey_error(NETWORK, np.random.default_rng(s), 1.0) for s in range(400)])
    sigma = np.array([NETWORK.survey_sigma(node) for node in NETWORK.nodes])
    assert errors.std(axis=(0, 2)) == pytest.approx(sigma, rel=0.1)
    distance = np.linalg.norm(NODES - NETWORK.tracker, axis=1)
    assert sigma == pytest.approx(18e-6 + 3e-6 * distance)


def test_the_drawing_of_the_head_is_what_is_built():
    head = BeaconHead()
    np.testing.assert_allclose(head.T_base_head, T_BASE_HEAD)
    np.testing.assert_allclose(head.planes.as_array(), PHI)
    assert (head.counter.tick, head.counter.bits) == (beacon_clock.TICK, beacon_clock.BITS)
    sequence = head.sequence
    assert (sequence.period, sequence.step) == (beacon_clock.PERIOD, beacon_clock.STEP)
    assert sequence.code == beacon_clock.CODE
    hardware = BeaconHardware()
    assert head.noise.crossing == hardware.crossing_noise
    assert (head.noise.sync, head.noise.spin_jitter) == (hardware.sync_noise, hardware.spin_jitter)


def test_mirrored_light_goes_no_way_that_light_cannot():
    """Expected: a board before the image takes it away, as do range and field of view."""
    faults = BeaconFaults(reflections=(Reflection(node="T1", shift=(0.0, 0.3, 0.0), hides=True),))
    board = '<geom type="box" size="0.01 0.1 0.1" pos="0.3 {} 0.6"/>'
    assert NAMES[0] == "T1"
    clear, _ = batches(0.1, faults=faults, extra=board.format(1.0))
    assert sorted(crossings(clear[0], "T1")) == [1, 2]
    head, image = (START @ T_BASE_HEAD)[:3, 3], NODES[0] + (0.0, 0.3, 0.0)
    at = head + (image - head) * (0.3 - head[0]) / (image[0] - head[0])
    assert abs(at[2] - 0.6) < 0.1
    hidden, _ = batches(0.1, faults=faults, extra=board.format(at[1]))
    assert crossings(hidden[0], "T1") == []
    for shift in ((-9.0, 0.0, 0.0), (2.9, 0.0, 0.5)):  # beyond the range; beside the diode's view
        away = BeaconFaults(reflections=(Reflection(node="T1", shift=shift, hides=True),))
        assert crossings(batches(0.1, faults=away)[0][0], "T1") == []


@pytest.mark.parametrize("rate", [20.0, 50.0])
def test_the_network_works_from_20_to_50_turns_a_second(rate, monkeypatch):
    """Expected: a fix of nearly every turn, whenever the pulses of the light come."""
    assert NETWORK is not None
    monkeypatch.setitem(globals(), "NETWORK", NETWORK.model_copy(update={"spin_rate": rate}))
    fixes = []
    for seed in range(4):
        found, _ = batches(1.0, hardware=BeaconHardware(), seed=seed)
        turns = [place(spin_rate=rate).fix(stamps(message)) for message in found]
        fixes += [isinstance(fix, Fix) for fix in turns]
    assert len(fixes) > 3.5 * rate and np.mean(fixes) > 0.95

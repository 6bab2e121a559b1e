"""The feeder: spacing, rate, honesty of its writes, determinism."""

import numpy as np
import pytest

from twin.geometry import rot2
from twin.layout import load_layout
from twin.plant.as_built import AsBuilt
from twin.plant.factory import SPARE
from twin.plant.feeder import Feeder, class_of
from twin.plant.world import World


def run(duration: float, *overrides: str, pool: int = 6, seed: int = 1):
    layout = load_layout(overrides=overrides)
    rng = np.random.default_rng(seed)
    world = World(layout, AsBuilt.draw(rng, layout.world.tolerances), pool=pool)
    feeder = Feeder(world, layout, rng)
    writes = []
    place = world.place_part

    def spy(name, *args, **kwargs):
        index = world.part_names.index(name)
        writes.append((world.time, name, world.truth().part_position[index].copy()))
        place(name, *args, **kwargs)

    world.place_part = spy
    while world.time < duration:
        feeder.step()
        world.step()
    return layout, world, feeder, writes


@pytest.fixture(scope="module")
def fed():
    return run(40.0, pool=3)


def test_parts_ride_at_belt_speed_and_keep_their_distance(fed):
    layout, world, _, _ = fed
    line, truth = layout.site.line, world.truth()
    uv = (truth.part_position[:, :2] - line.origin) @ rot2(line.direction)
    on_belt = (truth.part_position[:, 2] > line.height - 0.01) & (uv[:, 0] > 0)
    assert on_belt.sum() >= 5
    along = truth.part_velocity[on_belt, :2] @ rot2(line.direction)
    np.testing.assert_allclose(along[:, 0], layout.world.line.speed, atol=1e-3)
    spacing = np.diff(np.sort(uv[on_belt, 0]))
    assert spacing.min() > layout.world.feeder.min_spacing - 0.002
    assert np.abs(uv[on_belt, 1]).max() < layout.world.feeder.lateral + 0.002


def test_rate_and_variety(fed):
    layout, world, feeder, _ = fed
    parts = [e for e in feeder.log if e.kind == "fed"]
    rate = len(parts) / world.time
    assert rate == pytest.approx(layout.world.feeder.rate, rel=0.35)
    assert len({e.part_class for e in parts}) == 5


def test_writes_only_parts_in_store_or_bin_and_logs_each(fed):
    layout, _, feeder, writes = fed
    line = layout.site.line
    parts = [e for e in feeder.log if e.kind == "fed"]
    assert [(t, name) for t, name, _ in writes] == [(e.stamp, e.part) for e in parts]
    assert any(e.source == "bin" for e in parts)
    for (_, _, before), event in zip(writes, parts, strict=True):
        if event.source == "store":
            assert before[2] < 0
        else:
            u, _ = rot2(line.direction).T @ (before[:2] - np.array(line.origin))
            assert u > line.length and 0 < before[2] < line.height - 0.05


def test_passed_parts_are_told(fed):
    layout, _, feeder, _ = fed
    assert feeder.passed
    travel = layout.site.line.length / layout.world.line.speed
    first = feeder.passed[0]
    fed_at = next(e.stamp for e in feeder.log if e.kind == "fed" and e.part == first.part)
    assert travel - 2 < first.stamp - fed_at < travel + 2


def test_same_seed_same_log():
    logs = [run(6.0)[2].log for _ in range(2)]
    assert logs[0] == logs[1] and logs[0]


def test_stopped_belt_is_not_fed():
    layout = load_layout()
    rng = np.random.default_rng(1)
    world = World(layout, AsBuilt.draw(rng, layout.world.tolerances), pool=2)
    world.set_belt_speed(0.0)
    feeder = Feeder(world, layout, rng)
    while world.time < 4.0:
        feeder.step()
        world.step()
    assert not feeder.log


def test_slow_belt_limits_the_rate():
    _, _, feeder, _ = run(12.0, "belt_speed=0.05")
    stamps = np.array([e.stamp for e in feeder.log if e.kind == "fed"])
    assert np.diff(stamps).min() >= 0.14 / 0.05 - 0.01


def test_the_store_covers_the_order():
    """Expected result: an order of one class alone finds enough bodies of that class."""
    layout = load_layout(overrides=("order=n_tee_fff:20",))
    world = World(layout, AsBuilt.draw(np.random.default_rng(0), layout.world.tolerances))
    classes = [class_of(name) for name in world.part_names]
    assert classes.count("n_tee_fff") == 20 + SPARE
    assert classes.count("sma_f_n_m") == SPARE

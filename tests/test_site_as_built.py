"""Hall and machines as built: off the drawing within tolerances, by seed; 0 is the drawing."""

import cv2
import mujoco
import numpy as np
import pytest
from floor_bench import FloorBench

from twin.geometry import between2
from twin.layout import load_layout
from twin.plant import factory
from twin.plant.as_built import AsBuilt
from twin.plant.site_as_built import SiteAsBuilt

MACHINES = ("line/", "receiving/", "dock/", "goods_in/")


def stand(seed, *overrides):
    """Places (n, 3) and headings (n,) of outer walls, partitions and machines in world."""
    layout = load_layout(None, overrides)
    built = AsBuilt.draw(np.random.default_rng(seed), layout.world.tolerances)
    model = factory.build(layout, built, pool=1).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    geoms = [g for g in range(model.ngeom) if model.geom(g).name.startswith("wall_")]
    for prefix in MACHINES:
        named = (g for g in range(model.ngeom) if model.geom(g).name.startswith(prefix))
        geoms.append(next(named))
    axes = data.geom_xmat[geoms].reshape(-1, 3, 3)[:, :2, 0]
    return data.geom_xpos[geoms], np.arctan2(axes[:, 1], axes[:, 0])


def test_walls_and_machines_stand_off_the_drawing_within_their_tolerances():
    drawn, heading = stand(0, "world.tolerances.scale=0")
    for seed in range(3):
        built, turned = stand(seed)
        off, turn = np.hypot(*(built - drawn)[:, :2].T), np.abs(turned - heading)
        assert (off > 1e-5).all() and (turn > 1e-7).all()
        # a machine also swings about its own frame
        assert off.max() < 0.010 and turn.max() < 0.005


def test_the_same_hall_by_the_same_seed_and_another_by_another():
    np.testing.assert_array_equal(stand(1)[0], stand(1)[0])
    assert not np.allclose(stand(1)[0], stand(2)[0], atol=1e-4)


def test_nothing_moves_when_a_partition_is_added():
    tolerances = load_layout().world.tolerances
    one = SiteAsBuilt(tolerances, 5)
    np.testing.assert_array_equal(one.wall("west"), SiteAsBuilt(tolerances, 5).wall("west"))
    assert not np.allclose(one.wall("west"), one.wall("partition 0"))


def test_a_machine_is_moved_in_its_own_frame():
    tolerances = load_layout().world.tolerances
    drawn = np.array([3.0, -2.0, 1.2])
    off = between2(drawn, SiteAsBuilt(tolerances, 5).machine("belt", drawn))
    assert 0 < np.abs(off[:2]).max() <= tolerances.machine_xy


@pytest.mark.parametrize("centre", [(3.0, 0.0), (0.0, -3.0)])
def test_principal_point_off_the_middle_moves_the_picture_as_much(centre):
    drawn, built = FloorBench(noise=0.0), FloorBench(noise=0.0, tag_camera_centre=np.array(centre))
    try:
        pose = (*drawn.tags["L0"][:2], 0.0)
        first, second = (bench.shoot(pose).image.astype(float) for bench in (drawn, built))
    finally:
        drawn.close()
        built.close()
    moved, _ = cv2.phaseCorrelate(first, second)
    np.testing.assert_allclose(moved, centre, atol=0.05)

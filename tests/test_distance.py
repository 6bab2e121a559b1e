"""Distance to the pick place from synthetic depth."""

import numpy as np
import pytest

from twin.geometry import apply, compose2, inverse
from twin.layout import load_layout
from twin.messages import RgbdFrame
from twin.plant.as_built import AsBuilt
from twin.plant.sensors.rendering import RenderWorker
from twin.plant.sensors.rgbd import RgbdCamera
from twin.plant.world import World
from twin.stack.config import StackConfig
from twin.stack.estimation.distance import DistanceToPick, hood_at_pick, measure_distance

LAYOUT = load_layout()
CONFIG = StackConfig(site=LAYOUT.site, options=LAYOUT.options)


def draw(boards, noise=0.0, rng=None) -> RgbdFrame:
    """Depth of boards that face the camera: (x, (y0, y1), (z0, z1)) in base; the nearest wins."""
    camera = CONFIG.rgbd
    depth = np.full((camera.height, camera.width), np.inf)
    K, T_camera_base = camera.matrix, inverse(camera.T_base_camera)
    for x, (y0, y1), (z0, z1) in boards:
        corners = apply(T_camera_base, np.array([[x, y0, z0], [x, y1, z1]]))
        px = corners @ K.T
        u, v = np.sort(px[:, 0] / px[:, 2]), np.sort(px[:, 1] / px[:, 2])
        rows = slice(max(round(v[0]), 0), max(round(v[1]), 0))
        cols = slice(max(round(u[0]), 0), max(round(u[1]), 0))
        depth[rows, cols] = np.minimum(depth[rows, cols], corners[0, 2])
    if rng is not None:
        depth = depth * (1 + noise * rng.standard_normal(depth.shape))
    depth_mm = np.where(np.isfinite(depth), depth * 1e3, 0).round().astype(np.uint16)
    return RgbdFrame(0.0, np.zeros((*depth.shape, 3), np.uint8), depth_mm)


def scene(s: float):
    """Hood, belt rail and back wall as seen with S still to go."""
    x = hood_at_pick(CONFIG)[0] + s
    wall = (x + 1.2, (-4, 4), (0, 2.5))
    return [(x, (0.318, 0.582), (0.64, 0.892)), wall]


def test_hood_of_the_default_cell():
    np.testing.assert_allclose(hood_at_pick(CONFIG), [1.05, 0.45], atol=1e-6)


@pytest.mark.parametrize("s", [0.0, 0.1, 0.5, 1.0, 2.0, 2.5])
def test_distance_within_a_centimetre_under_noise(s):
    rng = np.random.default_rng(1)
    assert measure_distance(draw(scene(s), 0.01, rng), CONFIG) == pytest.approx(s, abs=0.012)


def test_an_arm_in_the_band_does_not_shorten_the_distance():
    boards = [*scene(0.6), (0.9, (0.36, 0.40), (0.70, 0.95))]
    assert measure_distance(draw(boards), CONFIG) == pytest.approx(0.6, abs=0.01)


def test_nothing_in_view_is_none():
    assert measure_distance(draw([]), CONFIG) is None


def test_distance_is_carried_on_by_the_driven_way():
    """Expected: a pose estimate that is 3 cm off along the approach is put right by the camera."""
    distance, pick = DistanceToPick(CONFIG), np.array(CONFIG.site.pick)
    believed = compose2(pick, (-1.0, 0.0, 0.0))
    assert distance.distance(believed) == pytest.approx(1.0)
    seen = distance.update(draw(scene(1.03)), believed)
    assert seen == pytest.approx(1.03, abs=0.01) and distance.measured
    later = compose2(pick, (-0.4, 0.0, 0.0))
    assert distance.distance(later) == pytest.approx(0.43, abs=0.01)


def test_pictures_taken_off_the_approach_are_passed_over():
    distance, pick = DistanceToPick(CONFIG), np.array(CONFIG.site.pick)
    frame = draw(scene(1.0))
    for pose in (None, compose2(pick, (-1, 0, 0.3)), compose2(pick, (-1, 0.5, 0)), pick):
        assert distance.update(frame, pose) is None
    assert not distance.measured


@pytest.fixture(scope="module")
def plant_eye():
    """Depth camera of a vehicle as built; the vehicle is put where a test wants it."""
    built = AsBuilt.draw(np.random.default_rng(2), LAYOUT.world.tolerances)
    world = World(LAYOUT, built, pool=1)
    worker = RenderWorker(world.model)
    camera = RgbdCamera(worker, np.random.default_rng(0))

    def look(pose) -> RgbdFrame:
        q = world.model.joint("agv/base").qposadr[0]
        half = pose[2] / 2
        world.data.qpos[q : q + 7] = (*pose[:2], 0, np.cos(half), 0, 0, np.sin(half))
        return camera.sample(0.0, world.model, world.data).result()

    yield look
    worker.close()


@pytest.mark.parametrize("s", [0.0, 0.3, 0.8, 1.5, 2.3])
def test_rendered_depth_gives_the_distance(plant_eye, s):
    """Expected: mount as built and stereo noise included, 1 cm at the goal, 5 cm at 3 m range."""
    pose = compose2(np.array(CONFIG.site.pick), (-s, 0.01, 0.005))
    assert measure_distance(plant_eye(pose), CONFIG) == pytest.approx(s, abs=0.01 + 0.015 * s)

"""The camera that looks down: what a reader makes of its pictures, at rest and at full speed."""

import numpy as np
import pytest
from floor_bench import FloorBench, whole_code_in_view

from twin.geometry import between2, compose2, wrap_angle
from twin.plant.sensors.floor_camera import EXPOSURE, smear
from twin.stack.detection.qr import TagDrawing, TagReader

SPEEDS = [(0.0, 0.0), (0.95, 0.0), (0.6, -0.5)]  # m/s in base


@pytest.fixture(scope="module")
def bench():
    bench = FloorBench()
    yield bench
    bench.close()


@pytest.mark.parametrize("speed", SPEEDS, ids=["at rest", "fast", "sideways"])
def test_reading_is_far_finer_than_placement(bench, speed):
    """Expected: every whole code is read, to 0.1 mm and 0.2 mrad (1 sigma), 0.3 mm at most."""
    reader, rng, errors = TagReader(bench.config.tag_camera), np.random.default_rng(5), []
    while len(errors) < 40:
        name = rng.choice(["M1", "R7", "W4"])
        pose = compose2(bench.tags[name], rng.uniform((-0.1, -0.1, -np.pi), (0.1, 0.1, np.pi)))
        if not whole_code_in_view(pose, bench.tags[name]):
            continue
        fixes = reader.read(bench.shoot(pose, speed))
        assert len(fixes) == 1 and fixes[0].text.tag_id == name, reader.refused
        error = fixes[0].pose_base_tag - between2(pose, bench.tags[name])
        errors.append((*error[:2], wrap_angle(error[2])))
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert (rms < (0.00012, 0.00012, 0.0003)).all()
    assert np.hypot(*np.transpose(errors)[:2]).max() < 0.0003


@pytest.mark.parametrize("phase", [0.0, 0.3, 0.6, 0.9])
def test_a_tag_is_not_missed_in_passing(bench, phase):
    """Expected: at 0.95 m/s, 20 pictures a second, a code is whole in two of them at least."""
    reader, step = TagReader(bench.config.tag_camera), 0.95 * bench.camera.period
    way = np.arange(-0.2 + phase * step, 0.2, step)
    poses = [compose2(bench.tags["P0"], (x, 0.03, 0.0)) for x in way]
    assert sum(len(reader.read(bench.shoot(pose, (0.95, 0.0)))) for pose in poses) >= 2


def test_sigma_covers_what_is_built():
    """Expected: 10 vehicles as built on 10 floors; the normalised error squared is 3 in the mean.

    Between the chi-square's 1 and 99 % quantiles for 3 x 10 degrees of freedom, over 10.
    """
    squares = []
    for seed in range(10):
        bench = FloorBench(exact=False, seed=seed)
        pose = compose2(bench.tags["M2"], (0.02, 0.03, 0.5))
        (fix,) = TagReader(bench.config.tag_camera).read(bench.shoot(pose))
        bench.close()
        off = fix.vehicle_pose(bench.tags["M2"]) - pose
        off[2] = wrap_angle(off[2])
        # in base axes, as the covariance is
        c, s = np.cos(pose[2]), np.sin(pose[2])
        off[:2] = c * off[0] + s * off[1], -s * off[0] + c * off[1]
        squares.append(off @ np.linalg.solve(fix.covariance, off))
    assert 14.95 / 10 < np.mean(squares) < 50.9 / 10
    assert TagDrawing().sigma == (0.0022, 0.0022, 0.0054)


def test_smear_by_hand():
    kernel = smear(np.array([2.0, 0.0]))  # 2 px along u
    assert kernel.sum() == pytest.approx(1.0)
    row = kernel[3]
    assert kernel.sum() == pytest.approx(row.sum()) and row[3] > row[2] > row[1] == row[5] == 0
    np.testing.assert_allclose(row[2], row[4], atol=1e-6)
    np.testing.assert_allclose(smear(np.zeros(2))[3, 3], 1.0)
    assert smear(np.array([1e3, 1e3])).sum() == pytest.approx(1.0)  # beyond its reach


def test_motion_blurs_along_the_way(bench):
    """Expected: edges across the way lose contrast, those along it do not."""
    pose = compose2(bench.tags["P1"], (0.0, 0.0, 0.0))
    still, fast = (bench.shoot(pose, (v, 0.0)).image.astype(float) for v in (0.0, 4.0))
    across = [np.abs(np.diff(i, axis=0)).max(axis=0).mean() for i in (still, fast)]
    along = [np.abs(np.diff(i, axis=1)).max(axis=1).mean() for i in (still, fast)]
    assert across[1] < 0.85 * across[0] and along[1] > 0.93 * along[0]
    assert pytest.approx(0.0005) == EXPOSURE


def test_the_same_seed_gives_the_same_picture():
    pictures = []
    for _ in range(2):
        bench = FloorBench(seed=3)
        pictures.append(bench.shoot(bench.tags["P1"]).image)
        bench.close()
    np.testing.assert_array_equal(*pictures)

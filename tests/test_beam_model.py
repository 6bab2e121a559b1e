"""Likelihood-field beams: a density by hand, tables against plain NumPy, beams left out."""

import numpy as np
import pytest
from localisation_world import MOUNT, drive, scan_at, world_field

from twin.geometry import compose2
from twin.messages import LidarScan
from twin.stack.estimation.beam_model import BeamModel, ScanLikelihood, beam_density
from twin.stack.estimation.likelihood_field import LikelihoodField

MODEL = BeamModel(z_hit=0.7, z_rand=0.2, z_max=0.1, sigma=0.1, finer=1)


def test_density_by_hand():
    # Eq. 22: 0.7 N(0.1; 0, 0.1) + 0.2 / 20, and N(one sigma) = 2.41971.
    assert beam_density(0.1, MODEL, 20.0) == pytest.approx(0.7 * 2.4197072 + 0.01)
    assert beam_density(5.0, MODEL, 20.0) == pytest.approx(0.01)


def test_density_of_the_hit_integrates_to_its_share():
    d = np.linspace(-1, 1, 20_001)
    hit = beam_density(d, MODEL, 20.0) - 0.01
    assert np.sum(hit) * (d[1] - d[0]) == pytest.approx(0.7, abs=1e-4)


@pytest.mark.parametrize(
    "shares", [(0.5, 0.2, 0.1), (1.1, 0.0, -0.1), (0.0, 0.9, 0.1), (0.9, 0.0, 0.1)]
)
def test_shares_must_add_up_to_one(shares):
    with pytest.raises(ValueError, match="add up"):
        BeamModel(*shares)


def two_cells():
    occupied = np.zeros((4, 6), dtype=bool)
    occupied[1, 2] = True
    return LikelihoodField(occupied, (1.0, 2.0), 0.5, 3.0)


def test_scan_by_hand():
    # Base at the middle of cell [1, 1], turned left: beams hit [1, 2] and [3, 1], one is silent.
    likelihood = ScanLikelihood(two_cells(), MODEL, 20.0)
    pose = np.array([[1.75, 2.75, np.pi / 2]])
    p_base = np.array([[0.0, -0.5], [1.0, 0.0]], dtype=np.float32)
    far = np.hypot(0.5, 1.0)
    expected = [beam_density(0.0, MODEL, 20.0), beam_density(far, MODEL, 20.0), 0.1]
    found = likelihood.log_likelihood(pose, p_base, silent=1)[0]
    assert found == pytest.approx(np.mean(np.log(expected)), abs=1e-5)


def test_table_equals_plain_numpy():
    field = world_field()
    rng = np.random.default_rng(0)
    likelihood = ScanLikelihood(field, MODEL, 30.0)
    poses = np.column_stack([rng.uniform(-3, 15, (300, 2)), rng.uniform(-4, 4, 300)])
    p_base = rng.uniform(-6, 6, (60, 2)).astype(np.float32)
    # Half a millimetre about a cell's edge single precision may fall to the other side.
    found = likelihood.log_likelihood(poses, p_base)
    expected = np.empty(300)
    for i, (x, y, yaw) in enumerate(poses):
        R = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        distance = field.lookup(p_base @ R.T + (x, y))
        expected[i] = np.mean(np.log(beam_density(distance, MODEL, 30.0)))
    assert np.quantile(np.abs(found - expected), 0.95) < 1e-4
    assert np.max(np.abs(found - expected)) < 0.2


def test_fit_is_best_where_the_vehicle_is():
    likelihood = ScanLikelihood(world_field(), BeamModel(), 30.0)
    pose = drive()[60]
    p_base, silent = likelihood.choose(scan_at(pose), MOUNT)
    assert silent == 0 and len(p_base) == 100
    shifts = [(0.1, 0, 0), (-0.1, 0, 0), (0, 0.1, 0), (0, -0.1, 0), (0, 0, 0.05), (0, 0, -0.05)]
    poses = np.array([pose, *(compose2(pose, s) for s in shifts)])
    assert np.argmax(likelihood.log_likelihood(poses, p_base, silent)) == 0


def test_broken_and_silent_beams():
    likelihood = ScanLikelihood(two_cells(), MODEL, 20.0)
    ranges = np.array([1.0, np.nan, -1.0, np.inf, 20.0, 2.0])
    p_base, silent = likelihood.choose(LidarScan(0.0, 0.0, 0.1, ranges, 20.0), np.eye(4))
    assert silent == 2
    np.testing.assert_allclose(p_base, [[1, 0], [2 * np.cos(0.5), 2 * np.sin(0.5)]], rtol=1e-6)


def test_far_off_the_map_is_no_crash():
    likelihood = ScanLikelihood(two_cells(), MODEL, 20.0)
    poses = np.array([[1e7, -1e7, 1.0], [-1e7, 1e7, 0.0]])
    found = likelihood.log_likelihood(poses, np.ones((3, 2), np.float32))
    assert found == pytest.approx(float(np.log(beam_density(3.0, MODEL, 20.0))), abs=1e-5)

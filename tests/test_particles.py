"""The comparison of particle counts: both filters on the same scans, and when it looks away."""

from types import SimpleNamespace

import numpy as np
import pytest
from flat_world import scan

from evaluation.particles import ParticleComparison
from twin.geometry import compose2
from twin.layout import load_layout
from twin.stack.config import nominal_config
from twin.stack.estimation.site_map import lidar_map

LAYOUT = load_layout()
CONFIG = nominal_config(LAYOUT.site, LAYOUT.options)
SURFACES = lidar_map(LAYOUT.site, CONFIG.T_base_lidar).surfaces.reshape(-1, 2, 2)
LIDAR = (CONFIG.T_base_lidar[0, 3], 0.0, 0.0)
START = np.array([7.6, 1.55, 0.0])


def drive(comparison, metres, lost=lambda k: False):
    """Along the aisle between two racks, a scan every 5 cm; odometry as good as the truth."""
    rng = np.random.default_rng(0)
    comparison.odometry = lambda stamp: np.array([0.5 * stamp, 0.0, 0.0])
    for k in range(round(metres / 0.05)):
        stamp = 0.1 * k
        way = np.array([0.5 * stamp, 0.0, 0.0])
        pose = compose2(START, way)
        seen = scan(SURFACES, compose2(pose, LIDAR), rng, stamp)
        state = SimpleNamespace(
            lost=lost(k), pose=pose, pose_covariance=np.diag([1e-4, 1e-4, 1e-5]), fused_pose=way
        )
        truth = SimpleNamespace(pose=pose)
        comparison.observe(SimpleNamespace(stamp=stamp, truth=truth, state=state, readings=(seen,)))


def test_few_particles_are_as_exact_as_many():
    comparison = ParticleComparison(CONFIG, lambda: False)
    drive(comparison, 2.0)
    few, many = (len(amcl.particles) for amcl in comparison._filters)
    assert many == 10_000 and few * 5 <= many
    found = comparison.metrics()
    assert 0 < found["ape_kld_rmse_m"] < 0.02 and 0 < found["ape_fixed_rmse_m"] < 0.02
    excess = found["ape_kld_rmse_m"] - 1.1 * found["ape_fixed_rmse_m"]
    assert found["ape_kld_excess_mm"] == pytest.approx(1e3 * excess) and excess < 0.001


def test_a_lost_vehicle_is_no_comparison():
    comparison = ParticleComparison(CONFIG, lambda: False)
    drive(comparison, 0.5, lost=lambda k: True)
    assert np.isnan(comparison.metrics()["ape_kld_rmse_m"])
    away = ParticleComparison(CONFIG, lambda: True)
    drive(away, 0.5)
    assert np.isnan(away.metrics()["ape_kld_excess_mm"])

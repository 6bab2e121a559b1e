"""KLD sampling: count against the closed form and the chi-square, bins, low-variance draws."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from twin.stack.estimation.kld import Kld, bound, count_bins, draw, low_variance


def test_count_by_hand():
    # k = 2, epsilon 0.05, delta 0.01 (z = 2.326348): a = 2/9, 10 (1 - a + sqrt(a) z)^3.
    assert bound(2, 0.05, 0.01) == pytest.approx(10 * (1 - 2 / 9 + np.sqrt(2 / 9) * 2.326348) ** 3)
    assert Kld(least=1).count(2) == 66


@given(st.integers(4, 3000), st.sampled_from([0.01, 0.05, 0.2]), st.sampled_from([0.01, 0.1]))
def test_bound_is_the_chi_square_quantile(bins, epsilon, delta):
    exact = chi2.ppf(1 - delta, bins - 1) / (2 * epsilon)
    assert bound(bins, epsilon, delta) == pytest.approx(exact, rel=0.015)


def test_count_keeps_its_bounds_and_grows():
    kld = Kld(least=100, most=2000)
    counts = [kld.count(k) for k in range(400)]
    assert counts[0] == counts[1] == 100 and counts[-1] == 2000
    assert all(a <= b for a, b in pairwise(counts))


@pytest.mark.parametrize("wrong", [{"epsilon": 0.0}, {"delta": 1.0}, {"least": 9, "most": 8}])
def test_figures_out_of_range_are_refused(wrong):
    with pytest.raises(ValueError, match="out of range"):
        Kld(**wrong)


@settings(deadline=None)  # the first call compiles
@given(st.integers(0, 2**32 - 1), st.integers(1, 500))
def test_bins_are_those_of_a_set(seed, n):
    rng = np.random.default_rng(seed)
    poses = rng.normal(0, 1.0, (n, 3))
    size = (0.2, 0.3, 0.5)
    assert count_bins(poses, size) == len({tuple(b) for b in np.floor(poses / size).astype(int)})


def test_bins_without_yaw():
    poses = np.array([[0.01, 0.01, -3.0], [0.02, 0.03, 2.0], [0.12, 0.03, 1.0]])
    assert count_bins(poses, (0.1, 0.1, 10.0)) == 3  # two signs of yaw
    assert count_bins(np.abs(poses), (0.1, 0.1, np.inf)) == 2


def test_low_variance_by_hand():
    # Thrun et al., Table 4.4: pointers at 0.1, 0.35, 0.6, 0.85 over 0.1, 0.4, 0.5, 1.0.
    drawn = low_variance(np.array([0.1, 0.3, 0.1, 0.5]), 4, 0.4)
    assert drawn.tolist() == [1, 1, 3, 3]


@given(st.lists(st.floats(0, 1), min_size=1, max_size=60), st.integers(1, 300), st.floats(0, 0.999))
def test_each_is_drawn_as_often_as_its_share(weights, count, u):
    weights = np.array(weights) + 1e-3
    drawn = np.bincount(low_variance(weights, count, u), minlength=len(weights))
    share = count * weights / weights.sum()
    assert np.all(np.abs(drawn - share) <= 1 + 1e-6) and drawn.sum() == count


def test_draw_satisfies_its_own_bound():
    rng = np.random.default_rng(0)
    sizes = []
    for spread in (0.01, 0.2, 0.6, 5.0):
        poses = rng.normal(0, spread, (10_000, 3))
        kld = Kld()
        drawn = draw(poses, np.ones(len(poses)), kld, 0.5)
        wanted = kld.count(count_bins(poses[drawn], kld.bin_size))
        assert len(drawn) >= wanted
        sizes.append(len(drawn))
    assert sizes[0] == 500 and sizes[-1] == 10_000 and sizes == sorted(sizes)

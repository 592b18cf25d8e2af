"""Statistics on scores whose answers are known."""

import numpy as np
import pytest

from vd4rl_pomdp.report import stats


def test_iqm_drops_the_outer_quarters():
    assert stats.iqm(np.array([0.0, 1.0, 2.0, 100.0])) == pytest.approx(1.5)
    # five runs: the middle 2.5 are 0.75 of the 2nd, the 3rd, 0.75 of the 4th
    assert stats.iqm(np.array([10.0, 1.0, 2.0, 3.0, -50.0])) == pytest.approx((0.75 * 1 + 2 + 0.75 * 3) / 2.5)
    assert stats.iqm(np.array([-50.0, 1.0, 2.0, 9.0, 10.0])) == pytest.approx((0.75 * 1 + 2 + 0.75 * 9) / 2.5)
    assert stats.iqm(np.array([[1.0], [2.0]])).tolist() == [1.0, 2.0]


def test_other_statistics_on_known_values():
    assert stats.optimality_gap(np.array([50.0, 150.0])) == pytest.approx(25.0)
    assert stats.probability_of_improvement(np.array([1.0, 2.0]), np.array([1.0, 0.0])) == pytest.approx(0.875)
    assert stats.performance_profile(np.array([1.0, 3.0]), np.array([0.0, 2.0, 4.0])).tolist() == [1.0, 0.5, 0.0]


def test_the_bootstrap_covers_a_known_mean_and_keeps_tasks_apart():
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(200):
        low, high = stats.bootstrap_interval([rng.normal(5, 1, 30)], stats.mean, rng, 500)
        hits += low <= 5 <= high
    assert 0.88 <= hits / 200 <= 0.99
    # tasks far apart, no spread within: drawing across tasks would give an interval, drawing within gives none
    low, high = stats.bootstrap_interval([np.full(4, 0.0), np.full(4, 100.0)], stats.mean, rng, 500)
    assert low == high == 50.0
    assert stats.bootstrap_interval([np.array([1.0])], stats.mean, rng) is None


def test_the_bootstrap_of_a_mean_is_as_wide_as_its_standard_error():
    scores = np.arange(100) % 2.0  # a standard deviation of a half
    low, high = stats.bootstrap_interval([scores], stats.mean, np.random.default_rng(0))
    assert (low, high) == pytest.approx((0.5 - 1.96 * 0.05, 0.5 + 1.96 * 0.05), abs=0.006)

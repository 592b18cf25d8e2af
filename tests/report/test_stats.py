"""Statistics, compared with known answers, scipy and rliable."""

import json
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

from vd4rl_pomdp.report import stats

RLIABLE = json.loads((Path(__file__).parent / "rliable.json").read_text())
"""Scores and rliable's statistics of them, written by tools/reference_statistics.py."""
METHODS = {name: [np.array(task) for task in tasks] for name, tasks in RLIABLE["scores"].items()}
AGREES = 0.002
"""Tolerance for bootstrap intervals of scores between 0 and 1."""


mean = stats.aggregates([])["mean"]


def bootstrap(strata, statistic, *how):
    return stats.bootstrap_intervals(strata, {"": statistic}, *how)[""]


def test_iqm_is_the_mean_of_the_middle_half():
    assert stats.iqm(np.array([0.0, 1.0, 2.0, 100.0])) == pytest.approx(1.5)
    # five runs: the middle 2.5 are 0.75 of the 2nd, the 3rd, 0.75 of the 4th
    assert stats.iqm(np.array([10.0, 1.0, 2.0, 3.0, -50.0])) == pytest.approx((0.75 * 1 + 2 + 0.75 * 3) / 2.5)
    assert stats.iqm(np.array([-50.0, 1.0, 2.0, 9.0, 10.0])) == pytest.approx((0.75 * 1 + 2 + 0.75 * 9) / 2.5)
    assert stats.iqm(np.array([[1.0], [2.0]])).tolist() == [1.0, 2.0]


def test_other_statistics_on_known_values():
    assert stats.optimality_gap(np.array([50.0, 150.0])) == pytest.approx(25.0)
    assert stats.probability_of_improvement([np.array([1.0, 2.0])], [np.array([1.0, 0.0])]) == pytest.approx(0.875)
    tasks = [np.array([0.0, 4.0]), np.array([9.0]), np.array([1.0])]
    assert stats.aggregates(tasks)["median"](np.concatenate(tasks)) == 2.0, "of the tasks' means 2, 9, 1"
    share, band = stats.performance_profile([np.array([1.0]), np.array([3.0])], np.array([0.0, 2.0, 4.0]), None)
    assert (share.tolist(), band) == ([1.0, 0.5, 0.0], None)


@pytest.mark.parametrize("count", [5, 10, 30])
def test_bootstrap_coverage_matches_theory(count):
    rng = np.random.default_rng(count)
    hits, trials = 0, 2000
    for _ in range(trials):
        low, high = bootstrap([rng.normal(5, 1, count)], mean, rng, 1000)
        hits += low <= 5 <= high
    # resampled means spread by sqrt((n - 1) / n) standard errors, and the true mean is t-distributed about the sample's
    reach = scipy.stats.norm.ppf(0.975) * np.sqrt((count - 1) / count)
    expected = 1 - 2 * scipy.stats.t.sf(reach, count - 1)
    assert hits / trials == pytest.approx(expected, abs=3 * np.sqrt(expected * (1 - expected) / trials))
    assert expected < 0.95


def test_bootstrap_is_stratified_by_task():
    rng = np.random.default_rng(0)
    # tasks differ but have no spread within: only resampling across tasks would widen the interval
    low, high = bootstrap([np.full(4, 0.0), np.full(4, 100.0)], mean, rng, 500)
    assert low == high == 50.0
    assert bootstrap([np.array([1.0])], mean, rng) is None


def test_bootstrap_interval_of_mean_matches_standard_error():
    scores = np.arange(100) % 2.0  # a standard deviation of a half
    low, high = bootstrap([scores], mean, np.random.default_rng(0))
    assert (low, high) == pytest.approx((0.5 - 1.96 * 0.05, 0.5 + 1.96 * 0.05), abs=0.006)


@pytest.mark.parametrize("name", list(METHODS))
@pytest.mark.parametrize("statistic", ["iqm", "median", "mean", "optimality_gap"])
def test_aggregates_match_rliable(name, statistic):
    strata = METHODS[name]
    chosen = stats.aggregates(strata)
    chosen["optimality_gap"] = lambda scores: stats.optimality_gap(scores, 1.0)
    value, low, high = RLIABLE["statistics"][name][statistic]
    assert chosen[statistic](np.concatenate(strata)) == pytest.approx(value, abs=1e-9)
    found = bootstrap(strata, chosen[statistic], np.random.default_rng(0), 100_000)
    assert found == pytest.approx((low, high), abs=AGREES)


@pytest.mark.parametrize("name", list(METHODS))
def test_profiles_match_rliable(name):
    reference, thresholds = RLIABLE["statistics"][name], np.array(RLIABLE["thresholds"])
    shares, (low, high) = stats.performance_profile(METHODS[name], thresholds, np.random.default_rng(0))
    assert shares == pytest.approx(np.array(reference["profile"]), abs=1e-9)
    # shares and band ends are multiples of 1/32, so bands may differ by one step
    step = 1 / sum(map(len, METHODS[name]))
    for found, expected in ((low, reference["low"]), (high, reference["high"])):
        assert found == pytest.approx(np.array(expected), abs=step + 1e-9)
        assert np.mean(np.abs(found - expected) < AGREES) >= 0.8


def test_improvement_matches_rliable_and_scipy():
    one, other = METHODS["one"], METHODS["other"]
    chance, low, high = RLIABLE["improvement"]
    found = stats.probability_of_improvement(one, other)
    assert found == pytest.approx(chance, abs=1e-9)
    u = [scipy.stats.mannwhitneyu(a, b).statistic / (len(a) * len(b)) for a, b in zip(one, other, strict=True)]
    assert found == pytest.approx(np.mean(u), abs=1e-12)
    assert stats.improvement_interval(one, other, np.random.default_rng(0)) == pytest.approx((low, high), abs=0.005)


def test_single_seed_has_no_interval_and_draws_are_seeded():
    rng = np.random.default_rng
    one, many, thresholds = [np.array([1.0])], [np.arange(5.0)], np.array([1.0])
    assert stats.improvement_interval(one, many, rng(0)) is None
    assert stats.improvement_interval(many, one, rng(0)) is None
    assert stats.performance_profile([*one, *many], thresholds, rng(0))[1] is None
    assert stats.mean_interval(np.ones((1, 20))) is None
    assert stats.difference_interval(np.eye(1, 3), np.eye(3)) is None
    for draw in (
        lambda seed: bootstrap(many, stats.iqm, rng(seed)),
        lambda seed: stats.improvement_interval(many, [np.arange(1.0, 6.0)], rng(seed)),
        lambda seed: stats.performance_profile(many, np.arange(4.0), rng(seed), 50)[1].tolist(),
    ):
        assert draw(3) == draw(3)
    assert draw(3) != draw(4)


def levels(rng, seed_spread, episode_spread, shared=0.0, seeds=3, episodes=20):
    """(seeds, episodes) scores around 0: seed effect + shared episode effect + noise."""
    of_seeds, of_episodes = rng.normal(0, seed_spread, (seeds, 1)), np.broadcast_to(shared, (episodes,))
    return of_seeds + of_episodes + rng.normal(0, episode_spread, (seeds, episodes))


def test_single_episode_intervals_match_student_and_welch():
    rng = np.random.default_rng(0)
    one, other = rng.normal(3, 1, 4), rng.normal(0, 5, 7)
    student = scipy.stats.ttest_1samp(one, 0).confidence_interval(0.95)
    assert stats.mean_interval(one[:, None]) == pytest.approx(tuple(student))
    welch = scipy.stats.ttest_ind(one, other, equal_var=False).confidence_interval(0.95)
    assert stats.difference_interval(one[:, None], other[:, None]) == pytest.approx(tuple(welch))


def test_difference_has_welch_p_value_and_detectable_effect():
    rng = np.random.default_rng(0)
    one, other = rng.normal(3, 1, 5), rng.normal(0, 5, 7)
    found, welch = stats.difference(one[:, None], other[:, None]), scipy.stats.ttest_ind(one, other, equal_var=False)
    assert (found.p, found.free) == pytest.approx((welch.pvalue, welch.df))
    assert found.value / found.error == pytest.approx(welch.statistic)
    bar = scipy.stats.t.ppf(0.975, found.free)
    assert scipy.stats.nct.sf(bar, found.free, found.smallest / found.error) == pytest.approx(0.8, abs=0.01)
    assert stats.difference(one[:1, None], other[:, None]) is None


def test_difference_adds_seed_and_paired_episode_errors():
    rng = np.random.default_rng(3)
    one, other = levels(rng, 2, 1, rng.normal(0, 5, 20)) + 4, levels(rng, 1, 1)
    parts = [(one.mean(1), 3), (other.mean(1), 3), (one.mean(0) - other.mean(0), 20)]
    squares = [part.var(ddof=1) / n for part, n in parts]
    free = sum(squares) ** 2 / sum(square**2 / (n - 1) for square, (_, n) in zip(squares, parts, strict=True))
    found = stats.difference(one, other)
    value = one.mean() - other.mean()
    assert (found.value, found.error, found.free) == pytest.approx((value, sum(squares) ** 0.5, free))
    assert (found.interval[0] > 0) == (found.p < 0.05)
    assert stats.difference_interval(one, other) == found.interval


def test_holm_adjustment():
    assert stats.holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert stats.holm([0.6, 0.7]) == [1.0, 1.0]
    assert stats.holm([0.2]) == [0.2]
    assert stats.holm([]) == []
    rng, trials = np.random.default_rng(4), 2000
    wrong = sum(min(stats.holm(list(rng.uniform(size=4)))) < 0.05 for _ in range(trials))
    assert wrong / trials == pytest.approx(1 - (1 - 0.05 / 4) ** 4, abs=0.015), "family-wise error of independent tests"


@pytest.mark.parametrize("spreads", [(1.0, 0.0, 0.0), (1.0, 4.5, 1.0), (0.0, 1.0, 0.0), (1.0, 4.5, 9.0)])
def test_two_level_intervals_have_nominal_coverage(spreads):
    *own, shared = spreads
    rng, trials = np.random.default_rng(1), 1000
    held = np.zeros(2)
    for _ in range(trials):
        starts = rng.normal(0, shared, 20)
        one, other = (levels(rng, *own, starts) for _ in range(2))
        for place, found in enumerate((stats.mean_interval(one), stats.difference_interval(one, other))):
            held[place] += found[0] <= 0 <= found[1]
    assert (held / trials > 0.93).all(), held / trials


@pytest.mark.parametrize("spread", [1.0, 3.0])
def test_differences_of_five_and_two_seeds_cover_less(spread):
    """As `docs/reports.md` states, where seeds vary more than episodes; the two may also vary more than the five."""
    rng, trials, held = np.random.default_rng(1), 1000, 0
    for _ in range(trials):
        starts = rng.normal(0, 3, 20)
        one, other = levels(rng, 1.0, 0.3, starts, seeds=5), levels(rng, spread, 0.3, starts, seeds=2)
        low, high = stats.difference_interval(one, other)
        held += low <= 0 <= high
    assert 0.87 < held / trials < 0.95


def test_agreeing_seeds_keep_episode_uncertainty():
    """Three seeds with mean 0.5 from 20 episodes that score 0 or 1."""
    scores = np.tile(np.arange(20) % 2.0, (3, 1))
    low, high = stats.mean_interval(scores)
    reach = scipy.stats.t.ppf(0.975, 19) * scores[0].std(ddof=1) / np.sqrt(20)
    assert (low, high) == pytest.approx((0.5 - reach, 0.5 + reach))
    for score in (0.5, 33.3, 813.2702):  # means of equal scores may differ by rounding
        equal = np.full((3, 20), score)
        assert stats.mean_interval(equal) is None, "without spread there is no interval"
        assert stats.difference(equal, np.full((3, 20), 22.7)) is None
        unequal = equal + np.array([[0], [0], [1e-4]])
        assert stats.difference(unequal, np.full((3, 20), 22.7)).p < 0.05, "a stored digit of spread counts"


def test_shared_episode_effects_cancel_in_differences():
    rng = np.random.default_rng(2)
    starts = rng.normal(0, 9, 20)
    one, other = (levels(rng, 0.1, 0.1, starts) for _ in range(2))
    low, high = stats.difference_interval(one, other)
    assert high - low < 1
    low, high = stats.difference_interval(one, other[:, :19])
    assert high - low > 4, "different episodes cannot be paired"


def test_unequal_episode_counts_use_seed_means():
    assert stats.by_episode([[1.0, 3.0], [5.0, 7.0]]).tolist() == [[1.0, 3.0], [5.0, 7.0]]
    assert stats.by_episode([[1.0, 3.0], [5.0]]).tolist() == [[2.0], [5.0]]

"""Statistics over seeds and tasks. The seed is the replicate: episodes of one seed are averaged first, never pooled.

Interquartile mean, optimality gap, performance profiles, probability of improvement and the stratified bootstrap follow
Agarwal et al. 2021 (arXiv 2108.13264): a task is a stratum, and each bootstrap sample draws every task's seeds anew,
with replacement. All intervals are 95% percentile intervals. They cover less than they say where seeds are few
(docs/reports.md), so n always stands beside them, and of a single seed there is none.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

FEW_SEEDS = 5
"""Intervals of fewer seeds are flagged."""
REPLICATES = 20_000
"""Bootstrap samples of an interval."""
_LEVELS = (2.5, 97.5)
"""Percentiles of a 95% interval."""

Interval = tuple[float, float]
Statistic = Callable[[np.ndarray], np.ndarray]
"""(..., runs) scores -> (...) values."""
Strata = list[np.ndarray]
"""Scores by seed, one (n_i,) array a task."""


def mean(scores: np.ndarray) -> np.ndarray:
    """Mean over the last axis."""
    return scores.mean(-1)


def iqm(scores: np.ndarray) -> np.ndarray:
    """Interquartile mean over the last axis: the mean of the middle half, weights split at the quartiles."""
    ordered = np.sort(scores, axis=-1)
    count = ordered.shape[-1]
    edges = np.arange(count + 1) / count
    weight = np.clip(np.minimum(edges[1:], 0.75) - np.maximum(edges[:-1], 0.25), 0, None)
    return (ordered * weight).sum(-1) / weight.sum()


def optimality_gap(scores: np.ndarray, target: float = 100.0) -> np.ndarray:
    """Mean shortfall from `target` over the last axis; scores above it count as it."""
    return target - np.minimum(scores, target).mean(-1)


def median_of_tasks(sizes: Sequence[int]) -> Statistic:
    """Median over tasks of a task's mean, of scores whose last axis holds `sizes` runs of each task in turn."""
    edges = np.cumsum(sizes)[:-1]

    def median(scores: np.ndarray) -> np.ndarray:
        return np.median(np.stack([part.mean(-1) for part in np.split(scores, edges, axis=-1)], axis=-1), axis=-1)

    return median


def aggregates(strata: Strata) -> dict[str, Statistic]:
    """The statistics of all runs of a method, by name, for scores that hold those of each task in turn."""
    return {
        "iqm": iqm,
        "median": median_of_tasks([len(scores) for scores in strata]),
        "mean": mean,
        "optimality_gap": optimality_gap,
    }


def performance_profile(scores: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """Share of runs (n,) above each threshold (k,)."""
    return (scores[:, None] > thresholds).mean(0)


def probability_of_improvement(strata: Strata, others: Strata) -> float:
    """Chance that a random run beats a random one of the others on the same task, averaged over tasks; ties count half.

    Args:
        strata: scores of one method, by task.
        others: scores of another on the same tasks, in their order.
    """
    return float(np.mean([_wins(one, other).mean() for one, other in zip(strata, others, strict=True)]))


def _wins(scores: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(n, m): 1 where a run of (n,) scores is above one of (m,), 1/2 where they tie."""
    difference = scores[:, None] - others[None, :]
    return (difference > 0) + 0.5 * (difference == 0)


def bootstrap_interval(
    strata: Strata, statistic: Statistic, rng: np.random.Generator, replicates: int = REPLICATES
) -> Interval | None:
    """Percentile 95% interval of a statistic of all runs, seeds drawn anew within each task.

    Args:
        strata: scores by seed, one (n_i,) array a task.
        statistic: of (replicates, runs) scores.
        rng: source of the draws.
        replicates: bootstrap samples.

    Returns:
        Lower and upper end; None if a task has a single seed, which tells nothing about their spread.
    """
    return bootstrap_intervals(strata, {"": statistic}, rng, replicates)[""]


def bootstrap_intervals(
    strata: Strata, statistics: Mapping[str, Statistic], rng: np.random.Generator, replicates: int = REPLICATES
) -> dict[str, Interval | None]:
    """The same for several statistics, by name, of the same bootstrap samples."""
    if _single(strata):
        return dict.fromkeys(statistics)
    drawn = [scores[rng.integers(len(scores), size=(replicates, len(scores)))] for scores in strata]
    samples = np.concatenate(drawn, axis=1)
    return {name: _ends(statistic(samples)) for name, statistic in statistics.items()}


def difference_interval(
    scores: np.ndarray, others: np.ndarray, rng: np.random.Generator, replicates: int = REPLICATES
) -> Interval | None:
    """Percentile 95% interval of mean (n,) minus mean (m,), both drawn anew; None if either has a single seed."""
    if _single([scores, others]):
        return None
    one, other = (part[rng.integers(len(part), size=(replicates, len(part)))].mean(1) for part in (scores, others))
    return _ends(one - other)


def improvement_interval(
    strata: Strata, others: Strata, rng: np.random.Generator, replicates: int = REPLICATES
) -> Interval | None:
    """Percentile 95% interval of `probability_of_improvement`; None if a task has a single seed of either method."""
    if _single([*strata, *others]):
        return None
    chances = np.zeros(replicates)
    for one, other in zip(strata, others, strict=True):
        shares = _shares(len(one), rng, replicates) @ _wins(one, other)
        chances += (shares * _shares(len(other), rng, replicates)).sum(1)
    return _ends(chances / len(strata))


def profile_band(
    strata: Strata, thresholds: np.ndarray, rng: np.random.Generator, replicates: int = REPLICATES
) -> tuple[np.ndarray, np.ndarray] | None:
    """Pointwise 95% percentile band of the performance profile of all runs, two (k,) arrays; None as above."""
    if _single(strata):
        return None
    runs = sum(map(len, strata))
    shares = np.zeros((replicates, len(thresholds)))
    for scores in strata:
        shares += _shares(len(scores), rng, replicates) @ (scores[:, None] > thresholds) * (len(scores) / runs)
    low, high = np.percentile(shares, _LEVELS, axis=0)
    return low, high


def _single(strata: Strata) -> bool:
    return any(len(scores) < 2 for scores in strata)


def _shares(count: int, rng: np.random.Generator, replicates: int) -> np.ndarray:
    """(replicates, count): the share that each of `count` seeds has in a bootstrap sample."""
    drawn = rng.integers(count, size=(replicates, count)) + count * np.arange(replicates)[:, None]
    return np.bincount(drawn.ravel(), minlength=replicates * count).reshape(replicates, count) / count


def _ends(values: np.ndarray) -> Interval:
    low, high = np.percentile(values, _LEVELS)
    return float(low), float(high)


def mean_and_error(values: Sequence[float], digits: int = 0) -> str:
    """In words: the mean and its standard error, or the mean alone of a single value."""
    error = f" ± {np.std(values, ddof=1) / math.sqrt(len(values)):.{digits}f}" if len(values) > 1 else ""
    return f"{np.mean(values):.{digits}f}{error}"

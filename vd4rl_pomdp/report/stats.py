"""Statistics over seeds and tasks. Seeds are the replicates: episodes are averaged per seed first, never pooled.

Means and differences of means have 95% t intervals over two levels, seeds and episodes. Statistics over tasks
(interquartile mean, optimality gap, performance profiles, probability of improvement) have percentile intervals of the
stratified bootstrap of Agarwal et al. 2021 (arXiv 2108.13264): tasks are strata, and each bootstrap sample redraws
every task's seeds with replacement. docs/reports.md gives the coverage of both. n is always shown, and a single seed
has no interval.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtr, stdtrit

FEW_SEEDS = 5  # intervals of fewer seeds are flagged
REPLICATES = 20_000  # bootstrap samples per interval
LEVEL, POWER = 0.05, 0.8
"""Two-sided level of all tests and intervals, and the power that defines the smallest detectable difference."""
_LEVELS = (2.5, 97.5)  # percentiles of a 95% interval
_ROUNDING = 1e-12  # a standard error below this share of the largest mean is the rounding of floating point

Interval = tuple[float, float]
Statistic = Callable[[np.ndarray], np.ndarray]  # (..., runs) scores -> (...) values
Strata = list[np.ndarray]  # scores by seed, one (n_i,) array per task


def iqm(scores: np.ndarray) -> np.ndarray:
    """Interquartile mean over the last axis: mean of the middle half, with fractional weights at the quartiles."""
    ordered = np.sort(scores, axis=-1)
    count = ordered.shape[-1]
    edges = np.arange(count + 1) / count
    weight = np.clip(np.minimum(edges[1:], 0.75) - np.maximum(edges[:-1], 0.25), 0, None)
    return (ordered * weight).sum(-1) / weight.sum()


def optimality_gap(scores: np.ndarray, target: float = 100.0) -> np.ndarray:
    """Mean shortfall from `target` over the last axis; scores above the target count as the target."""
    return target - np.minimum(scores, target).mean(-1)


def aggregates(strata: Strata) -> dict[str, Statistic]:
    """Statistics over all runs of a method, by name, for scores concatenated over tasks."""
    edges = np.cumsum([len(scores) for scores in strata])[:-1]

    def median(scores: np.ndarray) -> np.ndarray:
        """Median over tasks of each task's mean."""
        return np.median(np.stack([part.mean(-1) for part in np.split(scores, edges, axis=-1)], axis=-1), axis=-1)

    return {"iqm": iqm, "median": median, "mean": lambda scores: scores.mean(-1), "optimality_gap": optimality_gap}


def probability_of_improvement(strata: Strata, others: Strata) -> float:
    """Probability that a run beats one of another method on the same task, averaged over tasks; ties count half."""
    return float(np.mean([_wins(one, other).mean() for one, other in zip(strata, others, strict=True)]))


def _wins(scores: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(n, m): 1 where a run of (n,) scores is above one of (m,), 1/2 for ties."""
    difference = scores[:, None] - others[None, :]
    return (difference > 0) + 0.5 * (difference == 0)


def by_episode(seeds: Sequence[Sequence[float]]) -> np.ndarray:
    """Scores as (seeds, episodes); or means as (seeds, 1) if seeds differ in their number of episodes."""
    if len(set(map(len, seeds))) == 1:
        return np.array(seeds, dtype=float)
    return np.array([[np.mean(episodes)] for episodes in seeds])


@dataclass(frozen=True)
class Estimate:
    """A mean or a difference of two means, for Student's t."""

    value: float
    error: float  # standard error
    free: float  # degrees of freedom

    @property
    def interval(self) -> Interval:
        reach = float(stdtrit(self.free, 1 - LEVEL / 2)) * self.error
        return self.value - reach, self.value + reach

    @property
    def p(self) -> float:
        """Two-sided p value against 0."""
        return 2 * float(stdtr(self.free, -abs(self.value) / self.error))

    @property
    def smallest(self) -> float:
        """Smallest true value that a 5% test detects with 80% power, at this error and these degrees of freedom."""
        return float(stdtrit(self.free, 1 - LEVEL / 2) + stdtrit(self.free, POWER)) * self.error


def mean_interval(scores: np.ndarray) -> Interval | None:
    """95% t interval of the mean of (seeds, episodes) scores, over the seeds and the episodes that they share.

    Three seeds that happen to agree must not make the interval narrower than the episodes allow. So the squared
    standard errors of both levels are added, with Welch-Satterthwaite degrees of freedom. This approximates a bootstrap
    of seeds and then episodes, corrected for few seeds. None for a single seed, or if all scores are equal, since that
    says nothing about the spread over seeds.
    """
    return found.interval if (found := _estimate(scores.mean(), [scores.mean(1)], [scores.mean(0)])) else None


def difference_interval(scores: np.ndarray, others: np.ndarray) -> Interval | None:
    """Like `mean_interval`, for the mean of (n, episodes) scores minus that of (m, episodes) others."""
    return found.interval if (found := difference(scores, others)) else None


def difference(scores: np.ndarray, others: np.ndarray) -> Estimate | None:
    """Mean of (n, episodes) scores minus that of (m, episodes) others, over both levels; None as in `mean_interval`.

    With equal numbers of episodes, these are paired: evaluations of a task start from the same states.
    """
    paired = scores.shape[1] == others.shape[1]
    episodes = [scores.mean(0) - others.mean(0)] if paired else [scores.mean(0), others.mean(0)]
    return _estimate(scores.mean() - others.mean(), [scores.mean(1), others.mean(1)], episodes)


def holm(values: Sequence[float]) -> list[float]:
    """Holm-adjusted p values of a family of tests, in the given order (Holm 1979): family-wise error of at most 5%."""
    adjusted, highest = list(values), 0.0
    for rank, place in enumerate(sorted(range(len(values)), key=values.__getitem__)):
        highest = max(highest, (len(values) - rank) * values[place])
        adjusted[place] = min(1.0, highest)
    return adjusted


def _estimate(middle: float, seeds: list[np.ndarray], episodes: list[np.ndarray]) -> Estimate | None:
    """Estimate of a sum of means, one per array. Arrays of episodes count if they have at least two values."""
    # No bootstrap: resampled means of three seeds spread by only sqrt(2/3) standard errors, and percentiles ignore the
    # t distribution. Its 95% interval would cover the mean only 3 times in 4.
    if _single(seeds):
        return None
    parts = [*seeds, *(part for part in episodes if len(part) > 1)]
    errors = np.array([part.var(ddof=1) / len(part) for part in parts])
    free = np.array([len(part) - 1 for part in parts])
    # means of equal scores can differ in their last digits, which are no spread either
    if math.sqrt(errors.sum()) <= _ROUNDING * max(np.abs(part).max() for part in parts):
        return None
    # Welch-Satterthwaite: effective degrees of freedom of a sum of estimated variances.
    return Estimate(float(middle), math.sqrt(errors.sum()), float(errors.sum() ** 2 / (errors**2 / free).sum()))


def bootstrap_intervals(
    strata: Strata, statistics: Mapping[str, Statistic], rng: np.random.Generator, replicates: int = REPLICATES
) -> dict[str, Interval | None]:
    """Percentile 95% intervals of statistics of all runs, by name; seeds are resampled within each task.

    `statistics` are functions of (replicates, runs) scores. None if a task has a single seed, whose spread is unknown.
    """
    if _single(strata):
        return dict.fromkeys(statistics)
    # Resample within tasks only: differences between tasks are not variation over seeds.
    drawn = [scores[rng.integers(len(scores), size=(replicates, len(scores)))] for scores in strata]
    samples = np.concatenate(drawn, axis=1)
    return {name: _ends(statistic(samples)) for name, statistic in statistics.items()}


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


def performance_profile(
    strata: Strata, thresholds: np.ndarray, rng: np.random.Generator, replicates: int = REPLICATES
) -> tuple[np.ndarray, np.ndarray | None]:
    """Fraction of all runs above each threshold (k,), and its pointwise 95% band (2, k), unless a task has one seed."""
    runs = np.concatenate(strata)
    share = (runs[:, None] > thresholds).mean(0)
    if _single(strata):
        return share, None
    shares = np.zeros((replicates, len(thresholds)))
    for scores in strata:
        shares += _shares(len(scores), rng, replicates) @ (scores[:, None] > thresholds) * (len(scores) / len(runs))
    return share, np.percentile(shares, _LEVELS, axis=0)


def _single(strata: Strata) -> bool:
    return any(len(scores) < 2 for scores in strata)


def _shares(count: int, rng: np.random.Generator, replicates: int) -> np.ndarray:
    """(replicates, count): fraction of each bootstrap sample that each of `count` seeds makes up."""
    # Statistics linear in these fractions become one matrix product.
    drawn = rng.integers(count, size=(replicates, count)) + count * np.arange(replicates)[:, None]
    return np.bincount(drawn.ravel(), minlength=replicates * count).reshape(replicates, count) / count


def _ends(values: np.ndarray) -> Interval:
    low, high = np.percentile(values, _LEVELS)
    return float(low), float(high)


def mean_and_error(values: Sequence[float], digits: int = 0) -> str:
    """In words: mean and standard error, or only the mean of a single value."""
    error = f" ± {np.std(values, ddof=1) / math.sqrt(len(values)):.{digits}f}" if len(values) > 1 else ""
    return f"{np.mean(values):.{digits}f}{error}"


def number(value: float | None, digits: int = 1) -> str:
    """A number, or a dash if unknown."""
    return "–" if value is None or math.isnan(value) else f"{value:z.{digits}f}"


def interval(low: float | None, high: float | None, digits: int = 1) -> str:
    """An interval in brackets, or a dash if unknown."""
    known = low is not None and high is not None and not math.isnan(low)
    return f"[{low:z.{digits}f}, {high:z.{digits}f}]" if known else "–"


def with_interval(value: float | None, low: float | None, high: float | None, digits: int = 1) -> str:
    """A number and its interval, as far as known."""
    return f"{number(value, digits)} {interval(low, high, digits)}".removesuffix(" –")

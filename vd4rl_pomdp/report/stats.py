"""Statistics over seeds and tasks. The seed is the replicate: episodes of one seed are averaged first, never pooled.

Interquartile mean, optimality gap, probability of improvement and stratified bootstrap follow Agarwal et al. 2021
(arXiv 2108.13264). A nominal 95% interval covers less with few seeds (75-90% at 3), so n is always shown.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

FEW_SEEDS = 5
"""Intervals of fewer seeds are flagged."""

Statistic = Callable[[np.ndarray], np.ndarray]
"""(..., runs) scores -> (...) values."""


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


def probability_of_improvement(scores: np.ndarray, others: np.ndarray) -> float:
    """Chance that a random run of `scores` (n,) beats one of `others` (m,), ties counting half."""
    difference = scores[:, None] - others[None, :]
    return float(((difference > 0) + 0.5 * (difference == 0)).mean())


def performance_profile(scores: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """Share of runs (n,) above each threshold (k,)."""
    return (scores[:, None] > thresholds).mean(0)


def bootstrap_interval(
    strata: list[np.ndarray], statistic: Statistic, rng: np.random.Generator, replicates: int = 20_000
) -> tuple[float, float] | None:
    """Percentile 95% interval of a statistic of all runs, seeds drawn anew within each task.

    Args:
        strata: scores by seed, one (n_i,) array a task.
        statistic: of (replicates, runs) scores.
        rng: source of the draws.
        replicates: bootstrap samples.

    Returns:
        Lower and upper end; None if a task has a single seed, which tells nothing about their spread.
    """
    if any(len(scores) < 2 for scores in strata):
        return None
    drawn = [scores[rng.integers(len(scores), size=(replicates, len(scores)))] for scores in strata]
    low, high = np.percentile(statistic(np.concatenate(drawn, axis=1)), [2.5, 97.5])
    return float(low), float(high)


def mean(scores: np.ndarray) -> np.ndarray:
    """Mean over the last axis."""
    return scores.mean(-1)

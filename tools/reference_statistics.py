"""Statistics of some scores by rliable 1.2.0, an independent implementation to test this package against.

    python -m venv scratch && scratch/bin/pip install rliable==1.2.0 "pandas<3"
    scratch/bin/python tools/reference_statistics.py > tests/report/rliable.json

rliable ignores its seed, so there are enough bootstrap samples for intervals to repeat to about 0.0005.
"""

import json
import sys

import numpy as np
from rliable import library, metrics

REPLICATES = 200_000
TASKS, SEEDS = 4, 8
THRESHOLDS = np.linspace(0, 1, 11)
"""The number of runs is a multiple of four, where rliable's interquartile mean (scipy's trimmed mean) equals ours."""


def main() -> None:
    """Print scores and rliable's statistics as JSON."""
    rng = np.random.default_rng(0)
    level = rng.uniform(0.2, 0.9, TASKS)
    scores = {
        name: np.round(level + shift + rng.normal(0, 0.15, (SEEDS, TASKS)), 2)
        for name, shift in (("one", 0.05), ("other", 0.0))
    }
    told = {name: _aggregates(values) | _profile(values) for name, values in scores.items()}
    json.dump(
        {
            "rliable": "1.2.0",
            "replicates": REPLICATES,
            "thresholds": THRESHOLDS.tolist(),
            "scores": {name: values.T.tolist() for name, values in scores.items()},
            "statistics": told,
            "improvement": _improvement(scores["one"], scores["other"]),
        },
        sys.stdout,
    )
    print()


def _aggregates(scores: np.ndarray) -> dict[str, list[float]]:
    """For each statistic of (seeds, tasks) scores: its value and interval."""

    def all_of(values: np.ndarray) -> np.ndarray:
        return np.array(
            [
                metrics.aggregate_iqm(values),
                metrics.aggregate_median(values),
                metrics.aggregate_mean(values),
                metrics.aggregate_optimality_gap(values),
            ]
        )

    points, ends = library.get_interval_estimates({"x": scores}, all_of, reps=REPLICATES)
    names = ("iqm", "median", "mean", "optimality_gap")
    return {name: [points["x"][i], *ends["x"][:, i]] for i, name in enumerate(names)}


def _profile(scores: np.ndarray) -> dict[str, list[float]]:
    shares, bands = library.create_performance_profile({"x": scores}, THRESHOLDS, reps=REPLICATES // 10)
    return {"profile": shares["x"].tolist(), "low": bands["x"][0].tolist(), "high": bands["x"][1].tolist()}


def _improvement(one: np.ndarray, other: np.ndarray) -> list[float]:
    chance, ends = library.get_interval_estimates(
        {"x": (one, other)}, metrics.probability_of_improvement, reps=REPLICATES // 10
    )
    return [float(chance["x"]), *map(float, ends["x"].ravel())]


if __name__ == "__main__":
    main()

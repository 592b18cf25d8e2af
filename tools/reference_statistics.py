"""Statistics of some scores by rliable 1.2.0, an independent implementation to test this package against.

    python -m venv scratch && scratch/bin/pip install rliable==1.2.0 "pandas<3"
    scratch/bin/python tools/reference_statistics.py > tests/report/rliable.json

rliable ignores its seed, so there are enough bootstrap samples for intervals to repeat to about 0.0005.
"""

import json

import numpy as np
from rliable import library, metrics

REPLICATES = 200_000
TASKS, SEEDS = 4, 8
THRESHOLDS = np.linspace(0, 1, 11)
"""The number of runs is a multiple of four, where rliable's interquartile mean (scipy's trimmed mean) equals ours."""


def main() -> None:
    """Print the scores, and rliable's statistics of them, as JSON."""
    rng = np.random.default_rng(0)
    level = rng.uniform(0.2, 0.9, TASKS)
    scores = {
        name: np.round(level + shift + rng.normal(0, 0.15, (SEEDS, TASKS)), 2)
        for name, shift in (("one", 0.05), ("other", 0.0))
    }
    both = scores["one"], scores["other"]
    chance, ends = library.get_interval_estimates(
        {"x": both}, metrics.probability_of_improvement, reps=REPLICATES // 10
    )
    results = {
        "rliable": "1.2.0",
        "replicates": REPLICATES,
        "thresholds": THRESHOLDS.tolist(),
        "scores": {name: values.T.tolist() for name, values in scores.items()},
        "statistics": {name: _statistics(values) for name, values in scores.items()},
        "improvement": [float(chance["x"]), *map(float, ends["x"].ravel())],
    }
    print(json.dumps(results))


def _statistics(scores: np.ndarray) -> dict[str, list[float]]:
    """By statistic of (seeds, tasks) scores: value and interval; the performance profile and its band."""
    names = ("iqm", "median", "mean", "optimality_gap")
    functions = [getattr(metrics, f"aggregate_{name}") for name in names]
    points, ends = library.get_interval_estimates(
        {"x": scores}, lambda values: np.array([function(values) for function in functions]), reps=REPLICATES
    )
    found = {name: [points["x"][i], *ends["x"][:, i]] for i, name in enumerate(names)}
    shares, bands = library.create_performance_profile({"x": scores}, THRESHOLDS, reps=REPLICATES // 10)
    low, high = bands["x"]
    return found | {"profile": shares["x"].tolist(), "low": low.tolist(), "high": high.tolist()}


if __name__ == "__main__":
    main()

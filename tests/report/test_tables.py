"""Tables of a handful of rows whose entries can be worked out by hand."""

from typing import Any

import numpy as np
import pytest
import scipy.stats

from vd4rl_pomdp.report import overall, tables

SCORES = {
    # (method, task): {seed: scores of the last evaluation's two episodes}
    ("acro", "walker_walk"): {0: (10.0, 30.0), 1: (40.0, 40.0)},  # seeds: 20, 40
    ("acro", "cheetah_run"): {0: (60.0, 60.0), 1: (80.0, 80.0)},
    ("mik", "walker_walk"): {0: (20.0, 20.0), 1: (30.0, 30.0)},
    ("mik", "cheetah_run"): {0: (90.0, 90.0), 1: (0.0, 0.0)},
}


def rows() -> list[dict[str, Any]]:
    """Two evaluations of every run, of two episodes each: at step 5 all score 99, at step 10 as above."""
    return [
        {
            "method": method,
            "task": task,
            "quality": "expert",
            "corruption": "patch",
            "algorithm": "td3_bc",
            "variant": "",
        }
        | {"seed": seed, "step": step, "scores": scores if step == 10 else (99.0,) * 2}
        | {"score": 99.0 if step == 5 else float(np.mean(scores))}
        for (method, task), seeds in SCORES.items()
        for seed, scores in seeds.items()
        for step in (5, 10)
    ]


def of(table: list[dict[str, Any]], **names: Any) -> list[dict[str, Any]]:
    return [row for row in table if all(row[name] == value for name, value in names.items())]


def test_a_summary_is_of_the_last_evaluation_and_names_the_best_beside_it():
    (row,) = of(tables.summary(rows(), []), method="acro", task="walker_walk")
    assert (row["step"], row["score"], row["seeds"], row["episodes"]) == (10, 30.0, 2, 4)
    assert (row["best_step"], row["best_score"], row["few_seeds"]) == (5, 99.0, True)
    error, free = (200 / 2 + 50 / 2) ** 0.5, 125**2 / (100**2 + 25**2)  # seeds 20 and 40, episodes 25 and 35
    reach = scipy.stats.t.ppf(0.975, free) * error
    assert (row["low"], row["high"]) == pytest.approx((30 - reach, 30 + reach))


def test_curves_show_mean_and_range_over_seeds_at_every_evaluation():
    found = of(tables.curves(rows()), method="acro", task="walker_walk")
    shown = [(row["step"], row["score"], row["low"], row["high"], row["seeds"]) for row in found]
    assert shown == [(5, 99.0, 99.0, 99.0, 2), (10, 30.0, 20.0, 40.0, 2)]


def test_aggregates_are_over_the_runs_of_all_tasks_at_their_end():
    (row,) = of(overall.aggregate(rows(), []), method="acro")
    assert row["iqm"] == pytest.approx((40 + 60) / 2), "the middle half of 20, 40, 60, 80"
    assert row["optimality_gap"] == pytest.approx(50.0)
    assert (row["tasks"], row["seeds"]) == (2, 2)


def test_what_lacks_tasks_stands_below_what_has_them_all():
    """Its mean is of other tasks: easier ones, perhaps."""
    lacking = [row for row in rows() if (row["method"], row["task"]) != ("mik", "cheetah_run")]
    for row in of(lacking, method="mik"):
        row["score"] = 95.0
    found = overall.aggregate(lacking, [])
    assert [(row["method"], row["tasks"], row["of_tasks"]) for row in found] == [("acro", 2, 2), ("mik", 1, 2)]
    assert found[1]["iqm"] > found[0]["iqm"]


def test_profiles_are_shares_of_runs_above_a_score():
    found = of(overall.profiles(rows()), method="mik")
    shares = {row["threshold"]: row["share"] for row in found}
    assert [shares[at] for at in (0, 30, 60)] == [0.75, 0.25, 0.25], "runs end at 20, 30, 90 and 0"
    assert all(row["low"] <= row["share"] <= row["high"] for row in found)


def test_improvement_compares_runs_of_one_task_and_averages_over_tasks():
    (row,) = of(overall.improvement(rows()), method="acro", other="mik")
    walker = np.mean([0.5, 0.0, 1.0, 1.0])  # 20 and 40 against 20 and 30
    cheetah = np.mean([0.0, 1.0, 0.0, 1.0])  # 60 and 80 against 90 and 0
    assert row["probability"] == pytest.approx((walker + cheetah) / 2)
    assert row["tasks"] == 2
    (other,) = of(overall.improvement(rows()), method="mik", other="acro")
    assert row["probability"] + other["probability"] == pytest.approx(1.0)

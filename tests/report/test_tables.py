"""Report tables of a few rows, compared with values computed by hand."""

import re
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.helpers_report import write_run, write_seeds
from vd4rl_pomdp.data.reference import Reference
from vd4rl_pomdp.report import figures, tables
from vd4rl_pomdp.report.load import CONDITION, load_runs, runs_frame
from vd4rl_pomdp.report.page import write_report
from vd4rl_pomdp.runs.episodes import append_episodes, read_episodes
from vd4rl_pomdp.runs.files import write_json

SCORES = {
    # (method, task): {seed: scores of the last evaluation's two episodes}
    ("acro", "walker_walk"): {0: (10.0, 30.0), 1: (40.0, 40.0)},  # seeds: 20, 40
    ("acro", "cheetah_run"): {0: (60.0, 60.0), 1: (80.0, 80.0)},
    ("mik", "walker_walk"): {0: (20.0, 20.0), 1: (30.0, 30.0)},
    ("mik", "cheetah_run"): {0: (90.0, 90.0), 1: (0.0, 0.0)},
}


def rows() -> pd.DataFrame:
    """Two evaluations of two episodes per run: all score 99 at step 5, and `SCORES` at step 10."""
    same = {"quality": "expert", "corruption": "patch", "algorithm": "td3_bc", "variant": ""}
    found = [
        {"method": method, "task": task, "seed": seed, "step": step, "scores": scores if step == 10 else (99.0,) * 2}
        | same
        | {"score": 99.0 if step == 5 else float(np.mean(scores))}
        for (method, task), seeds in SCORES.items()
        for seed, scores in seeds.items()
        for step in (5, 10)
    ]
    return pd.DataFrame(found)


NO_GAPS = pd.DataFrame(columns=[*CONDITION, "seed", "state"])


def of(table: pd.DataFrame, **names: Any) -> list[dict[str, Any]]:
    return [row for row in table.to_dict("records") if all(row[name] == value for name, value in names.items())]


def test_curves_show_mean_and_range_over_seeds():
    found = of(tables.curves(rows()), method="acro", task="walker_walk")
    shown = [(row["step"], row["score"], row["low"], row["high"], row["seeds"]) for row in found]
    assert shown == [(5, 99.0, 99.0, 99.0, 2), (10, 30.0, 20.0, 40.0, 2)]


def test_aggregates_use_final_scores_of_all_tasks():
    (row,) = of(tables.aggregate(rows(), NO_GAPS), method="acro")
    assert row["iqm"] == pytest.approx((40 + 60) / 2), "middle half of 20, 40, 60, 80"
    assert row["optimality_gap"] == pytest.approx(50.0)
    assert (row["tasks"], row["seeds"]) == (2, 2)


def test_methods_with_missing_tasks_rank_last():
    """Their mean covers other, perhaps easier, tasks."""
    table = rows()
    lacking = table[(table["method"] != "mik") | (table["task"] != "cheetah_run")]
    lacking = lacking.assign(score=lacking["score"].mask(lacking["method"] == "mik", 95.0))
    found = tables.aggregate(lacking, NO_GAPS).to_dict("records")
    assert [(row["method"], row["tasks"], row["of_tasks"]) for row in found] == [("acro", 2, 2), ("mik", 1, 2)]
    assert found[1]["iqm"] > found[0]["iqm"]
    looks = figures.looks_of(["acro", "mik"])
    (plot,) = figures.profile_plots(tables.profiles(lacking), pd.DataFrame(found), looks)
    (axes,) = plot.figure.axes
    assert axes.get_legend_handles_labels()[1] == ["acro", "mik (1 of 2 tasks)"]
    assert axes.lines[1].get_color() == figures.style(looks["mik"])["color"], "as in all figures"


def test_profiles_are_shares_of_runs_above_threshold():
    found = of(tables.profiles(rows()), method="mik")
    shares = {row["threshold"]: row["share"] for row in found}
    assert [shares[at] for at in (0, 30, 60)] == [0.75, 0.25, 0.25], "runs end at 20, 30, 90 and 0"
    assert all(row["low"] <= row["share"] <= row["high"] for row in found)


def test_improvement_is_averaged_over_tasks():
    (row,) = of(tables.improvement(rows()), method="acro", other="mik")
    walker = np.mean([0.5, 0.0, 1.0, 1.0])  # 20 and 40 against 20 and 30
    cheetah = np.mean([0.0, 1.0, 0.0, 1.0])  # 60 and 80 against 90 and 0
    assert row["probability"] == pytest.approx((walker + cheetah) / 2)
    assert row["tasks"] == 2
    (other,) = of(tables.improvement(rows()), method="mik", other="acro")
    assert row["probability"] + other["probability"] == pytest.approx(1.0)
    assert row["low"] < row["high"]
    assert (other["low"], other["high"]) == pytest.approx((1 - row["high"], 1 - row["low"]))


def evaluated_clean(run, returns, errors):
    """Set the action error of a run's last evaluation to `errors[0]`, and add a clean one with `errors[1]`."""
    episodes = [row for row in read_episodes(run / "episodes.csv") if row["step"] == 10]
    (run / "episodes.csv").unlink()
    append_episodes(run / "episodes.csv", [row | {"action_error": errors[0]} for row in episodes])
    clean = {"evaluated_under": "none", "action_error": errors[1]}
    append_episodes(run / "episodes.csv", [episodes[0] | clean | {"return": r, "score": r / 10} for r in returns])


def control(folder):
    """Rows of the control table by method."""
    return tables.control(runs_frame(load_runs([folder]))).set_index("method").to_dict("index")


def test_control_table_shows_corrupted_and_clean_returns(tmp_path):
    for seed, score in enumerate((30.0, 50.0)):
        run = write_run(tmp_path / str(seed), "acro", seed, {10: [score, 90.0]})
        Reference(500.0, None, 0.01 * (seed + 1)).write(run)
        evaluated_clean(run, [401.0, 399.0, 900.0], (0.1, 0.2))
    write_run(tmp_path / "mik", "mik", 0, {10: [70.0]})
    frame = runs_frame(load_runs([tmp_path]))
    assert frame.set_index(["method", "seed"])["score"].to_dict() == {("acro", 0): 60, ("acro", 1): 70, ("mik", 0): 70}
    found = control(tmp_path)
    numbers = ("data_return", "return", "share_above_80", "action_error", "path_error", "seeds")
    assert [round(found["acro"][name], 4) for name in numbers] == [500, 650, 0.75, 0.1, 0.015, 2]
    clean = ("clean_return", "clean_share_above_80", "clean_action_error")
    assert [round(found["acro"][name], 4) for name in clean] == [566.6667, 0.6667, 0.2]
    assert [name for name in (*numbers, *clean) if not np.isnan(found["mik"][name])] == ["return", "seeds"]
    write_run(tmp_path / "clean" / "0", "acro", 0, {10: [30.0]}, labels={"corruption": "none"})
    assert control(tmp_path / "clean")["acro"]["clean_return"] == 300.0, "trained with nothing hidden"


def test_means_over_incomplete_seeds_are_missing(tmp_path):
    """Else the number of seeds beside the mean would be wrong."""
    runs = [write_run(tmp_path / str(seed), "acro", seed, {10: [30.0 + seed]}) for seed in (0, 1)]
    evaluated_clean(runs[0], [400.0], (0.1, 0.2))
    row = control(tmp_path)["acro"]
    assert (row["return"], np.isnan(row["clean_return"]), row["seeds"]) == (305.0, True, 2)


def test_critics_table_shows_value_of_data_policy(tmp_path):
    write_seeds(tmp_path, {("acro", "patch"): (20, 22), ("mik", "patch"): (30,)}, 600.0)
    write_json(tmp_path / "acro-patch-1-td3_bc" / "critic.json", {"value": 170.0, "moved": -0.05, "data": 162.0})
    write_seeds(tmp_path, {("random", "patch"): (10,)}, 600.0, moved=None)
    write_json(write_run(tmp_path / "none", "curl", 0, {10: [1.0]}) / "critic.json", {})
    frame = runs_frame(load_runs([tmp_path]))
    found = tables.critics(frame).set_index("method").to_dict("index")
    names = ("critic_value", "critic_moved", "data_value", "converged", "seeds")
    assert [round(found["acro"][name], 4) for name in names] == [160, 0.03, 161, 1, 2]
    assert [round(found["mik"][name], 4) for name in names] == [150, 0.01, 160, 1, 1]
    assert np.isnan([found["random"][name] for name in names[:4]]).all(), "not recorded"
    assert "curl" not in found, "without a critic"
    own = frame.set_index(["method", "seed"])[["critic_value", "critic_moved", "data_value", "converged"]]
    assert own.loc["acro", 1].tolist() == [170.0, -0.05, 162.0, False]
    assert own["converged"].to_dict()["curl", 0] is True
    page = write_report([tmp_path], tmp_path / "out").page.read_text()
    shown = re.findall(r"<td>(.*?)</td>", page.partition("<h2>Critics</h2>")[2].partition("</table>")[0])
    assert shown[5:10] == ["acro", "160.0", "161.0", "3.0", "1 of 2"]
    assert shown[-5:] == ["random", "–", "–", "–", "not recorded"]
    assert ",critic_value,critic_moved,data_value,converged," in (tmp_path / "out" / "runs.csv").read_text()


def test_returns_do_not_depend_on_score_scale(tmp_path):
    run = write_run(tmp_path / "0", "acro", 0, {5: [9.0], 10: [30.0, 90.0]})
    episodes = read_episodes(run / "episodes.csv")
    (run / "episodes.csv").unlink()
    append_episodes(run / "episodes.csv", [row | {"return": row["score"]} for row in episodes])
    (row,) = tables.representations(tables.all_runs(runs_frame(load_runs([tmp_path])), NO_GAPS)).to_dict("records")
    assert (row["return"], control(tmp_path)["acro"]["return"]) == (60.0, 60.0)


def logged_losses(seed: int, every: int, loss: float, steps: int = 50_000):
    """A pretraining run that logged its loss every `every` steps."""
    named = dict.fromkeys(CONDITION, "") | {"method": "acro", "seed": seed}
    return named, [(step, loss + 1 / step) for step in range(every, steps + 1, every)]


def test_losses_are_averaged_at_common_steps():
    found = tables.losses([logged_losses(0, 100, 1.0), logged_losses(1, 150, 2.0, 49_800)])
    assert found["step"].tolist() == list(range(300, 49_801, 300))
    assert found["action_loss"].to_numpy() == pytest.approx(1.5 + 1 / found["step"].to_numpy())
    assert set(found["seeds"]) == {2}


def test_long_loss_curves_are_thinned():
    steps = tables.losses([logged_losses(0, 100, 1.0)])["step"].tolist()
    assert (steps[0], steps[-1], len(steps)) == (100, 50_000, 200)
    assert steps == sorted(set(steps))

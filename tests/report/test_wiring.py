"""Tables and figures of a report show the numbers that their titles name."""

from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.helpers_report import describe, pretraining, write_run
from vd4rl_pomdp.report import figures, tables
from vd4rl_pomdp.report.load import ALL, load_runs
from vd4rl_pomdp.report.page import SHOWN, _tables
from vd4rl_pomdp.report.render import texts
from vd4rl_pomdp.runs.episodes import append_episodes, read_episodes

NAMED = {"task": "walker_walk", "quality": "expert", "corruption": "patch", "algorithm": "td3_bc", "variant": ""}
NAMED |= {"method": "acro"}


@pytest.mark.parametrize(
    ("name", "row", "shown"),
    [
        (
            "gates",
            {"verdict": "discriminates", "memory": "-", "data_return": 801.0, "acro_bar": 0.71, "bar_from": "BC 60"}
            | {
                "state_share": 0.91,
                "acro_share": 0.82,
                "best_share": 0.63,
                "above_random": 5.0,
                "low": 4.0,
                "high": 6.0,
            },
            {"data's return": "801", "state": "0.91", "acro, none": "0.82", "acro's threshold": "0.71 (BC 60)"}
            | {"best": "0.63", "best – random": "5 [4, 6]"},
        ),
        (
            "representations",
            {
                "action_loss": 1.5,
                "probe_pose": 20.0,
                "probe_velocity": 40.0,
                "return": 300.0,
                "seeds": 3,
                "missing": "",
            },
            {"action loss": "1.500", "pose, %": "20.0", "velocity, %": "40.0", "return": "300", "seeds": "3"},
        ),
        (
            "control",
            {"data_return": 801.0, "return": 300.0, "clean_return": 500.0, "share_above_80": 0.3, "seeds": 3}
            | {"clean_share_above_80": 0.5, "path_error": 0.01, "action_error": 0.02, "clean_action_error": 0.03},
            {"data's return": "801", "return": "300", "return, clean": "500", "above 80%": "0.30"}
            | {"above 80%, clean": "0.50", "error on path": "0.0100", "in loop": "0.0200", "in loop, clean": "0.0300"},
        ),
        (
            "critics",
            {"critic_value": 150.0, "data_value": 160.0, "critic_moved": 0.01, "converged": 2.0, "seeds": 3},
            {"critic's value": "150.0", "data's discounted return": "160.0", "moved, %": "1.0", "converged": "2 of 3"},
        ),
        (
            "costs",
            {
                "machines": "",
                "runs": 2,
                "pretrain_seconds": 5.0,
                "pretrain_seconds_min": 4.0,
                "pretrain_seconds_max": 6.0,
            }
            | {"finetune_seconds": 8.0, "finetune_seconds_min": 7.0, "finetune_seconds_max": 9.0},
            {"pretraining, s": "5 (4 – 6)", "fine-tuning, s": "8 (7 – 9)", "runs": "2"},
        ),
        (
            "lead",
            {
                "steps": 2000,
                "stacks": 256,
                "difference": 5.0,
                "low": 4.0,
                "high": 7.0,
                "left_seeds": 3,
                "right_seeds": 2,
            },
            {"pretraining": "2,000 x 256", "% of the data's return": "5.0 [4.0, 7.0]", "seeds": "3, 2"},
        ),
    ],
)
def test_columns_show_what_their_titles_name(name, row, shown):
    (found,) = texts(pd.DataFrame([NAMED | row]), SHOWN[name]).to_dict("records")
    assert {title: found[title] for title in shown} == shown


def test_final_tables_are_of_finished_runs(tmp_path):
    for method, score in {"acro": 20.0, "mik": 30.0}.items():
        for seed in (0, 1, 2):
            run = write_run(tmp_path / f"{method}{seed}", method, seed, {10: [score + seed]})
            elsewhere = [row | {"evaluated_under": "zero_frames"} for row in read_episodes(run / "episodes.csv")]
            append_episodes(describe(run, {}) / "episodes.csv", elsewhere)
    cut = write_run(tmp_path / "mik3", "mik", 3, {10: [1.0]})
    append_episodes(cut / "episodes.csv", [row | {"evaluated_under": "zero_frames"} for row in elsewhere])
    (describe(cut, {}) / "timing.json").unlink()
    runs = load_runs([tmp_path])
    (memory,) = {run.of(("task", "quality", "corruption")) for run in runs}
    made = _tables(runs, ALL, {memory: ""})[0]

    def of(name: str) -> dict[str, Any]:
        return made[name][made[name]["method"] == "mik"].iloc[0].to_dict()

    assert (of("summary")["score"], of("summary")["seeds"]) == (31.0, 3)
    assert (of("aggregate")["mean"], of("aggregate")["seeds"]) == (31.0, 3)
    assert (of("profiles")["runs"], of("profiles")["share"]) == (3, 1.0)
    assert (of("improvement")["pairs"], of("improvement")["probability"]) == (9, 1.0)
    assert of("elsewhere")["seeds"] == 3
    assert (of("curves")["score"], of("curves")["seeds"]) == ((30 + 31 + 32 + 1) / 4, 4), "unfinished ones, too"


def segments(axes) -> list[list[float]]:
    """Ends of the lines of intervals."""
    return [
        line.tolist() for lines in axes.collections if hasattr(lines, "get_segments") for line in lines.get_segments()
    ]


def test_bars_have_the_interval_of_the_last_evaluation():
    ends = {"score": 30.0, "low": 28.0, "high": 33.0, "best_score": 40.0, "best_low": 35.0, "best_high": 48.0}
    summary = pd.DataFrame([NAMED | ends | {"absent": 0, "missing": "", "seeds": 2}])
    runs = pd.DataFrame([NAMED | {"seed": seed, "score": score} for seed, score in enumerate((29.0, 31.0))])
    gates = pd.DataFrame([NAMED | {"data_return": 512.0}])
    (plot,) = figures.bar_plots(summary, runs, gates, figures.looks_of(["acro"]))
    (axes,) = plot.figure.axes
    assert [bar.get_width() for bar in axes.patches] == [30.0]
    assert segments(axes) == [[[28.0, 0.0], [33.0, 0.0]]]
    dots = [place for marks in axes.collections if not hasattr(marks, "get_segments") for place in marks.get_offsets()]
    assert [place[0] for place in dots] == [29.0, 31.0, 40.0], "seeds, then the best evaluation"
    assert "n = 2 seeds (warning: fewer than 5)." in plot.caption


def test_leads_have_their_intervals():
    rows = [{"steps": 10, "difference": 5.0, "low": 4.0, "high": 8.0}, {"steps": 20, "difference": 6.0, "low": 1.0}]
    both = [NAMED | {"stacks": 8, "seeds": 3, "high": 9.0} | row for row in rows]
    (plot,) = figures.lead_plots(pd.DataFrame(both))
    assert segments(plot.figure.axes[0]) == [[[80, 4], [80, 8]], [[160, 1], [160, 9]]]


def test_curves_have_the_range_of_their_seeds_and_losses_all_steps():
    rows = [NAMED | {"step": step, "score": 5.0, "low": 3.0, "high": 9.0, "seeds": 2} for step in (5, 10)]
    (curve,) = figures.curve_plots(pd.DataFrame(rows), figures.looks_of(["acro"]))
    (band,) = curve.figure.axes[0].collections
    assert {tuple(point) for point in band.get_paths()[0].vertices.tolist()} == {(5, 3), (5, 9), (10, 3), (10, 9)}
    losses = tables.losses([(NAMED | {"seed": seed}, [(s, s + seed) for s in (1, 2, 3, 4)]) for seed in (0, 1)])
    (plot,) = figures.loss_plots(losses, figures.looks_of(["acro"]))
    (line,) = plot.figure.axes[0].lines
    np.testing.assert_array_equal(line.get_xydata(), [[s, s + 0.5] for s in (1, 2, 3, 4)])


def test_figures_are_drawn_from_their_tables(tmp_path, monkeypatch):
    names = ("summary", "runs", "gates", "profiles", "aggregate", "lead", "curves")
    made, drawn = {name: pd.DataFrame([NAMED]) for name in names}, {}
    for kind in ("bar", "profile", "lead", "curve", "dot", "loss"):
        monkeypatch.setattr(figures, f"{kind}_plots", lambda *given, kind=kind: drawn.update({kind: given}))
    (run,) = load_runs([pretraining(tmp_path / "run")])
    figures.draw_plots([run], made)
    known = {id(table): name for name, table in made.items()}
    found = {kind: [known[id(one)] for one in given if id(one) in known] for kind, given in drawn.items()}
    assert found == {
        "bar": ["summary", "runs", "gates"],
        "profile": ["profiles", "aggregate"],
        "lead": ["lead"],
        "curve": ["curves"],
        "dot": ["runs"],
        "loss": [],
    }
    assert drawn["loss"][0][["step", "action_loss"]].to_numpy().tolist() == [[1, 0.5], [2, 0.25]]

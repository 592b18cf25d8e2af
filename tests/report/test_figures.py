"""What figures show, whatever the sign of a return."""

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes

from tests.helpers_report import write_run
from vd4rl_pomdp.data.reference import Reference
from vd4rl_pomdp.report import write, write_report
from vd4rl_pomdp.report.lines import loss_rows
from vd4rl_pomdp.report.load import load_runs
from vd4rl_pomdp.runs.files import write_json

PRETRAINED = {"method": "acro", "task": "walker_walk", "quality": "expert", "corruption": "patch", "steps": 50_000}


def drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scores: dict[str, float]) -> dict[str, list[Axes]]:
    """Panels of a report's figures, by their files' names: two seeds of some methods, 30 less at first, and probed."""
    plots = {}
    monkeypatch.setattr(write, "save_plot", lambda _, plot: plots.update({plot.name: plot}))
    for method, score in scores.items():
        for seed in (0, 1):
            run = write_run(tmp_path / f"runs/{method}{seed}", method, seed, {5: [score - 30], 10: [score + seed]})
            write_json(run / "probe.json", {"probe_pose": 20.0, "probe_velocity": 40.0})
    write_report([tmp_path / "runs"], tmp_path / "out")
    return {name: plot.figure.axes for name, plot in plots.items()}


def test_returns_below_zero_are_shown(tmp_path, monkeypatch):
    shown = drawn(tmp_path, monkeypatch, {"mik+a": -20.0, "acro": -60.0})
    for name, low, high in (("scores_patch", -60, 0), ("curves_patch", -90, 0), ("probes_patch", -600, -190)):
        bottom, top = shown[name][0].get_ylim()
        assert bottom < low < high <= top, name
    (profile,) = shown["profiles"]
    assert profile.get_xlim() == (-60.0, 0.0)
    most = sorted(float(max(line.get_ydata())) for line in profile.get_lines())
    assert most == [0.5, 1.0], "shares of seeds above the lowest score"


def test_a_count_of_missing_seeds_stands_on_a_bar_below_zero(tmp_path, monkeypatch):
    write_run(tmp_path / "runs/bc", "bc", 2, {10: [-50.0]})
    panel = drawn(tmp_path, monkeypatch, {"mik+a": -20.0})["scores_patch"][0]
    assert [text.xy[1] for text in panel.texts] == [0.0, 0.0]


def test_a_panel_names_what_its_data_return_and_marks_what_was_better_before_the_end(tmp_path, monkeypatch):
    run = write_run(tmp_path / "runs/acro", "acro", 0, {5: [70.0], 10: [40.0]})
    write_json(run / "reference.json", {"data_return": 512.3, "path_error": None, "actor": None})
    write_run(tmp_path / "runs/stood", "mik", 0, {10: [50.0]}, labels={"task": "cheetah_run"})
    told, untold = drawn(tmp_path, monkeypatch, {"mik+a": 60.0})["scores_patch"]
    if told.get_title() < untold.get_title():
        told, untold = untold, told
    assert (told.get_title(), untold.get_title()) == ("walker_walk expert (data return 512)", "cheetah_run expert")
    diamonds = [panel.collections[1].get_offsets().tolist() for panel in (told, untold)]
    assert diamonds == [[[0.0, 70.0]], []], "the two other methods end where they are best"


def test_axes_of_positive_returns_begin_at_zero(tmp_path, monkeypatch):
    shown = drawn(tmp_path, monkeypatch, {"mik+a": 60.0, "acro": 40.0})
    assert shown["scores_patch"][0].get_ylim()[0] == 0
    assert shown["curves_patch"][0].get_ylim() == (0, pytest.approx(1.05 * 61))
    assert shown["probes_patch"][0].get_ylim() == (pytest.approx(-0.04 * 610), pytest.approx(1.06 * 610))
    assert shown["profiles"][0].get_xlim() == (0, 100)


def test_returns_stand_over_the_errors_of_their_actions(tmp_path, monkeypatch):
    for name, told, errors in (("told", 0.25, (0.5, 0.7)), ("untold", None, ())):
        run = write_run(tmp_path / f"runs/{name}", name, 0, {10: [30.0, 50.0]})
        Reference(500.0, None, told).write(run)
        lines = (run / "episodes.csv").read_text().splitlines()
        place = lines[0].split(",").index("action_error")
        for number, error in enumerate(errors, 1):
            cells = lines[number].split(",")
            lines[number] = ",".join([*cells[:place], str(error), *cells[place + 1 :]])
        (run / "episodes.csv").write_text("\n".join(lines) + "\n")
    shown = drawn(tmp_path, monkeypatch, {"mik+a": 60.0})
    panels = {
        panel.get_title(): [dots.get_offsets().tolist() for dots in panel.collections]
        for panel in shown["errors_patch"]
    }
    assert panels == {
        "walker_walk expert, actions on the data": [[[0.25, 400.0]]],
        "walker_walk expert, actions in closed loop": [[[0.6, 400.0]]],
    }


def pretrained(place: Path, seed: int, every: int, loss: float, steps: int = 50_000, finished: bool = True) -> None:
    """A pretraining run that told of a loss at some steps."""
    place.mkdir(parents=True)
    write_json(place / "config.json", {"stage": "pretrain", "config": PRETRAINED | {"seed": seed}})
    told = [{"step": step, "action_loss": loss + 1 / step} for step in range(every, steps + 1, every)]
    (place / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in told))
    if finished:
        write_json(place / "timing.json", {"seconds": 3.0, "steps": steps})


def test_losses_are_means_over_finished_runs_at_steps_that_all_of_them_told_of(tmp_path):
    pretrained(tmp_path / "a", 0, every=100, loss=1.0)
    pretrained(tmp_path / "b", 1, every=150, loss=2.0, steps=49_800)
    pretrained(tmp_path / "c", 2, every=100, loss=9.0, steps=20_000, finished=False)
    rows = loss_rows(load_runs([tmp_path]))
    steps = [row["step"] for row in rows]
    assert steps == list(range(300, 49_801, 300))
    assert {row["seeds"] for row in rows} == {2}
    assert np.array([row["action_loss"] for row in rows]) == pytest.approx(1.5 + 1 / np.array(steps))


def test_a_long_loss_curve_is_thinned_and_keeps_its_ends(tmp_path):
    pretrained(tmp_path / "a", 0, every=100, loss=1.0)
    steps = [row["step"] for row in loss_rows(load_runs([tmp_path]))]
    assert (steps[0], steps[-1], len(steps)) == (100, 50_000, 200)
    assert steps == sorted(set(steps))

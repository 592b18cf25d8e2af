"""The navigation report: tables, verdicts, stored rows and invalid input."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import flat
from vd4rl_pomdp.envs.mazes import FREE_CELLS, PAPER_MAZES
from vd4rl_pomdp.runs.files import jsonable
from vd4rl_pomdp.studies.navigation import figures
from vd4rl_pomdp.studies.navigation.config import NavigationConfig
from vd4rl_pomdp.studies.navigation.report import claims, judge, verdict_lines, write_report
from vd4rl_pomdp.studies.navigation.runs import (
    OBJECTIVES,
    RAW_PREFIX,
    REFERENCES,
    Condition,
    Measure,
    NavigationRun,
    condition_of,
    find_navigation,
    load_runs,
    numbers_of,
    paper_number,
    paper_rows,
    refitted_error,
)

TRAJECTORY = "three_curtains-mik-K15-seed0.csv"
STATE = refitted_error("state")


def write_run(base: Path, condition: Condition, seed: int, level: float, raw: bool = True) -> Path:
    """A finished run with all errors equal to `level` (1.5 x in raw units) and losses that increase with k."""
    folder = base / condition.name / f"seed{seed}"
    folder.mkdir(parents=True)
    asked = {
        **{"data": "data", "out": "out", "method": condition.method, "max_k": condition.max_k},
        "self_prediction": float(condition.self_prediction),
        "literal_future": condition.literal_future,
        "exogenous": condition.exogenous and "photographs",
    }
    given = {name: value for name, value in asked.items() if value}  # not every method reads all of them
    config = jsonable(flat(NavigationConfig.of("cpu", seed=seed, **given)))
    command = f"vd4rl-pomdp navigation train --data data/{condition.maze} --method {condition.method} --seed {seed}"
    inputs = {"data": f"set of {condition.maze}"}
    record = {"stage": "navigation", "config": config, "inputs": inputs, "git_commit": "abc", "command": command}
    common = {"rows": "all", "k": 0, "value": level}
    rows = [
        common
        | {"measure": f"{unit}{name}_error", "split": split, "probe": probe, "rows": shown, "value": level * times}
        for unit, times in (("", 1), (RAW_PREFIX, 1.5))[: 1 + raw]
        for name in ("state", "position", "velocity")
        for split, probe in (("held_out", "refit"), ("training", "online"))
        for shown in ("all", "hidden")
    ]
    rows += [
        common | {"measure": "action_loss", "split": split, "probe": "", "k": k, "value": level + k}
        for split in ("held_out", "training")
        for k in range(condition.max_k + 1)
    ]
    points = "".join(f"{t},{t / 50},1,0,0,{t / 50},1.1,0,0,0\n" for t in range(60))
    header = "t,x,y,vx,vy,estimated_x,estimated_y,estimated_vx,estimated_vy,hidden\n"
    for name, value in (
        ("config.json", record),
        ("results.json", {"maze": condition.maze, "set": "f00", "rows": rows}),
        ("timing.json", {"steps": 2500, "seconds": 300.0}),
        ("machine.json", {"processor": "some", "cores": 2, "gpu": None}),
    ):
        (folder / name).write_text(json.dumps(value))
    (folder / "trajectory.csv").write_text(header + points)
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Path:
    """Three seeds in one maze; tests must not write here."""
    base = tmp_path_factory.mktemp("navigation") / "runs"
    for seed in (0, 1, 2):
        for i, method in enumerate((*OBJECTIVES, "random")):
            write_run(base, Condition("three_curtains", method), seed, 10.0 * (8 - i) + seed)
        write_run(base, Condition("three_curtains", "ah+a", 1), seed, 44.0)
        write_run(base, Condition("three_curtains", "mik+a", 1), seed, 12.5 + 20 * (seed == 2))
    return base


def loaded(*paths: Path) -> list[NavigationRun]:
    return load_runs(find_navigation(paths))


def change(file: Path, **changes) -> None:
    """Update a JSON file; dict values are merged one level deep."""
    stored = json.loads(file.read_text())
    for name, value in changes.items():
        stored[name] = stored[name] | value if isinstance(value, dict) and name in stored else value
    file.write_text(json.dumps(stored))


def test_paper_numbers_map_to_conditions():
    for line in paper_rows():
        component = line["component"]
        name = component if component == "action_loss" else f"{component}_error"
        for maze in PAPER_MAZES:
            measure = Measure(name, "training", "online")
            assert paper_number(condition_of(line, maze), measure.raw()) == float(line[maze])
            assert measure == measure.raw() or paper_number(condition_of(line, maze), measure) is None
    assert paper_number(Condition("no_curtain", "mik+a"), STATE.raw()) == 3.4
    for condition, measure in (
        (Condition("hard_no_curtain", "mik+a"), STATE.raw()),
        (Condition("no_curtain", "mik+a"), refitted_error("state", "hidden").raw()),
        (Condition("no_curtain", "mik+a", literal_future=True), STATE.raw()),
        (Condition("no_curtain", "random"), STATE.raw()),
    ):
        assert paper_number(condition, measure) is None


def test_report_shows_means_seeds_and_paper_numbers(runs, tmp_path):
    page = write_report([runs], tmp_path / "out").read_text()
    numbers = {
        (row["table"], row["view"][:8], "raw" in row["view"], row["row"], row["maze"]): row
        for row in csv.DictReader((tmp_path / "out" / "tables.csv").open())
    }
    best = numbers["state_error", "held-out", False, "MIK+A, K=15", "three_curtains"]
    assert (best["mean"], best["seeds"], best["paper"]) == ("21", "3", "")
    assert float(best["low"]) < 21 < float(best["high"])
    raw = numbers["state_error", "held-out", True, "MIK+A, K=15", "three_curtains"]
    assert (raw["mean"], raw["seeds"], raw["paper"]) == ("31.5", "3", "6.0")
    assert "| **21.0** [18.5, 23.5] n=3 |" in page
    assert "**31.5** [27.8, 35.2] n=3 (6.0)" in page
    assert "Budget: 2,500 gradient steps on unknown samples, 5 minutes a run (some, 2 cores)." in page
    assert page.count("--seed 1  # ") == 10, "one command per run of seed 1"
    assert "no run (" not in page
    for name in ("accuracy.png", "accuracy_raw.png", "trajectories.png"):
        assert (tmp_path / "out" / "figures" / name).stat().st_size > 5_000


def test_report_is_reproducible_and_extendable(runs, tmp_path):
    first = write_report([runs], tmp_path / "out")
    page, kept = first.read_text(), {name: (first.parent / name).read_bytes() for name in ("runs.jsonl", "rows.csv")}
    assert write_report([tmp_path / "out"], tmp_path / "again").read_text() == page
    for name, content in kept.items():
        assert (tmp_path / "again" / name).read_bytes() == content
    assert (tmp_path / "again" / "trajectories" / TRAJECTORY).is_file()
    assert len(loaded(tmp_path / "out", runs)) == len(loaded(runs)), "runs found twice count once"
    write_run(tmp_path / "more", Condition("three_curtains", "supervised"), 0, 8.0)
    with pytest.raises(UserError, match="30 runs that would be lost"):
        write_report([tmp_path / "more"], tmp_path / "out")
    write_report([tmp_path / "out", tmp_path / "more"], tmp_path / "out")
    assert len(loaded(tmp_path / "out")) == 31


def test_report_lists_differing_settings(tmp_path):
    alike = [write_run(tmp_path / "runs", Condition("no_curtain", method), 0, 1.0) for method in ("mik+a", "fj", "ah")]
    longer = write_run(tmp_path / "runs", Condition("no_curtain", "no_history"), 0, 1.0)
    write_run(tmp_path / "runs", Condition("no_curtain", "mik+a", self_prediction=True), 0, 1.0)
    untrained = write_run(tmp_path / "runs", Condition("no_curtain", "random"), 0, 1.0)
    change(untrained / "timing.json", steps=0)
    write_report([tmp_path / "runs"], tmp_path / "out")
    assert "Not alike" not in (tmp_path / "out" / "report.md").read_text(), "conditions may differ"
    change(longer / "timing.json", steps=9000)
    for run in (*alike, untrained):
        change(run / "results.json", set="set of more")
        change(run / "config.json", collection={"trajectories": 300, "trajectory_rows": 500})
    page = write_report([tmp_path / "runs"], tmp_path / "changed").read_text()
    assert "Not alike in `no_curtain`: steps is 2500, but 9000 in `no_history-K15`." in page
    assert "set is set of m, but f00 in `mik+a-K15-sp`, `no_history-K15`." in page
    assert "on 150,000 samples" in page


@pytest.mark.parametrize(
    ("file", "changes", "name"),
    [
        ("timing.json", {"steps": 30}, "steps"),
        ("results.json", {"set": "b17"}, "set"),
        ("config.json", {"config": {"learning_rate": 5e-2}}, "learning_rate"),
        ("config.json", {"inputs": {"exogenous": "f2"}}, "exogenous"),
    ],
)
def test_seeds_with_different_settings_are_rejected(tmp_path, file, changes, name):
    condition = Condition("no_curtain", "ah", exogenous=True)
    folders = [write_run(tmp_path / "runs", condition, seed, 9.0) for seed in (0, 1)]
    for folder, images in zip(folders, ("/a/cifar", "/b/cifar"), strict=True):  # equal content in two folders
        logging = {"exogenous": images, "log_every": 10 * len(images)}
        change(folder / "config.json", config=logging, inputs={"exogenous": "f1"})
    assert len(loaded(tmp_path / "runs")) == 2
    change(folders[1] / file, **changes)
    with pytest.raises(UserError, match=f"seeds 0 and 1 differ in their {name}"):
        loaded(tmp_path / "runs")


def test_report_shows_missing_and_unfinished_runs(runs, tmp_path):
    for method in OBJECTIVES:
        for seed in (0, 1, 2)[: 2 if method == "mik" else 3]:
            write_run(tmp_path / "runs", Condition("three_curtains", method), seed, 10.0 + seed)
    write_run(tmp_path / "runs", Condition("no_curtain", "no_history"), 0, 50.0)
    write_run(tmp_path / "runs", Condition("no_curtain", "acro", 8), 0, 37.5)
    unfinished = write_run(tmp_path / "runs", Condition("three_curtains", "mik"), 2, 1.0)
    (unfinished / "timing.json").unlink()
    (unfinished / "metrics.jsonl").write_text('{"step": 40}\n')
    page = write_report([tmp_path / "runs"], tmp_path / "out").read_text()
    assert f"`{unfinished}` at 40 of 2500 steps." in page
    line = next(line for line in page.splitlines() if line.startswith("| MIK, K=15 |") and "(13.1)" in line)
    assert "n=2 of 3 (13.1)" in line
    assert line.startswith("| MIK, K=15 | no run (6.6) | (12.3) |"), "no runs in the other mazes"
    rows = list(csv.DictReader((tmp_path / "out" / "tables.csv").open()))
    missing = [row for row in rows if row["row"] == "MIK, K=15" and row["maze"] == "no_curtain"]
    assert {(row["seeds"], row["mean"]) for row in missing} == {("0", "")}
    assert "| acro-K8 | **37.5** n=1 |" in page.partition("## State estimation errors of what no other table has")[2]


def test_bar_plot_marks_paper_numbers_and_missing_runs(runs, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda figure, *_, **__: drawn.append(figure))
    counts = {}
    for measure in (STATE, STATE.raw()):
        assert figures.accuracy_bars(loaded(runs), measure, tmp_path / "bars.png")
        markers = [line.get_marker() for line in drawn[-1].axes[0].lines]
        counts[measure.is_raw] = [markers.count(kind) for kind in "_x"]
    in_the_paper, ran, references = 19, 9, len(REFERENCES) - 1
    assert counts[False] == [0, in_the_paper - ran + references], "the paper's units are raw"
    assert counts[True] == [in_the_paper, in_the_paper - ran + references]
    write_run(tmp_path / "runs", Condition("three_curtains", "no_history"), 0, 121.0, raw=False)
    figures.accuracy_bars(loaded(tmp_path / "runs"), STATE, tmp_path / "bars.png")
    assert drawn[-1].axes[0].get_ylim()[0] == -21, "errors above 100 are visible"


def test_first_person_claims_are_judged(tmp_path):
    levels = {("random", 0): 40, ("mik+a", 0): 21, ("mik+a", 1): 14, ("no_history", 0): 30, ("ah+a", 0): 25}
    for (method, sp), level in levels.items():
        write_run(tmp_path, Condition("compass_first_person", method, self_prediction=bool(sp)), 0, level)
    found = numbers_of(loaded(tmp_path))
    verdicts = {claim.text: judge(claim, found)[0] for claim in claims("compass_first_person")}
    assert {text: holds for text, holds in verdicts.items() if "state error" in text and "K=1" not in text} == {
        "state error of mik+a, of the untrained one's": False,
        "state error of mik+a": False,
        "no_history's state error, of that of mik+a": True,
        "state error of mik+a with self-prediction, of the untrained one's": True,
        "state error of mik+a with self-prediction": True,
        "no_history's state error, of that of mik+a with self-prediction": True,
        "ah+a's state error, of no_history's": False,
    }


def test_report_shows_verdicts_beside_the_paper(runs):
    page = verdict_lines(loaded(runs))
    rows = {line.split(" | ")[1]: line for line in page if line.startswith("| three_curtains | ")}
    assert rows["no_history's velocity error, of mik+a's >= 3 x"].endswith(
        "| 81.0 / 21.0 | **yes** | 3 of 3 | 121.5 / 31.5 | **yes** | 91.9 / 5.7: yes |"
    )
    assert rows["K=1: ah+a's state error, of mik+a's >= 2 x"].endswith(
        "| 44.0 / 19.2 | **yes** | 2 of 3 | 66.0 / 28.8 | **yes** | 46.8 / 8.0: yes |"
    )
    assert rows["ah+a's position error, of the untrained one's < 0.5 x"].endswith("| **no** | none |")
    assert rows["K=1: ah+a's action loss is near zero <= 5"].endswith("| no error | - | none |")
    assert rows["K=1: mik+a's state error with the literal future, of the default's >= 2 x"].endswith(
        "| no run yet | - | - | - | - | none |"
    )
    answers = [sum(f"| **{word}** |" in row for row in rows.values()) for word in ("yes", "no")]
    waiting = sum("| no run yet |" in row for row in rows.values())
    text = "\n".join(page)
    assert f"{answers[0]} of {sum(answers)} hold, {waiting} have no runs yet." in text
    assert f"Of {sum(answers) - 2} that are judged in both units, none changes." in text


def test_report_shows_effect_of_raw_units(tmp_path):
    """In raw units no_history's errors are a tenth, so the claim about its velocity no longer holds."""
    for method, level in (("mik+a", 21.0), ("no_history", 81.0)):
        results = write_run(tmp_path / "both", Condition("three_curtains", method), 0, level) / "results.json"
    rows = json.loads(results.read_text())["rows"]
    change(results, rows=[row | {"value": row["value"] * (0.1 if RAW_PREFIX in row["measure"] else 1)} for row in rows])
    text = "\n".join(verdict_lines(loaded(tmp_path / "both")))
    assert "1 change (three_curtains: no_history's velocity error, of mik+a's)." in text
    for method in ("mik+a", "no_history"):
        write_run(tmp_path / "runs", Condition("hard_three_curtains", method), 0, 9.0, raw=False)
    page = write_report([tmp_path / "runs"], tmp_path / "out").read_text()
    assert "beside the paper*" not in page
    assert "`hard_` mazes are variants of the paper's" in page
    assert not (tmp_path / "out" / "figures" / "accuracy_raw.png").exists()
    assert not [line for line in page.splitlines() if line.startswith("| MIK+A") and "(6.0)" in line]


def test_duplicate_runs_and_mixed_presets_are_rejected(tmp_path):
    condition = Condition("three_curtains", "mik")
    write_run(tmp_path / "one", condition, 0, 9.0)
    config = write_run(tmp_path / "other", condition, 0, 9.0) / "config.json"
    assert len(loaded(tmp_path / "one", tmp_path / "other")) == 1, "one run, given twice"
    change(config, format=2)
    with pytest.raises(UserError, match="three_curtains/mik-K15 seed 0 occurs twice; keep one"):
        loaded(tmp_path / "one", tmp_path / "other")
    change(config, config={"batch_size": 7})
    with pytest.raises(UserError, match=r"seeds 0 and 0 differ in their batch_size \(16, 7\)"):
        loaded(tmp_path / "one", tmp_path / "other")
    change(config, config={"preset": "paper", "seed": 7})
    with pytest.raises(UserError, match="different presets"):
        loaded(tmp_path / "one", tmp_path / "other")


def test_trajectories_linked_to_other_files_are_not_copied(runs, tmp_path):
    write_report([runs], tmp_path / "kept")
    (tmp_path / "linked").symlink_to("kept")
    write_report([tmp_path / "linked"], tmp_path / "again")  # the folder itself may be a link
    (tmp_path / "private").write_text("mine")
    file = tmp_path / "kept" / "trajectories" / TRAJECTORY
    file.unlink()
    file.symlink_to(tmp_path / "private")
    with pytest.raises(UserError, match=rf"{TRAJECTORY}: links to a file outside"):
        write_report([tmp_path / "linked"], tmp_path / "new")


def test_seeds_that_are_no_numbers_are_rejected(tmp_path):
    write_report([write_run(tmp_path / "runs", Condition("three_curtains", "mik"), 0, 10.0)], tmp_path / "kept")
    file = tmp_path / "kept" / "runs.jsonl"
    line = json.loads(file.read_text())
    line["config"]["config"]["seed"] = "/../../0"  # it is part of a file's name
    file.write_text(json.dumps(line) + "\n")
    with pytest.raises(UserError, match="its results are damaged"):
        write_report([tmp_path / "kept"], tmp_path / "out")


def test_report_includes_sample_observations_on_request(runs, tmp_path):
    rng = np.random.default_rng(0)
    samples = {name: rng.integers(0, 256, (2, 3, 9, 9), np.uint8) for name in ("a maze", "with noise, dark")}

    def no_display():
        raise UserError("cannot render")

    with pytest.raises(UserError, match="cannot render"):
        write_report([runs], tmp_path / "out", no_display)
    assert not (tmp_path / "out").exists()
    page = write_report([runs], tmp_path / "out", lambda: samples).read_text()
    assert "![Sample observations](figures/observations.png)" in page
    with Image.open(tmp_path / "out" / "figures" / "observations.png") as picture:
        assert len(np.unique(np.asarray(picture).reshape(-1, 4), axis=0)) > 4 * 81


def test_methods_without_k_count_as_k_1(tmp_path):
    folder = write_run(tmp_path, Condition("no_curtain", "ah"), 0, 5.0)
    config = json.loads((folder / "config.json").read_text())["config"]
    del config["max_k"]
    (folder / "config.json").write_text(json.dumps({"stage": "navigation", "command": "", "config": config}))
    (run,) = loaded(tmp_path)
    assert run.condition == Condition("no_curtain", "ah", max_k=1)


def test_free_cells_match_gymnasium_robotics():
    from gymnasium_robotics.envs.maze.maps import U_MAZE

    library = {(i, j) for i, row in enumerate(U_MAZE) for j, kind in enumerate(row) if kind != 1}
    assert set(FREE_CELLS) == library

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import flat
from vd4rl_pomdp.envs.mazes import FREE_CELLS, PAPER_MAZES
from vd4rl_pomdp.runs.files import jsonable
from vd4rl_pomdp.runs.results import add_results
from vd4rl_pomdp.studies.navigation import figures
from vd4rl_pomdp.studies.navigation.claims import claims, judge, paper_number, verdict_lines
from vd4rl_pomdp.studies.navigation.config import NavigationConfig
from vd4rl_pomdp.studies.navigation.measures import (
    RAW_PREFIX,
    Condition,
    Measure,
    condition_of,
    paper_rows,
    refitted_error,
)
from vd4rl_pomdp.studies.navigation.methods import OBJECTIVES, REFERENCES
from vd4rl_pomdp.studies.navigation.report import write_report
from vd4rl_pomdp.studies.navigation.runs import NavigationRun, find_navigation, load_runs, read_trajectory

ROOT = Path(__file__).parents[3]
TRAJECTORY = "three_curtains-mik-K15-seed0.csv"
STATE = refitted_error("state")


def write_run(base: Path, condition: Condition, seed: int, level: float, raw: bool = True) -> Path:
    """A finished run whose every error is `level`, in raw units 1.5 times that, and whose losses grow with k."""
    folder = base / condition.name / f"seed{seed}"
    folder.mkdir(parents=True)
    asked = {
        **{"data": "data", "out": "out", "method": condition.method, "max_k": condition.max_k},
        "self_prediction": float(condition.self_prediction),
        "literal_future": condition.literal_future,
        "exogenous": condition.exogenous and "photographs",
    }
    given = {name: value for name, value in asked.items() if value}  # not every method knows all of them
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


@pytest.fixture
def runs(tmp_path) -> Path:
    for seed in (0, 1, 2):
        for i, method in enumerate((*OBJECTIVES, "random")):
            write_run(tmp_path / "runs", Condition("three_curtains", method), seed, 10.0 * (8 - i) + seed)
        write_run(tmp_path / "runs", Condition("three_curtains", "ah+a", 1), seed, 44.0)
        write_run(tmp_path / "runs", Condition("three_curtains", "mik+a", 1), seed, 12.5 + 20 * (seed == 2))
    return tmp_path / "runs"


def loaded(*paths: Path) -> list[NavigationRun]:
    return load_runs(find_navigation(paths))


def test_every_line_of_the_papers_tables_is_a_condition_with_its_own_number():
    for line in paper_rows():
        component = line["component"]
        name = component if component == "action_loss" else f"{component}_error"
        for maze in PAPER_MAZES:
            measure = Measure(name, "training", "online")
            assert paper_number(condition_of(line, maze), measure.raw()) == float(line[maze])
            assert measure == measure.raw() or paper_number(condition_of(line, maze), measure) is None
    assert paper_number(Condition("no_curtain", "mik+a"), STATE.raw()) == 3.4
    assert paper_number(Condition("hard_no_curtain", "mik+a"), STATE.raw()) is None, "a variant of ours"
    assert paper_number(Condition("no_curtain", "mik+a"), STATE) is None, "it is no share of a standard deviation"
    assert paper_number(Condition("no_curtain", "mik+a"), refitted_error("state", "hidden").raw()) is None
    assert paper_number(Condition("no_curtain", "mik+a", literal_future=True), STATE.raw()) is None
    assert paper_number(Condition("no_curtain", "random"), STATE.raw()) is None


def test_the_page_says_what_training_on_the_true_states_reaches(runs, tmp_path):
    assert "true states" not in verdicts_of(runs)
    write_run(tmp_path / "runs", Condition("three_curtains", "supervised"), 0, 8.0)
    assert "true states" not in verdicts_of(runs), "one side alone compares nothing"
    write_run(tmp_path / "runs", Condition("three_curtains", "supervised"), 1, 9.0)
    write_run(tmp_path / "runs", Condition("three_curtains", "supervised+a"), 0, 4.0)
    assert "without and with past actions: three_curtains 8.5 and 4.0." in verdicts_of(runs)


def verdicts_of(runs: Path) -> str:
    return "\n".join(verdict_lines(loaded(runs)))


def test_the_report_shows_means_seeds_and_the_papers_numbers(runs, tmp_path):
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
    assert "(-)" not in page
    assert page.count("--seed 1  # ") == 10, "one command for every run of seed 1"
    for name in ("accuracy.png", "accuracy_raw.png", "trajectories.png"):
        assert (tmp_path / "out" / "figures" / name).stat().st_size > 5_000


def test_the_report_made_from_its_own_rows_is_the_same(runs, tmp_path):
    first = write_report([runs], tmp_path / "first")
    again = write_report([tmp_path / "first"], tmp_path / "again")
    assert first.read_text() == again.read_text()
    for name in ("runs.jsonl", "rows.csv", "tables.csv", f"trajectories/{TRAJECTORY}"):
        assert (first.parent / name).read_bytes() == (again.parent / name).read_bytes()
    twice = loaded(tmp_path / "first", runs)
    assert len(twice) == len(loaded(runs)), "a run that is told of twice counts once"


def test_runs_are_added_to_an_earlier_report_and_none_is_lost(runs, tmp_path):
    out = tmp_path / "out"
    write_report([runs], out)
    write_run(tmp_path / "more", Condition("three_curtains", "supervised"), 0, 8.0)
    with pytest.raises(UserError, match="30 runs that would be lost"):
        write_report([tmp_path / "more"], out)
    write_report([out, tmp_path / "more"], out)
    assert len(loaded(out)) == 31
    write_run(tmp_path / "later", Condition("three_curtains", "supervised"), 1, 9.0)
    assert add_results([tmp_path / "later"], out).added == 1
    assert [run.trajectory is None for run in loaded(out)].count(True) == 1, "the report alone keeps trajectories"


def tell_set(run: Path, rows: int, **changed) -> None:
    """Let a run say that its set has trajectories of so many rows, and other facts."""
    record, results = (json.loads((run / name).read_text()) for name in ("config.json", "results.json"))
    record["collection"] = {"maze": results["maze"], "trajectories": 300, "trajectory_rows": rows, "seed": 0} | changed
    (run / "config.json").write_text(json.dumps(record))
    (run / "results.json").write_text(json.dumps(results | {"set": f"set of {rows} rows"}))


def test_samples_and_commands_are_those_of_the_runs_own_sets(tmp_path):
    tell_set(write_run(tmp_path / "runs", Condition("compass_first_person", "mik+a"), 0, 1.0), 1000, seed=5)
    tell_set(write_run(tmp_path / "runs", Condition("no_curtain", "mik+a"), 0, 1.0), 500)
    untold = write_run(tmp_path / "runs", Condition("one_curtain", "mik+a"), 0, 1.0)
    record = json.loads((untold / "config.json").read_text())
    (untold / "config.json").write_text(json.dumps(record | {"collection": {}}))
    page = write_report([tmp_path / "runs"], tmp_path / "out").read_text()
    assert "on 150,000 or 300,000 samples" in page
    collect = "vd4rl-pomdp navigation collect --preset cpu --maze"
    assert f"{collect} compass_first_person --trajectories 300 --seed 5 --out data/compass_first_person\n" in page
    assert f"{collect} no_curtain --trajectories 300 --trajectory-rows 500 --out data/no_curtain\n" in page
    assert f"{collect} one_curtain" not in page


@pytest.mark.parametrize("changed", [{"note": "x"}, {"trajectories": "300"}, {"trajectory_rows": None}])
def test_a_set_with_other_facts_is_no_reason_to_lose_a_report(tmp_path, changed):
    tell_set(write_run(tmp_path / "runs", Condition("no_curtain", "mik+a"), 0, 1.0), 500, **changed)
    page = write_report([tmp_path / "runs"], tmp_path / "out").read_text()
    told = "--trajectories 300 --trajectory-rows 500" in page
    assert told == ("note" in changed), "what is not whole is not told"


def test_nothing_is_written_where_no_sample_can_be_drawn(tmp_path):
    def samples():
        raise UserError("cannot render")

    write_run(tmp_path / "runs", Condition("no_curtain", "mik+a"), 0, 1.0)
    with pytest.raises(UserError, match="cannot render"):
        write_report([tmp_path / "runs"], tmp_path / "out", samples)
    assert not (tmp_path / "out").exists()


def test_what_was_not_trained_alike_is_said(tmp_path):
    alike = [write_run(tmp_path / "runs", Condition("no_curtain", method), 0, 1.0) for method in ("mik+a", "fj", "ah")]
    longer = write_run(tmp_path / "runs", Condition("no_curtain", "no_history"), 0, 1.0)
    write_run(tmp_path / "runs", Condition("no_curtain", "mik+a", self_prediction=True), 0, 1.0)
    untrained = write_run(tmp_path / "runs", Condition("no_curtain", "random"), 0, 1.0)
    (untrained / "timing.json").write_text(json.dumps({"steps": 0, "seconds": 1.0}))
    write_report([tmp_path / "runs"], tmp_path / "out")
    assert "Not alike" not in (tmp_path / "out" / "report.md").read_text(), "self-prediction and no training are told"
    (longer / "timing.json").write_text(json.dumps({"steps": 9000, "seconds": 300.0}))
    for run in (*alike, untrained):
        tell_set(run, 1000)
    page = write_report([tmp_path / "runs"], tmp_path / "out").read_text()
    assert "Not alike in `no_curtain`: steps is 2500, but 9000 in `no_history-K15`." in page
    assert "set is set of 1, but f00 in `mik+a-K15-sp`, `no_history-K15`." in page


def test_every_condition_is_in_a_table_and_untrained_ones_alone_make_a_page(tmp_path):
    write_run(tmp_path / "runs", Condition("no_curtain", "random"), 0, 41.5)
    page = write_report([tmp_path / "runs"], tmp_path / "out").read_text()
    assert "Budget: 2,500 gradient steps" in page
    assert "no other table" not in page
    write_run(tmp_path / "runs", Condition("no_curtain", "acro", 8), 0, 37.5)
    page = write_report([tmp_path / "runs"], tmp_path / "out").read_text()
    assert "| acro-K8 | **37.5** n=1 |" in page.partition("## State estimation errors of what no other table has")[2]


def test_damaged_reports_and_runs_are_named(runs, tmp_path):
    whole = tmp_path / "whole"
    write_report([runs], whole)
    first, rest = (whole / "runs.jsonl").read_text().split("\n", 1)
    for damaged in (first[:500], first.replace('"value": 80', '"value": "eighty"', 1), '{"a": 1}'):
        (whole / "runs.jsonl").write_text(f"{damaged}\n{rest}")
        with pytest.raises(
            UserError, match=r"whole.*: (line 1|run [0-9a-f]{24}): its (files|results) are damaged"
        ) as caught:
            loaded(whole)
        assert len(str(caught.value).splitlines()) == 1
    folder = runs / "three_curtains" / "ah-K15" / "seed0"
    (folder / "results.json").write_text("{}")
    with pytest.raises(UserError, match="seed0: its results are damaged"):
        loaded(runs)
    with pytest.raises(UserError, match="name at least one run folder"):
        loaded()


@pytest.mark.parametrize(
    ("file", "before", "after", "said"),
    [
        (
            "results.json",
            '"maze": "three_curtains"',
            '"maze": "compass"',
            r"its results are damaged \(its maze is 'compass'",
        ),
        ("config.json", '"preset": "cpu"', '"preset": "fast"', r"its results are damaged \(its preset is 'fast'"),
    ],
)
def test_a_run_of_something_unknown_is_named_before_anything_is_written(runs, tmp_path, file, before, after, said):
    damaged = runs / "three_curtains" / "mik-K15" / "seed0" / file
    text = damaged.read_text()
    assert before in text
    damaged.write_text(text.replace(before, after))
    with pytest.raises(UserError, match=said):
        write_report([runs], tmp_path / "out")


def test_a_trajectory_without_estimates_is_named(runs):
    path = runs / "three_curtains" / "mik-K15" / "seed0" / "trajectory.csv"
    path.write_text(path.read_text().replace("estimated_y", "estimated"))
    with pytest.raises(UserError, match=r"trajectory.csv: is no trajectory of a run \(it has no estimated_y\)"):
        read_trajectory(path)


def test_a_run_that_measured_nothing_is_named(runs, tmp_path):
    path = runs / "three_curtains" / "mik-K15" / "seed0" / "results.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"rows": []}))
    with pytest.raises(UserError, match=r"its results are damaged \(it has measured nothing\)"):
        loaded(runs)


def test_exogenous_images_are_told_by_their_content(tmp_path):
    condition = Condition("no_curtain", "ah", exogenous=True)
    folders = [write_run(tmp_path / "runs", condition, seed, 9.0) for seed in (0, 1)]
    whole = [json.loads((folder / "config.json").read_text()) for folder in folders]

    def say(*images: tuple[str, str]) -> None:
        for folder, record, (path, content) in zip(folders, whole, images, strict=True):
            told = {"config": record["config"] | {"exogenous": path}, "format": 3}
            told |= {"inputs": record["inputs"] | {"exogenous": content}}
            (folder / "config.json").write_text(json.dumps(record | told))

    say(("/a/cifar", "f1"), ("/b/cifar", "f1"))
    assert len(loaded(tmp_path / "runs")) == 2
    say(("cifar", "f1"), ("cifar", "f2"))
    with pytest.raises(UserError, match=r"seeds 0 and 1 differ in their exogenous \(f1, f2\)"):
        loaded(tmp_path / "runs")


def test_seeds_of_another_budget_or_set_make_no_mean(tmp_path):
    for seed in (0, 1):
        folder = write_run(tmp_path / "runs", Condition("no_curtain", "ah"), seed, 9.0)
    for name, fact in (("timing.json", {"steps": 30, "seconds": 3.0}), ("results.json", {"set": "b17"})):
        before = json.loads((folder / name).read_text())
        (folder / name).write_text(json.dumps(before | fact))
        with pytest.raises(UserError, match=f"seeds 0 and 1 differ in their {next(iter(fact))}"):
            loaded(tmp_path / "runs")
        (folder / name).write_text(json.dumps(before))
    assert len(loaded(tmp_path / "runs")) == 2


def test_seeds_of_other_settings_make_no_mean_and_other_logging_does(tmp_path):
    folders = [write_run(tmp_path / "runs", Condition("no_curtain", "ah"), seed, 9.0) for seed in (0, 1)]
    whole = [json.loads((folder / "config.json").read_text()) for folder in folders]

    def say(*flags: str) -> None:
        for folder, record, more in zip(folders, whole, flags, strict=True):
            text = json.dumps(record | {"command": f"{record['command']} {more}"})
            (folder / "config.json").write_text(text)

    for one, other in (("--codes 6", ""), ("--codes 6", "--codes 20"), ("--no-k-embedding", ""), ("", "--window=16")):
        say(one, other)
        with pytest.raises(UserError, match=r"seeds 0 and 1 differ in their (codes|no_k_embedding|window)"):
            loaded(tmp_path / "runs")
    say("--learning-rate 1e-3 --device cpu --log-every 10 --wandb=off", "--learning-rate=0.001 --data elsewhere")
    assert len(loaded(tmp_path / "runs")) == 2
    say("--codes '6", "")
    with pytest.raises(UserError, match="command is damaged"):
        loaded(tmp_path / "runs")


def test_settings_are_those_of_whole_configs_whatever_the_commands_named(tmp_path):
    folders = [write_run(tmp_path / "runs", Condition("no_curtain", "ah"), seed, 9.0) for seed in (0, 1)]
    for folder, rate, more in zip(folders, (2e-3, 5e-2), ("", " --learning-rate 0.002"), strict=True):
        record = json.loads((folder / "config.json").read_text()) | {"format": 3}
        record["command"] += more
        record["config"]["learning_rate"] = rate
        (folder / "config.json").write_text(json.dumps(record))
    with pytest.raises(UserError, match=r"seeds 0 and 1 differ in their learning_rate \(0.002, 0.05\)"):
        loaded(tmp_path / "runs")
    record["config"]["learning_rate"] = 2e-3  # the default, which the command spells out
    (folders[1] / "config.json").write_text(json.dumps(record))
    assert len(loaded(tmp_path / "runs")) == 2


@pytest.mark.parametrize("folder", ["navigation", "navigation/longer"])
def test_the_committed_rows_make_a_report(folder):
    assert len(loaded(ROOT / "results" / folder)) >= 2


def test_missing_cells_seeds_and_unfinished_runs_are_shown(runs, tmp_path, monkeypatch):
    assert "no run (" not in write_report([runs], tmp_path / "whole").read_text()
    write_run(tmp_path / "runs", Condition("no_curtain", "no_history"), 0, 50.0)
    (runs / "three_curtains" / "mik-K15" / "seed1" / "timing.json").unlink()
    (runs / "three_curtains" / "mik-K15" / "seed1" / "metrics.jsonl").write_text('{"step": 40}\n')
    config = json.loads((runs / "three_curtains" / "mik-K15" / "seed1" / "config.json").read_text())
    config["config"]["steps"] = 2500
    (runs / "three_curtains" / "mik-K15" / "seed1" / "config.json").write_text(json.dumps(config))
    page = write_report([runs], tmp_path / "out").read_text()
    assert f"`{runs}/three_curtains/mik-K15/seed1` at 40 of 2500 steps." in page
    line = next(line for line in page.splitlines() if line.startswith("| MIK, K=15 |") and "(13.1)" in line)
    assert "n=2 of 3 (13.1)" in line
    assert line.startswith("| MIK, K=15 | no run (6.6) | (12.3) |"), "nobody has been in the other mazes"
    rows = list(csv.DictReader((tmp_path / "out" / "tables.csv").open()))
    missing = [row for row in rows if row["row"] == "MIK, K=15" and row["maze"] == "no_curtain"]
    assert {(row["seeds"], row["mean"]) for row in missing} == {("0", "")}
    marked = []
    monkeypatch.setattr("matplotlib.axes.Axes.plot", lambda axes, *at, **style: marked.append(style.get("marker")))
    figures.accuracy_bars(loaded(runs), STATE, tmp_path / "bars.png")
    in_the_paper, ran = 19, 9
    references = (len(REFERENCES) - 1) + len(REFERENCES)
    assert marked.count("x") == (in_the_paper - ran) + (in_the_paper - 1) + references, "three_curtains, no_curtain"


def test_a_navigation_report_writes_over_nothing_but_an_earlier_one(runs, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "README.md").write_text("mine")
    run = runs / "three_curtains" / "mik-K15" / "seed0"
    for out in (tmp_path / "mine", runs, run, run / "report"):
        with pytest.raises(UserError, match="choose another --out"):
            write_report([runs], out)
    assert (tmp_path / "mine" / "README.md").read_text() == "mine"
    first = write_report([runs], tmp_path / "out").read_text()
    assert write_report([tmp_path / "out"], tmp_path / "out").read_text() == first


@pytest.mark.parametrize("value", ["nan", "inf"])
def test_a_result_that_is_no_number_is_refused(runs, tmp_path, value):
    write_report([runs], tmp_path / "out")
    kept = tmp_path / "out" / "runs.jsonl"
    kept.write_text(re.sub(r'"value": [0-9.]+', f'"value": {json.dumps(float(value))}', kept.read_text(), count=1))
    with pytest.raises(UserError, match=f"out: run [0-9a-f]{{24}}: a [a-z_]+ is {value}: the run has diverged"):
        loaded(tmp_path / "out")
    results = runs / "three_curtains" / "mik-K15" / "seed0" / "results.json"
    stored = json.loads(results.read_text())
    stored["rows"][0]["value"] = float(value)
    results.write_text(json.dumps(stored))
    with pytest.raises(UserError, match=r"seed0: a state_error is"):
        loaded(runs)


def test_claims_are_judged_by_means_and_seed_by_seed(runs):
    found = loaded(runs)
    verdicts = {claim.text: judge(claim, found) for claim in claims("three_curtains")}
    k1 = verdicts["K=1: ah+a's state error, of mik+a's"]
    assert (k1.seeds_holding, k1.seeds, k1.holds, k1.paper) == (2, 3, True, None)
    assert k1.left == pytest.approx(44)
    raw = judge(k1.claim.raw(), found)
    assert (raw.left, raw.paper) == (pytest.approx(66), (46.8, 8.0))
    gate = verdicts["gate: mik+a's action loss at k=1, of that at k=15"]
    assert gate.holds == ((21 + 1) <= 0.85 * (21 + 15))
    assert gate.paper is None
    assert verdicts["K=1: ah+a's action loss is near zero"].holds is False
    waiting = verdicts["K=1: mik+a's state error with the literal future, of the default's"]
    assert (waiting.seeds, waiting.holds) == (0, False)


def test_in_first_person_the_place_must_be_known_by_far_and_in_the_papers_order(tmp_path):
    for method, level, sp in (
        ("random", 40, 0),
        ("mik+a", 21, 0),
        ("mik+a", 14, 1),
        ("no_history", 30, 0),
        ("ah+a", 25, 0),
    ):
        write_run(tmp_path, Condition("compass_first_person", method, self_prediction=bool(sp)), 0, level)
    found = loaded(tmp_path)
    told = {
        claim.text: judge(claim, found).holds for claim in claims("compass_first_person") if "state error" in claim.text
    }
    assert {text: holds for text, holds in told.items() if "K=1" not in text} == {
        "state error of mik+a, of the untrained one's": False,
        "state error of mik+a": False,
        "no_history's state error, of that of mik+a": True,
        "state error of mik+a with self-prediction, of the untrained one's": True,
        "state error of mik+a with self-prediction": True,
        "no_history's state error, of that of mik+a with self-prediction": True,
        "ah+a's state error, of no_history's": False,
    }
    bound = next(claim for claim in claims("first_person") if claim.text == "state error of mik+a")
    assert bound.raw() == bound, "15% is no number of raw units"
    assert not any("self-prediction" in claim.text for claim in claims("no_curtain"))


def test_the_page_says_which_statements_hold_and_what_the_paper_has(runs, tmp_path):
    page = write_report([runs], tmp_path / "out").read_text()
    rows = {line.split(" | ")[1]: line for line in page.splitlines() if line.startswith("| three_curtains | ")}
    assert rows["no_history's velocity error, of mik+a's >= 3 x"].endswith(
        "| 81.0 / 21.0 | **yes** | 3 of 3 | 121.5 / 31.5 | **yes** | 91.9 / 5.7: yes |"
    )
    assert rows["ah+a's position error, of the untrained one's < 0.5 x"].endswith("| **no** | none |")
    assert rows["K=1: ah+a's action loss is near zero <= 5"].endswith("| no error | - | none |")
    assert rows["K=1: mik+a's state error with the literal future, of the default's >= 2 x"].endswith(
        "| no run yet | - | - | - | - | none |"
    )
    answers = [sum(f"| **{word}** |" in row for row in rows.values()) for word in ("yes", "no")]
    waiting = page.count("| no run yet |")
    assert f"{answers[0]} of {sum(answers)} hold, {waiting} wait for runs." in page
    assert f"Of {sum(answers) - 2} that are judged in both units, none changes." in page
    beside = [row.split(" | ")[6] for row in rows.values() if not row.endswith(" none |") and "no run" not in row]
    assert f"paper prints numbers, {beside.count('**yes**')} of {len(beside)} hold." in page
    assert "Budget: 2,500 gradient steps on 100,000 samples, 5 minutes a run (some, 2 cores)." in page
    headings = [line for line in page.splitlines() if line.startswith("## ")]
    assert len(headings) == len(set(headings))


def test_what_raw_units_change_is_said(runs, tmp_path):
    """In raw units no_history's errors shrink to a tenth: the statement about its velocity holds no more."""
    for seed in range(3):
        results = runs / "three_curtains" / "no_history-K15" / f"seed{seed}" / "results.json"
        stored = json.loads(results.read_text())
        for row in stored["rows"]:
            row["value"] *= 0.1 if row["measure"].startswith(RAW_PREFIX) else 1
        results.write_text(json.dumps(stored))
    page = write_report([runs], tmp_path / "out").read_text()
    assert "1 change (three_curtains: no_history's velocity error, of mik+a's)." in page


def test_runs_without_raw_numbers_say_so_and_stand_beside_no_number_of_the_paper(tmp_path):
    for method in ("mik+a", "no_history"):
        write_run(tmp_path / "runs", Condition("hard_three_curtains", method), 0, 9.0, raw=False)
    page = write_report([tmp_path / "runs"], tmp_path / "out").read_text()
    assert "What holds in raw units is not known: the runs kept neither raw numbers nor deviations." in page
    assert "raw units x 100, beside the paper*: no run yet." in page
    assert "`hard_` mazes are variants of the paper's" in page
    assert not (tmp_path / "out" / "figures" / "accuracy_raw.png").exists()
    assert "--maze hard_three_curtains --out data/hard_three_curtains" in page
    for line in page.splitlines():
        assert not (line.startswith("| MIK+A") and "(6.0)" in line)


def test_the_papers_marks_stand_beside_raw_units_alone(runs, tmp_path, monkeypatch):
    def marks(measure: Measure) -> int:
        drawn = []
        monkeypatch.setattr("matplotlib.axes.Axes.plot", lambda axes, *at, **style: drawn.append(style.get("marker")))
        figures.accuracy_bars(loaded(runs), measure, tmp_path / "bars.png")
        return drawn.count("_")

    assert marks(STATE) == 0
    assert marks(STATE.raw()) == 19, "the paper has seven objectives, five at K = 1 too, seven with self-prediction"


def test_the_bar_plot_has_the_papers_variants(runs, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(figures, "_bar", lambda axes, place, condition, *rest: drawn.append(condition))
    figures.accuracy_bars(loaded(runs), STATE, tmp_path / "bars.png")
    paper = {condition_of(line, "three_curtains") for line in paper_rows() if line["exogenous"] == "N"}
    assert paper < set(drawn)


def test_every_reference_has_a_place_and_a_cross_where_it_has_no_run(runs, tmp_path, monkeypatch):
    crosses = []

    def note(axes, at, *rest, **style):
        if style.get("marker") == "x" and at != []:
            crosses.append(at)

    monkeypatch.setattr("matplotlib.axes.Axes.plot", note)
    figures.accuracy_bars(loaded(runs), STATE, tmp_path / "bars.png")
    places = [*OBJECTIVES, *REFERENCES]
    assert {at for at in crosses if at > len(OBJECTIVES) - 0.5} == {places.index(name) for name in REFERENCES[1:]}


def test_a_bar_below_zero_is_in_the_picture(tmp_path, monkeypatch):
    """An error of more than 100 is drawn as an accuracy below zero, not as nothing."""
    limits = []
    monkeypatch.setattr("matplotlib.axes.Axes.set_ylim", lambda axes, *ends, **_: limits.append(ends))
    for level in (5.0, 121.0):
        write_run(tmp_path / f"{level}", Condition("three_curtains", "no_history"), 0, level)
        figures.accuracy_bars(loaded(tmp_path / f"{level}"), STATE, tmp_path / "bars.png")
    chosen = [low for low, high in (ends for ends in limits if len(ends) == 2) if high == 100]
    assert chosen[0] == 0
    assert chosen[-1] < -20


def test_the_bar_plot_has_the_mazes_with_numbers_in_its_units(runs, tmp_path, monkeypatch):
    write_run(runs, Condition("hard_no_curtain", "mik+a"), 0, 5.0, raw=False)
    drawn = set()
    monkeypatch.setattr(figures, "_bar", lambda axes, place, condition, *rest: drawn.add(condition.maze))
    figures.accuracy_bars(loaded(runs), STATE, tmp_path / "bars.png")
    assert drawn == {"three_curtains", "hard_no_curtain"}
    drawn.clear()
    figures.accuracy_bars(loaded(runs), STATE.raw(), tmp_path / "bars.png")
    assert drawn == {"three_curtains"}


def test_which_way_round_a_relation_is():
    claim = next(c for c in claims("no_curtain") if c.text.startswith("no_history's velocity"))
    assert claim.holds(90.0, 30.0)
    assert not claim.holds(89.0, 30.0)


def test_free_cells_are_the_librarys():
    from gymnasium_robotics.envs.maze.maps import U_MAZE

    library = {(i, j) for i, row in enumerate(U_MAZE) for j, kind in enumerate(row) if kind != 1}
    assert set(FREE_CELLS) == library


def test_what_cannot_be_reported_is_named(runs, tmp_path):
    (tmp_path / "empty").mkdir()
    for source, message in (("nowhere", "no such folder"), ("empty", "contains no runs")):
        with pytest.raises(UserError, match=message):
            write_report([tmp_path / source], tmp_path / "out")
    write_run(tmp_path / "other", Condition("three_curtains", "mik"), 0, 99.0)
    with pytest.raises(UserError, match="two runs of one method, setting and seed"):
        write_report([runs, tmp_path / "other"], tmp_path / "out")
    config = next((tmp_path / "other").rglob("config.json"))
    record = json.loads(config.read_text())
    record["config"]["batch_size"] = 7
    config.write_text(json.dumps(record))
    with pytest.raises(UserError, match="three_curtains/mik-K15 seed 0 is there twice; keep one"):
        write_report([runs, tmp_path / "other"], tmp_path / "out")
    record["config"] |= {"preset": "paper", "seed": 7}
    config.write_text(json.dumps(record))
    with pytest.raises(UserError, match="different presets"):
        write_report([runs, tmp_path / "other"], tmp_path / "out")


def test_sample_observations_are_drawn_where_they_are_asked_for(runs, tmp_path):
    rng = np.random.default_rng(0)
    samples = {name: rng.integers(0, 256, (2, 3, 9, 9), np.uint8) for name in ("a maze", "with noise, dark")}
    shown = "![Sample observations](figures/observations.png)"
    assert shown not in write_report([runs], tmp_path / "out").read_text()
    assert not (tmp_path / "out" / "figures" / "observations.png").exists()
    assert shown in write_report([runs], tmp_path / "out", lambda: samples).read_text()
    with Image.open(tmp_path / "out" / "figures" / "observations.png") as picture:
        assert len(np.unique(np.asarray(picture).reshape(-1, 4), axis=0)) > 4 * 81


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["collect", "--maze", "spiral", "--out", "x"], "unknown maze 'spiral'"),
        (["collect", "--out", "x"], "--maze"),
        (["train", "--data", "nowhere", "--out", "x"], "nowhere: no such folder"),
        (["train", "--preset", "huge"], "unknown preset 'huge'"),
        (["report", "nowhere"], "nowhere: no such folder"),
    ],
)
def test_slips_are_one_line_and_exit_code_2(words, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(["navigation", *words])
    assert end.value.code == 2
    error = capsys.readouterr().err.strip()
    assert len(error.splitlines()) == 1
    assert message in error
    assert not list(tmp_path.iterdir())


def test_runs_are_frozen_values():
    assert replace(Condition("no_curtain", "ah"), max_k=1).name == "no_curtain/ah-K1"


def test_a_method_that_knows_no_k_is_one_of_k_1(tmp_path):
    folder = write_run(tmp_path, Condition("no_curtain", "ah"), 0, 5.0)
    record = json.loads((folder / "config.json").read_text())
    del record["config"]["max_k"]
    record["config"]["method"] = "one_step_inverse"
    (folder / "config.json").write_text(json.dumps(record))
    (run,) = load_runs(find_navigation([tmp_path]))
    assert run.condition == Condition("no_curtain", "one_step_inverse", max_k=1)
    assert "one_step_inverse" in write_report([tmp_path], tmp_path / "report").read_text()

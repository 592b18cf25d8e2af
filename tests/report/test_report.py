import csv
import hashlib
import json
import os
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vd4rl_pomdp.cli import main
from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.evaluation import append_episodes, drop_episodes_after, read_episodes
from vd4rl_pomdp.report import stats, write_report
from vd4rl_pomdp.report.gaps import find_gaps
from vd4rl_pomdp.report.load import load_runs
from vd4rl_pomdp.report.tables import label
from vd4rl_pomdp.runs.files import read_json, write_json


def write_run(
    folder: Path,
    method: str,
    seed: int,
    scores: dict[int, list[float]],
    film: bool = False,
    labels: dict[str, Any] | None = None,
) -> Path:
    """A fine-tuning run with the given scores of its episodes by step."""
    folder.mkdir(parents=True)
    record = {
        "stage": "finetune",
        "config": {"seed": seed},
        "versions": {},
        "git_commit": "abc",
        "command": "vd4rl-pomdp",
    }
    (folder / "config.json").write_text(json.dumps(record))
    (folder / "metrics.jsonl").write_text('{"step": 10, "bc_loss": 0.5}\n')
    names = {"method": method, "task": "walker_walk", "quality": "expert", "corruption": "patch"}
    names |= {"algorithm": "td3_bc", "seed": seed} | (labels or {})
    write_json(folder / "labels.json", names)
    for step, values in scores.items():
        rows = [
            names
            | {"step": step, "episode": i, "episode_seed": i}
            | {"return": value * 10, "length": 500, "score": value}
            for i, value in enumerate(values)
        ]
        append_episodes(folder / "episodes.csv", rows)
    (folder / "timing.json").write_text('{"seconds": 3.0}')
    if film:
        pictures = np.random.default_rng(0).integers(0, 256, (4, 12, 84, 84), dtype=np.uint8)
        np.savez(
            folder / "film.npz", **{"clean": pictures[:, :3], "corrupted": pictures[:, 3:], "return": np.arange(4.0)}
        )
    return folder


def test_iqm_drops_the_outer_quarters():
    assert stats.iqm(np.array([0.0, 1.0, 2.0, 100.0])) == pytest.approx(1.5)
    # five runs: the middle 2.5 are 0.75 of the 2nd, the 3rd, 0.75 of the 4th
    assert stats.iqm(np.array([10.0, 1.0, 2.0, 3.0, -50.0])) == pytest.approx((0.75 * 1 + 2 + 0.75 * 3) / 2.5)
    assert stats.iqm(np.array([-50.0, 1.0, 2.0, 9.0, 10.0])) == pytest.approx((0.75 * 1 + 2 + 0.75 * 9) / 2.5)
    assert stats.iqm(np.array([[1.0], [2.0]])).tolist() == [1.0, 2.0]


def test_other_statistics_on_known_values():
    assert stats.optimality_gap(np.array([50.0, 150.0])) == pytest.approx(25.0)
    assert stats.probability_of_improvement(np.array([1.0, 2.0]), np.array([1.0, 0.0])) == pytest.approx(0.875)
    assert stats.performance_profile(np.array([1.0, 3.0]), np.array([0.0, 2.0, 4.0])).tolist() == [1.0, 0.5, 0.0]


def test_the_bootstrap_covers_a_known_mean_and_keeps_tasks_apart():
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(200):
        low, high = stats.bootstrap_interval([rng.normal(5, 1, 30)], stats.mean, rng, 500)
        hits += low <= 5 <= high
    assert 0.88 <= hits / 200 <= 0.99
    # tasks far apart, no spread within: drawing across tasks would give an interval, drawing within gives none
    low, high = stats.bootstrap_interval([np.full(4, 0.0), np.full(4, 100.0)], stats.mean, rng, 500)
    assert low == high == 50.0
    assert stats.bootstrap_interval([np.array([1.0])], stats.mean, rng) is None


def test_the_bootstrap_of_a_mean_is_as_wide_as_its_standard_error():
    scores = np.arange(100) % 2.0  # a standard deviation of a half
    low, high = stats.bootstrap_interval([scores], stats.mean, np.random.default_rng(0))
    assert (low, high) == pytest.approx((0.5 - 1.96 * 0.05, 0.5 + 1.96 * 0.05), abs=0.006)


def test_a_report_counts_seeds_not_episodes(tmp_path):
    for seed, scores in enumerate([[10.0, 30.0], [40.0, 40.0]]):
        write_run(tmp_path / f"runs/acro/{seed}", "acro", seed, {5: [90.0, 90.0], 10: scores}, film=seed == 0)
    write_run(tmp_path / "runs/random/0", "random", 0, {10: [95.0]})
    page, summary = write_report([tmp_path / "runs"], tmp_path / "out")
    assert [row["method"] for row in summary] == ["acro", "random"], "references come last, whatever their score"
    acro = summary[0]
    assert acro["score"] == pytest.approx(30.0)
    assert (acro["seeds"], acro["episodes"], acro["best_step"]) == (2, 4, 5)
    assert (acro["low"], acro["high"]) == (20.0, 40.0)
    assert summary[1]["low"] is None
    with (tmp_path / "out" / "episodes.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 9
    text = page.read_text()
    assert "data:image/webp;base64" in text
    assert "30.0" in text
    assert not re.search(r'(src|href)="?(https?:)?//', text), "the page must not need a network"


def test_references_with_their_own_algorithm_stand_in_the_same_table(tmp_path):
    write_run(tmp_path / "runs/acro", "acro", 0, {10: [50.0]})
    end_to_end = write_run(tmp_path / "runs/bc", "bc", 0, {10: [20.0]})
    rows = (end_to_end / "episodes.csv").read_text()
    (end_to_end / "episodes.csv").write_text(rows.replace("td3_bc", "bc"))
    (end_to_end / "probe.json").write_text('{"probe_pose": 12.5, "probe_velocity": 34.5}')
    (end_to_end / "pretrain_timing.json").write_text('{"seconds": 7.0}')
    page, _ = write_report([tmp_path / "runs"], tmp_path / "out")
    text = page.read_text()
    assert text.count("<h3>walker_walk expert, patch</h3>") == 1
    with (tmp_path / "out" / "runs.csv").open() as file:
        acro, bc = csv.DictReader(file)
    assert (acro["method"], acro["return"], acro["probe_pose"]) == ("acro", "500.0", "")
    assert (bc["method"], bc["probe_pose"], bc["probe_velocity"]) == ("bc", "12.5", "34.5")
    assert (bc["pretrain_seconds"], bc["finetune_seconds"]) == ("7.0", "3.0")
    with (tmp_path / "out" / "improvement.csv").open() as file:
        chances = {(row["method"], row["other"]): float(row["probability"]) for row in csv.DictReader(file)}
    assert chances == {("acro", "bc"): 1.0, ("bc", "acro"): 0.0}


def test_bad_input_is_one_line(tmp_path):
    with pytest.raises(UserError, match="no such folder"):
        write_report([tmp_path / "nowhere"], tmp_path / "out")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="contains no runs"):
        write_report([tmp_path / "empty"], tmp_path / "out")
    write_run(tmp_path / "a", "acro", 0, {10: [1.0]})
    write_run(tmp_path / "b", "acro", 0, {10: [2.0]})
    with pytest.raises(UserError, match="two runs of one method"):
        write_report([tmp_path / "a", tmp_path / "b"], tmp_path / "out")
    (tmp_path / "a" / "metrics.jsonl").write_text("{\n")
    with pytest.raises(UserError, match="a line is not JSON of numbers"):
        write_report([tmp_path / "a"], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_cut_rows_and_films_are_named(tmp_path):
    write_run(tmp_path / "a", "acro", 0, {10: [1.0]})
    rows = tmp_path / "a" / "episodes.csv"
    whole = rows.read_text()
    rows.write_text(whole + "acro,walker_w")
    with pytest.raises(UserError, match=r"episodes\.csv: a row is not whole"):
        write_report([tmp_path / "a"], tmp_path / "out")
    rows.write_text(whole)
    (tmp_path / "a" / "film.npz").write_bytes(b"cut")
    with pytest.raises(UserError, match=r"film\.npz: cannot be read"):
        write_report([tmp_path / "a"], tmp_path / "out")


def describe(run: Path, card: dict[str, Any] | None = None, data: str = "", **config: Any) -> Path:
    """Give a run of `write_run` settings: its own config, its encoder's card, and the fingerprint of its data."""
    record = read_json(run / "config.json")
    record["config"] |= {"updates": 10, "preset": "cpu", "batch_size": 256, "views": 4} | config
    write_json(run / "config.json", record | ({"inputs": {"data": data}} if data else {}))
    if card is not None:
        settings = {"max_k": 15, "batch_size": 8, "patch_size": 16, "preset": "cpu", "steps": 20, "task": "walker_walk"}
        settings |= {k: v for k, v in card.items() if k not in ("data",)}
        corruption = {"corruption": "patch", "patch_size": settings["patch_size"]}
        facts = {"corruption": corruption, "steps": settings["steps"], "preset": settings["preset"]}
        (run / "encoder").mkdir()
        write_json(
            run / "encoder" / "config.json", {"pretrain": facts | {"settings": settings, "data": card.get("data", "")}}
        )
    return run


def pooled(folder: Path) -> dict[str, int]:
    """Seeds by the label under which a folder's runs are pooled."""
    return dict(Counter(label(row) for run in load_runs([folder]) for row in run.rows))


def test_runs_pool_whatever_their_seed_folder_device_and_logging(tmp_path):
    for seed in (0, 1):
        run = write_run(tmp_path / f"runs/{seed}", "acro", seed, {10: [1.0]})
        noise = {"out": str(run), "encoder": str(seed), "device": str(seed), "log_every": seed, "workers": seed}
        describe(run, {"seed": seed} if seed > 5 else {}, data="f00", **noise)
    assert pooled(tmp_path / "runs") == {"acro": 2}


@pytest.mark.parametrize(
    ("one", "other", "names"),
    [
        ({"card": {"patch_size": 16}}, {"card": {"patch_size": 48}}, ["acro, patch_size 16", "acro, patch_size 48"]),
        ({"card": {"steps": 20}}, {"card": {"steps": 60}}, ["acro, steps 20", "acro, steps 60"]),
        ({"card": {}, "updates": 5}, {"card": {}, "updates": 9}, ["acro, updates 5", "acro, updates 9"]),
        (
            {"card": {"batch_size": 8}},
            {"card": {"batch_size": 16}},
            ["acro, pretraining batch_size 8", "acro, pretraining batch_size 16"],
        ),
        (
            {"card": {"data": "a" * 24}, "data": "a" * 24},
            {"card": {"data": "b" * 24}, "data": "b" * 24},
            ["acro, data aaaaaaaa", "acro, data bbbbbbbb"],
        ),
        (
            {"card": {"data": "a" * 24}, "data": "a" * 24},
            {"card": {"data": "b" * 24}, "data": "a" * 24},
            ["acro, pretraining data the same", "acro, pretraining data bbbbbbbb"],
        ),
        ({"card": {}}, {"card": {}, "data": "f00"}, ["acro, data not recorded", "acro, data f00"]),
        ({"card": {}, "views": 4}, {"card": {}, "views": None}, ["acro, views 4", "acro, views none"]),
        ({"card": {"m": 8}}, {"card": {}}, ["acro, m 8", "acro, m unset"]),
        ({"card": {}}, {}, ["acro", "acro, pretraining not recorded"]),
        (
            {"card": {"preset": "cpu", "steps": 20}, "preset": "cpu", "views": 4},
            {"card": {"preset": "smoke", "steps": 60}, "preset": "smoke", "views": 1},
            ["acro, preset cpu", "acro, preset smoke"],
        ),
    ],
    ids=["patch", "steps", "updates", "same name", "data", "data before", "old", "none", "new", "no card", "preset"],
)
def test_runs_that_differ_are_rows_of_their_own(tmp_path, one, other, names):
    for seed in (0, 1):
        for folder, settings in (("one", one), ("other", other)):
            describe(write_run(tmp_path / f"runs/{folder}{seed}", "acro", seed, {10: [1.0]}), **settings)
    write_run(tmp_path / "runs/random", "random", 0, {10: [1.0]})
    assert pooled(tmp_path / "runs") == dict.fromkeys(names, 2) | {"random": 1}


def test_an_ablation_is_two_rows_everywhere(tmp_path):
    for k in (1, 15):
        describe(write_run(tmp_path / f"runs/{k}", "mik+a", 0, {5: [k], 10: [k]}, film=True), {"max_k": k})
    page, summary = write_report([tmp_path / "runs"], tmp_path / "out")
    assert {row["variant"]: row["score"] for row in summary} == {"max_k 15": 15.0, "max_k 1": 1.0}
    text = page.read_text()
    for name in ("mik+a, max_k 1", "mik+a, max_k 15"):
        assert f"<td>{name}</td>" in text
        assert f"<h3>finetune {name}, walker_walk expert, patch, seed 0</h3>" in text
    for name in ("summary", "curves", "aggregate", "runs", "episodes"):
        with (tmp_path / "out" / f"{name}.csv").open() as file:
            assert {row["variant"] for row in csv.DictReader(file)} == {"max_k 1", "max_k 15"}
    describe(write_run(tmp_path / "runs/twin", "mik+a", 0, {10: [3.0]}), {"max_k": 1})
    with pytest.raises(UserError, match="two runs of one method, setting and seed"):
        write_report([tmp_path / "runs"], tmp_path / "out")


def test_a_preset_stands_for_what_it_decides_and_the_page_says_all(tmp_path):
    for preset, k in (("cpu", 15), ("cpu", 1), ("smoke", 3)):
        run = write_run(tmp_path / f"runs/{preset}{k}", "acro", 0, {10: [1.0]})
        describe(run, {"max_k": k, "preset": preset, "steps": len(preset)}, preset=preset)
    labels = {"acro, preset cpu, max_k 15", "acro, preset cpu, max_k 1", "acro, preset smoke, max_k 3"}
    assert set(pooled(tmp_path / "runs")) == labels
    page = write_report([tmp_path / "runs"], tmp_path / "out")[0].read_text()
    assert "<td>preset smoke, steps 5, pretraining preset smoke, max_k 3</td>" in page


def grid(tmp_path: Path) -> Path:
    """Three seeds of acro and two of mik+a on expert data, one of acro on medium data."""
    for method, seeds in (("acro", (0, 1, 2)), ("mik+a", (0, 1))):
        for seed in seeds:
            describe(write_run(tmp_path / f"runs/{method}{seed}", method, seed, {5: [1.0], 10: [20.0 + seed]}), {})
    describe(write_run(tmp_path / "runs/medium", "acro", 0, {10: [9.0]}, labels={"quality": "medium"}), {})
    return tmp_path / "runs"


def test_missing_cells_and_seeds_are_shown_as_missing(tmp_path):
    page, summary = write_report([grid(tmp_path)], tmp_path / "out")
    found = {(row["quality"], row["method"]): (row["score"], row["missing"]) for row in summary}
    assert found == {
        ("expert", "acro"): (21.0, ""),
        ("expert", "mik+a"): (20.5, "seed 2 missing"),
        ("medium", "acro"): (9.0, ""),
        ("medium", "mik+a"): (None, "seed 0 missing"),
    }
    text = page.read_text()
    assert '<tr class="gap"><td>mik+a</td><td colspan="6">seed 0 missing</td></tr>' in text
    assert '<span class="gap">seed 2 missing</span>' in text
    for legend in ("mik+a (seed 2 missing)", "mik+a (seed 0 missing)", "mik+a (1 of 2 tasks)"):
        assert f"<!-- {legend} -->" in text, "a figure's legend says it, too"
    with (tmp_path / "out" / "missing.csv").open() as file:
        assert [(row["quality"], row["seed"], row["state"]) for row in csv.DictReader(file)] == [
            ("expert", "2", "missing"),
            ("medium", "0", "missing"),
        ]
    with (tmp_path / "out" / "runs.csv").open() as file:
        states = {(r["quality"], r["method"], r["seed"]): r["state"] for r in csv.DictReader(file)}
    assert len(states) == 8
    assert {setting for setting, state in states.items() if state == "missing"} == {
        ("expert", "mik+a", "2"),
        ("medium", "mik+a", "0"),
    }


def test_an_ablation_is_missing_elsewhere_but_a_budget_for_every_task_is_not(tmp_path):
    runs = tmp_path / "runs"
    for k in (1, 15):
        describe(write_run(runs / f"expert{k}", "mik+a", 0, {10: [1.0]}), {"max_k": k})
    describe(write_run(runs / "medium", "mik+a", 0, {10: [1.0]}, labels={"quality": "medium"}), {"max_k": 15})
    for quality, steps in (("expert", 20), ("medium", 60)):
        run = write_run(runs / f"{quality}-acro", "acro", 0, {10: [1.0]}, labels={"quality": quality})
        describe(run, {"steps": steps})
    describe(write_run(runs / "none", "random", 0, {10: [1.0]}, labels={"corruption": "none"}), {"steps": 20})
    for size in (16, 48):
        run = write_run(runs / f"patch{size}", "random", 0, {10: [1.0]})
        describe(run, {"patch_size": size}, data=f"f{size}")
    names = ("quality", "corruption", "method", "variant")
    assert {tuple(row[name] for name in names) for row in find_gaps(load_runs([runs]))} == {
        ("medium", "patch", "mik+a", "max_k 1"),
        ("medium", "patch", "random", "patch_size 16"),
        ("medium", "patch", "random", "patch_size 48"),
        ("expert", "none", "mik+a", "max_k 1"),
        ("expert", "none", "mik+a", "max_k 15"),
        ("expert", "none", "acro", "steps 20"),
        ("expert", "none", "acro", "steps 60"),
    }


def test_unfinished_runs_are_named_and_kept_out_of_final_scores(tmp_path):
    runs = grid(tmp_path)
    cut = runs / "acro2"
    (cut / "timing.json").unlink()
    rows = [line for line in (cut / "episodes.csv").read_text().splitlines() if ",10,0," not in line]
    (cut / "episodes.csv").write_text("\n".join(rows) + "\n")
    (cut / "metrics.jsonl").write_text('{"step": 7, "bc_loss": 0.5}\n')
    begun = describe(write_run(runs / "begun", "mik+a", 2, {}), {})
    (begun / "timing.json").unlink()
    (begun / "metrics.jsonl").unlink()
    page, summary = write_report([runs], tmp_path / "out")
    found = {(row["quality"], row["method"]): (row["score"], row["seeds"], row["missing"]) for row in summary}
    assert found["expert", "acro"] == (20.5, 2, "seed 2 unfinished at 7 of 10 updates")
    assert found["expert", "mik+a"] == (20.5, 2, "seed 2 unfinished at 0 of 10 updates")
    text = page.read_text()
    assert "6 finished runs" not in text
    assert "5 finished runs, 2 unfinished" in text
    for folder in (cut, begun):
        assert f"<td>{folder}</td>" in text
    with (tmp_path / "out" / "curves.csv").open() as file:
        seeds = {(r["quality"], r["method"], r["step"]): r["seeds"] for r in csv.DictReader(file)}
    assert (seeds["expert", "acro", "5"], seeds["expert", "acro", "10"]) == ("3", "2"), "curves show what there is"


def test_a_report_of_unfinished_runs_alone_says_so(tmp_path):
    (describe(write_run(tmp_path / "runs/a", "acro", 0, {5: [1.0]}), {}) / "timing.json").unlink()
    page, summary = write_report([tmp_path / "runs"], tmp_path / "out")
    assert [(row["score"], row["missing"]) for row in summary] == [(None, "seed 0 unfinished at 10 of 10 updates")]
    assert "0 finished runs, 1 unfinished" in page.read_text()


@pytest.mark.parametrize("value", ["nan", "inf", "-inf"])
@pytest.mark.parametrize("column", ["score", "return"])
def test_a_score_that_is_no_number_is_refused(tmp_path, value, column):
    run = write_run(tmp_path / "runs/a", "acro", 3, {10: [1.0, 2.0]})
    rows = read_episodes(run / "episodes.csv")
    (run / "episodes.csv").unlink()
    append_episodes(run / "episodes.csv", [rows[0], rows[1] | {column: value}])
    with pytest.raises(UserError, match=rf"episodes\.csv: .*{value}"):
        write_report([tmp_path / "runs"], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_report_writes_over_nothing_but_an_earlier_report(tmp_path, capsys):
    for seed in (0, 1):
        write_run(tmp_path / f"runs/{seed}", "acro", seed, {10: [25.0]})
    write_run(tmp_path / "runs/random", "random", 0, {10: [1.0]})
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "index.html").write_text("mine")
    for out in ("runs", "runs/0", "runs/0/report", "notes"):
        before = {p: hashlib.sha256(p.read_bytes()).digest() for p in tmp_path.rglob("*") if p.is_file()}
        with pytest.raises(SystemExit) as end:
            main(["report", str(tmp_path / "runs"), "--out", str(tmp_path / out)])
        assert end.value.code == 2
        assert "choose another --out" in capsys.readouterr().err
        assert {p: hashlib.sha256(p.read_bytes()).digest() for p in tmp_path.rglob("*") if p.is_file()} == before
    write_report([tmp_path / "runs"], tmp_path / "out")
    first = {p.name for p in (tmp_path / "out").iterdir()}
    write_report([tmp_path / "runs" / "0"], tmp_path / "out")
    again = {p.name for p in (tmp_path / "out").iterdir()}
    assert first - again == {"improvement.csv", "missing.csv"}, "no table of the earlier report is left"
    write_report([tmp_path / "runs"], tmp_path / "runs" / "report")
    assert len(write_report([tmp_path / "runs"], tmp_path / "runs" / "report")[1]) == 2


HOSTILE = '$\\frac$ <b>=1+1</b>, "x"|`y`\n[/red]_\u2028μ'


def test_a_methods_name_is_text_and_nothing_else(tmp_path, capsys):
    assert "\n" in HOSTILE
    write_run(tmp_path / "runs/a", HOSTILE, 0, {5: [1.0], 10: [2.0]}, film=True, labels={"quality": "_$x_$"})
    pretrain = tmp_path / "runs" / "pretrain"
    pretrain.mkdir()
    write_json(pretrain / "config.json", {"stage": "pretrain", "config": {"method": HOSTILE, "seed": 0}})
    (pretrain / "metrics.jsonl").write_text('{"step": 1, "action_loss": 0.5}\n{"step": 2, "action_loss": 0.4}\n')
    main(["report", str(tmp_path / "runs"), "--out", str(tmp_path / "out")])
    assert "<b>=1+1" in capsys.readouterr().out.replace("\n", "")
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert "<b>" not in page
    assert "&lt;b&gt;=1+1&lt;/b&gt;" in page
    for name in ("summary", "episodes", "runs", "curves"):
        with (tmp_path / "out" / f"{name}.csv").open(newline="", encoding="utf-8") as file:
            assert {row["method"] for row in csv.DictReader(file)} == {HOSTILE}
    rows = read_episodes(tmp_path / "runs" / "a" / "episodes.csv")
    drop_episodes_after(tmp_path / "runs" / "a" / "episodes.csv", 5)
    assert read_episodes(tmp_path / "runs" / "a" / "episodes.csv") == rows[:1]


def test_a_machine_that_does_not_speak_utf8_ends_no_command(tmp_path):
    write_run(tmp_path / "runs/a", "μ", 0, {10: [2.0]})
    words = [sys.executable, "-m", "vd4rl_pomdp.cli", "report", str(tmp_path / "runs"), "--out", str(tmp_path / "out")]
    ascii_only = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0", "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(words, capture_output=True, env=os.environ | ascii_only)
    assert (done.returncode, b"\\u03bc" in done.stdout) == (0, True), done.stderr
    for name in ("index.html", "summary.csv", "episodes.csv"):
        assert "μ" in (tmp_path / "out" / name).read_text(encoding="utf-8")


def test_labels_and_cards_that_are_not_whole_are_named(tmp_path):
    run = describe(write_run(tmp_path / "runs/a", "acro", 0, {10: [2.0]}), {})
    (tmp_path / "runs" / "b").mkdir()
    for name in ("config.json", "metrics.jsonl"):
        (tmp_path / "runs" / "b" / name).write_bytes((run / name).read_bytes())
    (tmp_path / "runs" / "b" / "labels.json").write_text("{}")
    with pytest.raises(UserError, match=r"b/labels\.json: has no 'task'"):
        write_report([tmp_path / "runs"], tmp_path / "out")
    (run / "encoder" / "config.json").write_text("{}")
    with pytest.raises(UserError, match="does not say how the encoder was pretrained"):
        write_report([run], tmp_path / "out")
    (run / "encoder" / "config.json").write_text('{"pretrain": {"corruption": ["patch"]}}')
    with pytest.raises(UserError, match=r"a: its files are damaged"):
        write_report([run], tmp_path / "out")

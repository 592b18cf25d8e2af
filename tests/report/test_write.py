"""What a report's page and tables say."""

import csv
import hashlib
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers_report import describe, grid, pretraining, write_run
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.data.reference import Reference
from vd4rl_pomdp.report import write, write_report
from vd4rl_pomdp.runs.episodes import append_episodes, drop_episodes_after, read_episodes
from vd4rl_pomdp.runs.files import write_json
from vd4rl_pomdp.runs.results import add_results

ROOT = Path(__file__).parents[2]


def test_a_report_counts_seeds_not_episodes(tmp_path):
    for seed, scores in enumerate([[10.0, 30.0], [40.0, 40.0]]):
        write_run(tmp_path / f"runs/acro/{seed}", "acro", seed, {5: [90.0, 90.0], 10: scores}, film=seed == 0)
    write_run(tmp_path / "runs/random/0", "random", 0, {10: [95.0]})
    page, summary, *_ = write_report([tmp_path / "runs"], tmp_path / "out")
    assert [row["method"] for row in summary] == ["acro", "random"], "references come last, whatever their score"
    acro = summary[0]
    assert acro["score"] == pytest.approx(30.0)
    assert (acro["seeds"], acro["episodes"], acro["best_step"]) == (2, 4, 5)
    assert acro["low"] < 20 < 40 < acro["high"], "two seeds, at 20 and 40, tell little"
    assert summary[1]["low"] is None
    with (tmp_path / "out" / "episodes.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 9
    text = page.read_text()
    assert "data:image/webp;base64" in text
    assert "30.0" in text
    assert not re.search(r'(src|href)="?(https?:)?//', text), "the page must not need a network"


def test_the_report_of_mazes_is_named_where_there_are_only_mazes(tmp_path):
    with pytest.raises(
        UserError, match=r"holds no evaluated run yet; `vd4rl-pomdp navigation report` reports its mazes"
    ):
        write_report([ROOT / "results" / "navigation"], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_references_with_their_own_algorithm_stand_in_the_same_table(tmp_path):
    write_run(tmp_path / "runs/acro", "acro", 0, {10: [50.0]})
    end_to_end = write_run(tmp_path / "runs/bc", "bc", 0, {10: [20.0]})
    rows = (end_to_end / "episodes.csv").read_text()
    (end_to_end / "episodes.csv").write_text(rows.replace("td3_bc", "bc"))
    (end_to_end / "probe.json").write_text('{"probe_pose": 12.5, "probe_velocity": 34.5}')
    (end_to_end / "pretrain_timing.json").write_text('{"seconds": 7.0}')
    page, *_ = write_report([tmp_path / "runs"], tmp_path / "out")
    text = page.read_text()
    assert text.count("<h3>walker_walk expert, patch</h3>") == 2, "one table of scores, one of encoders"
    with (tmp_path / "out" / "runs.csv").open() as file:
        acro, bc = csv.DictReader(file)
    assert (acro["method"], acro["return"], acro["probe_pose"]) == ("acro", "500.0", "")
    assert (bc["method"], bc["probe_pose"], bc["probe_velocity"]) == ("bc", "12.5", "34.5")
    assert (bc["pretrain_seconds"], bc["finetune_seconds"]) == ("7.0", "3.0")
    with (tmp_path / "out" / "improvement.csv").open() as file:
        found = {(row["method"], row["other"]): (row["probability"], row["wins"]) for row in csv.DictReader(file)}
    assert found == {("acro", "bc"): ("", "1.0"), ("bc", "acro"): ("", "0.0")}, "one pair of runs tells no probability"
    assert '<td class="n">1 of 1</td>' in text
    assert "1.00" not in text.partition("Probability of improvement</h2>")[2].partition("</table>")[0]


def evaluated_clean(run: Path, returns: list[float], errors: tuple[float, float]) -> None:
    """Give a run's last evaluation, whose action errors become the first of two, one under none with the second."""
    rows = [row for row in read_episodes(run / "episodes.csv") if row["step"] == 10]
    (run / "episodes.csv").unlink()
    append_episodes(run / "episodes.csv", [row | {"action_error": errors[0]} for row in rows])
    clean = {"evaluated_under": "none", "action_error": errors[1]}
    append_episodes(run / "episodes.csv", [rows[0] | clean | {"return": r, "score": r / 10} for r in returns])


def test_scores_are_as_trained_and_the_control_table_tells_of_both(tmp_path):
    for seed, score in enumerate((30.0, 50.0)):
        run = write_run(tmp_path / f"runs/{seed}", "acro", seed, {10: [score, 90.0]})
        Reference(500.0, None, 0.01 * (seed + 1)).write(run)
        evaluated_clean(run, [401.0, 399.0, 900.0], (0.1, 0.2))
    write_run(tmp_path / "runs/earlier", "mik", 0, {10: [70.0]})
    page, summary, *_ = write_report([tmp_path / "runs"], tmp_path / "out")
    assert {row["method"]: (row["score"], row["episodes"]) for row in summary} == {"acro": (65.0, 4), "mik": (70.0, 1)}
    tables = {}
    for name in ("control", "runs", "curves", "episodes"):
        with (tmp_path / "out" / f"{name}.csv").open() as file:
            tables[name] = list(csv.DictReader(file))
    assert [row["score"] for row in tables["runs"] if row["method"] == "acro"] == ["70.0", "60.0"]
    assert [row["score"] for row in tables["curves"] if row["method"] == "acro"] == ["65.0"]
    assert [row["evaluated_under"] for row in tables["episodes"]].count("none") == 6
    mik, acro = tables["control"]
    assert {name: round(float(acro[name]), 4) for name in list(acro)[6:]} == {
        **{"data_return": 500, "return": 650, "share_above_80": 0.75, "action_error": 0.1},
        **{"clean_return": 566.6667, "clean_share_above_80": 0.6667, "clean_action_error": 0.2},
        **{"path_error": 0.015, "seeds": 2},
    }
    assert {name for name in list(mik)[6:] if mik[name]} == {"return", "seeds"}, "earlier runs know no more"
    shown = page.read_text().partition("<h2>Control</h2>")[2].partition("</table>")[0].replace("\n", "")
    cells = ["acro", "500", "650", "567", "0.75", "0.67", "0.0150", "0.1000", "0.2000", "2"]
    assert re.findall(r"<td[^>]*>([^<]*)</td>", shown)[10:] == cells


def test_a_mean_that_a_seed_does_not_know_is_not_told(tmp_path):
    """It would stand beside a number of seeds that are not behind it."""
    runs = [write_run(tmp_path / f"runs/{seed}", "acro", seed, {10: [30.0 + seed]}) for seed in (0, 1)]
    evaluated_clean(runs[0], [400.0], (0.1, 0.2))
    write_report(runs, tmp_path / "out")
    with (tmp_path / "out" / "control.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert (row["return"], row["clean_return"], row["seeds"]) == ("305.0", "", "2")


@pytest.mark.parametrize(("method", "noted"), [("supervised+a", True), ("acro", False)])
def test_a_probe_of_what_was_told_the_states_is_not_read_as_the_others(tmp_path, method, noted):
    """Its episodes are held out from the probe alone."""
    run = write_run(tmp_path / "runs/0", method, 0, {10: [30.0]})
    page, *_ = write_report([run], tmp_path / "out")
    part = page.read_text().partition("<h2>Representations</h2>")[2].partition("<h2>")[0]
    assert (f"{method}: trained on the states of all episodes" in " ".join(part.split())) == noted


def test_what_was_trained_clean_counts_as_both(tmp_path):
    run = write_run(tmp_path / "runs/0", "acro", 0, {10: [30.0]}, labels={"corruption": "none"})
    write_report([run], tmp_path / "out")
    with (tmp_path / "out" / "control.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert (row["return"], row["clean_return"]) == ("300.0", "300.0")


def test_returns_are_those_of_the_episodes_whatever_divides_the_tasks_scores(tmp_path):
    for seed, score in enumerate((30.0, 50.0)):
        run = write_run(tmp_path / f"runs/{seed}", "acro", seed, {5: [9.0], 10: [score, 90.0]})
        rows = read_episodes(run / "episodes.csv")
        (run / "episodes.csv").unlink()
        append_episodes(run / "episodes.csv", [row | {"return": row["score"]} for row in rows])
    write_report([tmp_path / "runs"], tmp_path / "out")
    returns = {}
    for name in ("runs", "representations", "control"):
        with (tmp_path / "out" / f"{name}.csv").open() as file:
            returns[name] = [row["return"] for row in csv.DictReader(file)]
    assert returns == {"runs": ["70.0", "60.0"], "representations": ["65.0"], "control": ["65.0"]}


def test_returns_are_drawn_against_probes(tmp_path):
    for seed, method in enumerate(("acro", "mik", "random")):
        run = write_run(tmp_path / f"runs/{method}", method, seed, {10: [10.0 * (seed + 1)]})
        if method != "random":
            write_json(run / "probe.json", {"probe_pose": 20.0 + seed, "probe_velocity": 40.0})
    page, *_ = write_report([tmp_path / "runs"], tmp_path / "out")
    text = page.read_text()
    words = "mik, seed 1: return 200, pose 21.0%, velocity 40.0%; acro, seed 0: return 100, pose 20.0%, velocity 40.0%."
    words = f'Return against probe errors. walker_walk expert: {words}"'
    figure = text[text.index(words) :].partition("</figure>")[0]
    assert figure.count("clip-path") >= 2
    assert "<!-- mik -->" in figure
    assert "<!-- random -->" not in figure, "without states nothing is known of it"


def test_an_ablation_is_two_rows_everywhere(tmp_path):
    for k in (1, 15):
        describe(write_run(tmp_path / f"runs/{k}", "mik+a", 0, {5: [k], 10: [k]}, film=True), {"max_k": k})
    page, summary, *_ = write_report([tmp_path / "runs"], tmp_path / "out")
    assert {row["variant"]: row["score"] for row in summary} == {"max_k 15": 15.0, "max_k 1": 1.0}
    text = page.read_text()
    for name in ("mik+a, max_k 1", "mik+a, max_k 15"):
        assert f"<td>{name}</td>" in text
        assert f"<h3>finetune {name}, walker_walk expert, patch, seed 0</h3>" in text
    for name in ("summary", "curves", "aggregate", "runs"):
        with (tmp_path / "out" / f"{name}.csv").open() as file:
            assert {row["variant"] for row in csv.DictReader(file)} == {"max_k 1", "max_k 15"}
    describe(write_run(tmp_path / "runs/twin", "mik+a", 0, {10: [3.0]}), {"max_k": 1})
    with pytest.raises(UserError, match="two runs of one method, setting and seed"):
        write_report([tmp_path / "runs"], tmp_path / "out")


def test_missing_cells_and_seeds_are_shown_as_missing(tmp_path):
    page, summary, *_ = write_report([grid(tmp_path)], tmp_path / "out")
    found = {(row["quality"], row["method"]): (row["score"], row["missing"]) for row in summary}
    assert found == {
        ("expert", "acro"): (21.0, ""),
        ("expert", "mik+a"): (20.5, "seed 2 missing"),
        ("medium", "acro"): (9.0, ""),
        ("medium", "mik+a"): (None, "seed 0 missing"),
    }
    text = page.read_text()
    assert '<tr class="gap"><td>mik+a</td><td colspan="8">seed 0 missing</td></tr>' in text
    assert "<td>mik+a (seed 2 missing)</td>" in text
    for remark in ("mik+a: seed 2 missing", "mik+a: seed 0 missing", "mik+a: 1 of 2 tasks", "×1"):
        assert f"<!-- {remark} -->" in text, "figures say it, too"
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
    page, summary, *_ = write_report([runs], tmp_path / "out")
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


def test_a_diverged_run_is_shown_and_not_averaged(tmp_path):
    runs = grid(tmp_path)
    write_json(runs / "acro2" / "diverged.json", {"step": 7, "message": "critic_loss is nan <b>"})
    page, summary, *_ = write_report([runs], tmp_path / "out")
    (acro,) = [row for row in summary if (row["quality"], row["method"]) == ("expert", "acro")]
    assert (acro["score"], acro["seeds"], acro["missing"]) == (20.5, 2, "seed 2 diverged at update 7 of 10")
    text = page.read_text()
    assert "5 finished runs, 1 unfinished or diverged" in text
    assert "<td>diverged at update 7 of 10: critic_loss is nan &lt;b&gt;</td>" in text
    write_report([tmp_path / "out"], tmp_path / "again")
    assert (tmp_path / "again" / "summary.csv").read_text() == (tmp_path / "out" / "summary.csv").read_text()


def test_a_report_of_unfinished_runs_alone_says_so(tmp_path):
    (describe(write_run(tmp_path / "runs/a", "acro", 0, {5: [1.0]}), {}) / "timing.json").unlink()
    page, summary, *_ = write_report([tmp_path / "runs"], tmp_path / "out")
    assert [(row["score"], row["missing"]) for row in summary] == [(None, "seed 0 unfinished at 10 of 10 updates")]
    assert "0 finished runs, 1 unfinished" in page.read_text()


def test_a_report_writes_over_nothing_but_an_earlier_report(tmp_path, capsys, monkeypatch):
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
    with pytest.raises(UserError, match="the results of 2 runs that would be lost"):
        write_report([tmp_path / "runs" / "0"], tmp_path / "out")
    draw, late = write._plots, write_run(tmp_path / "late", "acro", 7, {10: [25.0]})

    def add_meanwhile(*told):
        add_results([late], tmp_path / "out")
        return draw(*told)

    with monkeypatch.context() as patch:
        patch.setattr(write, "_plots", add_meanwhile)
        with pytest.raises(UserError, match="the results of 1 runs that would be lost"):
            write_report([tmp_path / "out"], tmp_path / "out")
    for name in ("runs.jsonl", "episodes.csv"):
        (tmp_path / "out" / name).unlink()
    write_report([tmp_path / "runs" / "0"], tmp_path / "out")
    again = {p.name for p in (tmp_path / "out").iterdir()}
    assert first - again == {"improvement.csv", "improvement.tex", "missing.csv"}, (
        "no table of the earlier report is left"
    )
    write_report([tmp_path / "runs"], tmp_path / "runs" / "report")
    assert len(write_report([tmp_path / "runs"], tmp_path / "runs" / "report")[1]) == 2


def test_a_report_of_rows_is_that_of_the_folders(tmp_path):
    runs = grid(tmp_path)
    (runs / "acro1" / "timing.json").unlink()
    pretraining(runs / "pretrain")
    first = write_report([runs], tmp_path / "one")
    second = write_report([tmp_path / "one"], tmp_path / "two")
    assert (second.summary, second.gates) == (first.summary, first.gates)
    for file in sorted((tmp_path / "one").rglob("*.*")):
        text, other = (path.read_text() for path in (file, tmp_path / "two" / file.relative_to(tmp_path / "one")))
        assert text.replace(str(runs / "acro1"), "HERE") == other.replace(str(tmp_path / "one"), "HERE"), file.name
    rows = (tmp_path / "two" / "runs.jsonl").read_bytes()
    assert write_report([tmp_path / "two"], tmp_path / "two").summary == first.summary, "beside the rows"
    assert (tmp_path / "two" / "runs.jsonl").read_bytes() == rows


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


def test_a_report_removes_figures_of_an_earlier_one_and_nobody_elses(tmp_path):
    out = tmp_path / "out"
    for corruption in ("patch", "none"):
        write_run(tmp_path / corruption, "acro", 0, {10: [1.0]}, labels={"corruption": corruption})
    write_report([tmp_path / "patch", tmp_path / "none"], out)
    assert (out / "figures" / "scores_none.csv").exists()
    mine = [out / "figures" / name for name in ("mine.png", "my_scores.csv", "poster.pdf")]
    for file in mine:
        file.touch()
    for name in ("runs.jsonl", "episodes.csv"):
        (out / name).unlink()
    write_report([tmp_path / "patch"], out)
    assert not list((out / "figures").glob("scores_none.*"))
    assert (out / "figures" / "scores_patch.csv").exists()
    assert all(file.exists() for file in mine)

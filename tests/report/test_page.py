"""A report's page, files and terminal output."""

import csv
import io
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from rich.console import Console

import pretrain.objectives
from tests.helpers_bad_input import rejection
from tests.helpers_data import file_bytes
from tests.helpers_report import describe, grid, pretraining, without_figures, write_run, write_seeds
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.data.reference import Reference
from vd4rl_pomdp.report import figures, films
from vd4rl_pomdp.report.load import CONDITION
from vd4rl_pomdp.report.page import print_summary, write_report
from vd4rl_pomdp.report.render import write_latex
from vd4rl_pomdp.runs.episodes import drop_episodes_after, read_episodes
from vd4rl_pomdp.runs.files import read_json, write_json
from vd4rl_pomdp.runs.results import find_results, keep_certificates

ROOT = Path(__file__).parents[2]


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def cells(page: Path, heading: str) -> list[list[str]]:
    """Cells of the first table after a heading, row by row."""
    part = page.read_text().partition(heading)[2].partition("</table>")[0]
    rows = (re.findall(r"<td>(.*?)</td>", row, re.DOTALL) for row in part.split("<tr")[1:])
    return [row for row in rows if row]


def test_report_counts_seeds_not_episodes(tmp_path, drawn):
    for seed, scores in enumerate([[10.0, 30.0], [40.0, 40.0]]):
        write_run(tmp_path / f"runs/acro/{seed}", "acro", seed, {5: [90.0, 90.0], 10: scores}, film=seed == 0)
    write_run(tmp_path / "runs/random/0", "random", 0, {10: [95.0]})
    page, summary, *_ = write_report([tmp_path / "runs"], tmp_path / "out")
    acro, random = summary.to_dict("records")
    assert (acro["method"], random["method"]) == ("acro", "random"), "references come last"
    assert acro["score"] == pytest.approx(30.0)
    assert (acro["seeds"], acro["episodes"], acro["best_step"]) == (2, 4, 5)
    assert acro["low"] < 20 < 40 < acro["high"], "two seeds, at 20 and 40"
    assert pd.isna(random["low"])
    assert len(table(tmp_path / "out" / "episodes.csv")) == 9
    text = page.read_text()
    assert "data:image/webp;base64" in text
    assert not re.search(r'(src|href)="?(https?:)?//', text), "the page must not need a network"


def test_last_and_best_evaluation_have_separate_columns(tmp_path):
    for seed in range(2):
        write_run(tmp_path / f"runs/{seed}", "acro", seed, {5: [90.0 + seed], 10: [20.0 + seed]})
    page, *_ = write_report([tmp_path / "runs"], tmp_path / "out")
    (row,) = cells(page, "<h3>walker_walk")
    assert row == ["acro", "20.5 [14.1, 26.9]", "10", "90.5 [84.1, 96.9]", "5", "2†", "2"]


def test_navigation_results_name_the_navigation_report(tmp_path):
    with pytest.raises(UserError, match="no evaluated run; `vd4rl-pomdp navigation report` reports its mazes"):
        write_report([ROOT / "results" / "navigation" / "longer"], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_report_of_pretraining_runs_only(tmp_path, drawn):
    """As for a dataset whose task cannot be evaluated."""
    pretraining(tmp_path / "runs")
    text = write_report([tmp_path / "runs"], tmp_path / "out").page.read_text()
    assert "Action loss of pretraining" in text
    assert "No run has been evaluated yet" in text
    assert "<h2>Final scores</h2>" not in text


def test_end_to_end_references_share_the_table(tmp_path):
    write_run(tmp_path / "runs/acro", "acro", 0, {10: [50.0]})
    end_to_end = write_run(tmp_path / "runs/bc", "bc", 0, {10: [20.0]}, labels={"algorithm": "bc"})
    write_json(end_to_end / "probe.json", {"probe_pose": 12.5, "probe_velocity": 34.5})
    write_json(end_to_end / "pretrain_timing.json", {"seconds": 7.0})
    page, *_ = write_report([tmp_path / "runs"], tmp_path / "out")
    assert [row[0] for row in cells(page, "<h3>walker_walk expert, patch</h3>")] == ["acro", "bc"]
    acro, bc = table(tmp_path / "out" / "runs.csv")
    assert (acro["method"], acro["return"], acro["probe_pose"]) == ("acro", "500.0", "")
    assert (bc["probe_pose"], bc["probe_velocity"]) == ("12.5", "34.5")
    assert (bc["pretrain_seconds"], bc["finetune_seconds"]) == ("7.0", "3.0")
    chances = [(row["method"], row["probability"], row["wins"]) for row in table(tmp_path / "out" / "improvement.csv")]
    assert chances == [("acro", "", "1.0"), ("bc", "", "0.0")], "one pair of runs gives no probability"
    assert cells(page, "Probability of improvement</h2>") == [["acro", "", "1 of 1"], ["bc", "0 of 1", ""]]
    heads = re.findall(r"<th>(.*?)</th>", page.read_text().partition("Probability of improvement</h2>")[2])
    assert heads[:3] == ["row beats column", "acro", "bc"]


@pytest.mark.parametrize(("method", "noted"), [("supervised+a", True), ("acro", False)])
def test_probes_of_supervised_methods_are_marked(tmp_path, method, noted):
    """Their encoders have seen the states of the probe's held-out episodes."""
    page, *_ = write_report([write_run(tmp_path / "runs/0", method, 0, {10: [30.0]})], tmp_path / "out")
    part = page.read_text().partition("<h2>Representations</h2>")[2].partition("<h2>")[0]
    assert (f"{method}: trained on the states of all episodes" in part) == noted


def test_ablations_are_separate_rows(tmp_path):
    for k in (1, 15):
        describe(write_run(tmp_path / f"runs/{k}", "mik+a", 0, {5: [k], 10: [k]}, film=True), {"max_k": k})
    page, summary, *_ = write_report([tmp_path / "runs"], tmp_path / "out")
    assert summary.set_index("variant")["score"].to_dict() == {"max_k 15": 15.0, "max_k 1": 1.0}
    text = page.read_text()
    for name in ("mik+a, max_k 1", "mik+a, max_k 15"):
        assert f"<td>{name}</td>" in text
        assert f"<h3>finetune {name}, walker_walk expert, patch, seed 0</h3>" in text
    for name in ("summary", "curves", "aggregate", "runs"):
        assert {row["variant"] for row in table(tmp_path / "out" / f"{name}.csv")} == {"max_k 1", "max_k 15"}


def test_missing_seeds_are_shown(tmp_path):
    _, summary, *_ = write_report([grid(tmp_path)], tmp_path / "out")
    found = summary.set_index(["quality", "method"])[["score", "missing"]].T.to_dict("list")
    assert found == {
        ("expert", "acro"): [21.0, ""],
        ("expert", "mik+a"): [20.5, "seed 2 missing"],
        ("medium", "acro"): [9.0, ""],
    }
    missing = [(row["quality"], row["seed"], row["state"]) for row in table(tmp_path / "out" / "missing.csv")]
    assert missing == [("expert", "2", "missing")]
    states = {
        (row["quality"], row["method"], row["seed"]): row["state"] for row in table(tmp_path / "out" / "runs.csv")
    }
    gone = {place for place, state in states.items() if state == "missing"}
    assert (len(states), gone) == (7, {("expert", "mik+a", "2")})


def test_unfinished_and_diverged_runs_are_listed_without_final_scores(tmp_path, drawn):
    runs = grid(tmp_path)
    cut = runs / "acro2"
    (cut / "timing.json").unlink()
    rows = [line for line in (cut / "episodes.csv").read_text().splitlines() if ",10,0," not in line]
    (cut / "episodes.csv").write_text("\n".join(rows) + "\n")
    (cut / "metrics.jsonl").write_text('{"step": 7, "bc_loss": 0.5}\n')
    write_json(runs / "mik+a1" / "diverged.json", {"step": 7, "message": "critic_loss is nan <b>"})
    page, summary, *_ = write_report([runs], tmp_path / "out")
    found = summary.set_index(["quality", "method"])
    shown = [found.loc[("expert", name), ["score", "seeds", "missing"]].tolist() for name in ("acro", "mik+a")]
    assert shown == [
        [20.5, 2, "seed 2 unfinished at 7 of 10 updates"],
        [20.0, 1, "seed 1 diverged at update 7 of 10; seed 2 missing"],
    ]
    text = page.read_text()
    assert "4 finished runs, 2 unfinished or diverged" in text
    assert f"<td>{cut}</td>" in text
    assert "<td>diverged at update 7 of 10: critic_loss is nan &lt;b&gt;</td>" in text
    curves = {(r["quality"], r["method"], r["step"]): r["seeds"] for r in table(tmp_path / "out" / "curves.csv")}
    assert (curves["expert", "acro", "5"], curves["expert", "acro", "10"]) == ("3", "2"), "curves use partial runs"
    page, summary, *_ = write_report([cut], tmp_path / "unfinished")
    assert summary["missing"].tolist() == ["seed 2 unfinished at 7 of 10 updates"]
    assert "0 finished runs, 1 unfinished" in page.read_text()


def test_report_overwrites_only_earlier_reports(tmp_path):
    for seed in (0, 1):
        write_run(tmp_path / f"runs/{seed}", "acro", seed, {10: [25.0]})
    write_run(tmp_path / "runs/random", "random", 0, {10: [1.0]})
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "index.html").write_text("mine")

    before = file_bytes(tmp_path)
    for out in ("runs", "runs/0", "runs/0/report", "notes"):
        assert "choose another" in rejection(["report", str(tmp_path / "runs"), "--out", str(tmp_path / out)])
        assert file_bytes(tmp_path) == before
    write_report([tmp_path / "runs"], tmp_path / "out")
    first = {p.name for p in (tmp_path / "out").iterdir()}
    with pytest.raises(UserError, match="the results of 2 runs that would be lost"):
        write_report([tmp_path / "runs" / "0"], tmp_path / "out")
    assert {p.name for p in (tmp_path / "out").iterdir()} == first
    assert set(before.items()) <= file_bytes(tmp_path).items()


def test_report_is_reproducible_from_its_own_folder(tmp_path):
    runs = grid(tmp_path)
    (runs / "acro1" / "timing.json").unlink()
    pretraining(runs / "pretrain")
    first = write_report([runs], tmp_path / "one")
    second = write_report([tmp_path / "one"], tmp_path / "two")
    assert second.gates == first.gates
    for file in sorted((tmp_path / "one").rglob("*.*")):
        text, other = (path.read_text() for path in (file, tmp_path / "two" / file.relative_to(tmp_path / "one")))
        assert text.replace(str(runs / "acro1"), "HERE") == other.replace(str(tmp_path / "one"), "HERE"), file.name
    rows = (tmp_path / "two" / "runs.jsonl").read_bytes()
    write_report([tmp_path / "two"], tmp_path / "two")
    assert (tmp_path / "two" / "runs.jsonl").read_bytes() == rows, "a report in place keeps its rows"


def test_report_of_its_own_folder_keeps_certificates(tmp_path, monkeypatch):
    without_figures(monkeypatch)
    monkeypatch.chdir(tmp_path)
    write_run(tmp_path / "runs/a", "acro", 0, {10: [25.0]})
    out, (run,) = Path("report"), find_results(["runs"])
    write_report([Path("runs")], out)
    about = {"data": "", "corruption": {}, "name": "patch", "verdict": "needs a memory", "why": "R2", "made": "now"}
    about |= {"measured": {}, "budget": {}}
    keep_certificates(out, {run.certificate: about})
    for name in (out, tmp_path / "report"):
        assert list(write_report([name], out).summary["memory"]) == ["needs a memory (R2)"]


HOSTILE = '$\\frac$ <b>=1+1</b>, "x"|`y`\n[/red]_\u2028μ'


def test_method_names_are_escaped(tmp_path, capsys, drawn):
    write_run(tmp_path / "runs/a", HOSTILE, 0, {5: [1.0], 10: [2.0]}, film=True, labels={"quality": "_$x_$"})
    main(["report", str(tmp_path / "runs"), "--out", str(tmp_path / "out")])
    assert "<b>=1+1" in capsys.readouterr().out.replace("\n", "")
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert "<b>" not in page
    assert "&lt;b&gt;=1+1&lt;/b&gt;" in page
    for name in ("summary", "episodes", "runs", "curves"):
        assert {row["method"] for row in table(tmp_path / "out" / f"{name}.csv")} == {HOSTILE}
    rows = read_episodes(tmp_path / "runs" / "a" / "episodes.csv")
    drop_episodes_after(tmp_path / "runs" / "a" / "episodes.csv", 5)
    assert read_episodes(tmp_path / "runs" / "a" / "episodes.csv") == rows[:1]


def test_latex_escapes_text(tmp_path):
    texts = pd.DataFrame({"a b": ["{~^\\}", "seed_2"], "50%": ["–", "$x_1$ & #"]})
    write_latex(tmp_path / "a.tex", texts, 1, "95% of it.")
    assert r"\caption{95\% of it.}" in (tmp_path / "a.tex").read_text()
    write_latex(tmp_path / "a.tex", pd.concat([texts, pd.DataFrame({"a b": ["one †"], "50%": ["1"]})]), 1, "95% of it.")
    found = (tmp_path / "a.tex").read_text()
    for text in (
        r"\caption{95\% of it. \dag{}: fewer than 5 seeds.}",
        r"\begin{longtable}{lr}",
        r"a b & 50\% \\",
        r"\{\textasciitilde \textasciicircum \textbackslash \} & -- \\",
        r"seed\_2 & \$x\_1\$ \& \# \\",
    ):
        assert text in found


def test_report_runs_with_ascii_locale(tmp_path):
    write_run(tmp_path / "runs/a", "μ", 0, {10: [2.0]})
    words = [sys.executable, "-m", "vd4rl_pomdp", "report", str(tmp_path / "runs"), "--out", str(tmp_path / "out")]
    ascii_only = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0", "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(words, capture_output=True, env=os.environ | ascii_only)
    assert (done.returncode, b"\\u03bc" in done.stdout) == (0, True), done.stderr
    for name in ("index.html", "summary.csv", "episodes.csv"):
        assert "μ" in (tmp_path / "out" / name).read_text(encoding="utf-8")


def test_figures_have_files_alternative_text_and_n(tmp_path, figure_files):
    runs = grid(tmp_path)
    pretraining(runs / "pretrain")
    for seed in (0, 1):
        write_json(runs / f"acro{seed}" / "probe.json", {"probe_pose": 20.0 + seed, "probe_velocity": 40.0})
        Reference(500.0, None, 0.01).write(runs / f"acro{seed}")
    page, *_ = write_report([runs], tmp_path / "out")
    folder = tmp_path / "out" / "figures"
    found = {path.name for path in folder.iterdir()}
    names = {"scores_patch", "profiles", "curves_patch", "probes_patch", "errors_patch", "losses"}
    assert found == {f"{name}.{kind}" for name in names for kind in ("csv", "png", "pdf")}
    text = page.read_text()
    links = set(re.findall(r'href="([^"#][^"]*)"', text))
    assert {f"figures/{name}" for name in found} <= links
    assert [link for link in links if not (tmp_path / "out" / link).is_file()] == []
    words = re.findall(r'role="img" aria-label="(.{40,}?)"', text)
    captions = re.findall(r"<figcaption>(.*?)</figcaption>", text, re.DOTALL)
    assert len(words) == len(captions) == text.count("<figure>")
    assert all("n = " in caption for caption in captions)
    assert "(warning: fewer than 5)" in captions[0]
    seeds = [
        row["score"] for row in table(folder / "scores_patch.csv") if (row["kind"], row["method"]) == ("seed", "acro")
    ]
    assert sorted(seeds) == ["20.0", "21.0", "22.0", "9.0"]
    mine = [folder / name for name in ("mine.png", "my_scores.csv", "poster.pdf")]
    for file in (*mine, folder / "scores_old.png"):
        file.touch()
    before = page.read_bytes()
    write_report([runs], tmp_path / "out")
    assert page.read_bytes() == before, "figures are deterministic"
    left = {path.name for path in folder.iterdir()} - {file.name for file in mine}
    assert left == found, "old figures are removed, the user's files stay"
    assert all(file.exists() for file in mine)


def test_single_evaluations_have_no_learning_curve(tmp_path):
    curves = pd.DataFrame(
        [dict.fromkeys(CONDITION, "") | {"step": 10, "score": 1.0, "low": 1.0, "high": 1.0, "seeds": 2}]
    )
    assert figures.curve_plots(curves, {}) == []


def test_figures_show_negative_returns_best_evaluations_and_gaps(tmp_path, monkeypatch, drawn):
    plots = {}
    monkeypatch.setattr(figures, "save_plot", lambda _, plot: plots.update({plot.name: plot}))
    for method, score in {"mik+a": -20.0, "acro": -60.0}.items():
        for seed in (0, 1):
            run = write_run(tmp_path / f"runs/{method}{seed}", method, seed, {5: [score + 9], 10: [score + seed]})
            write_json(run / "probe.json", {"probe_pose": 20.0, "probe_velocity": 40.0})
            Reference(512.3).write(run)
    write_run(tmp_path / "runs/bc", "bc", 2, {10: [-50.0]})
    write_report([tmp_path / "runs"], tmp_path / "out")
    (scores,) = plots["scores_patch"].figure.axes
    assert scores.get_title() == "walker_walk expert (data score 51.2)"
    assert [text.get_text() for text in scores.get_yticklabels()] == [
        "mik+a (1 missing)",
        "acro (1 missing)",
        "bc (2 missing)",
    ]
    low, high = scores.get_xlim()
    assert low < -60 < 0 <= high
    offsets = [points for dots in scores.collections for points in dots.get_offsets().tolist()]
    assert [-11.0, 0.0] in offsets, "the best evaluation of the first bar"
    assert plots["curves_patch"].figure.axes[0].get_ylim()[0] < -60
    (profile,) = plots["profiles"].figure.axes
    assert profile.get_xlim() == (-60.0, 0.0)
    pose = plots["probes_patch"].figure.axes[0]
    dots = {
        label: handle.get_offsets().tolist() for handle, label in zip(*pose.get_legend_handles_labels(), strict=True)
    }
    assert dots == {"mik+a": [[20.0, -190.0], [20.0, -200.0]], "acro": [[20.0, -590.0], [20.0, -600.0]]}


def test_methods_have_fixed_styles():
    assert set(figures.LOOKS) == set(pretrain.objectives.METHODS)
    few, many = figures.looks_of(["acro", "random"]), figures.looks_of(["acro", "acro, m 4", "mine", "random"])
    assert {name: many[name] for name in few} == few
    assert {many["acro, m 4"], many["mine"]} == {len(figures.LOOKS), len(figures.LOOKS) + 1}
    looks = [str(figures.style(number)) for number in many.values()]
    assert len(set(looks)) == len(looks) >= 12


ESCAPE = "\x1b[31mred"


@pytest.mark.parametrize("words", [["report", "runs"], ["report", "compare", "runs", "runs"]])
def test_names_send_no_escapes_to_the_terminal(tmp_path, capfd, drawn, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    write_run(tmp_path / "runs/a", "acro", 0, {10: [2.0]}, labels={"corruption": ESCAPE, "quality": ESCAPE})
    about = {"data": "", "corruption": {}, "name": "", "verdict": ESCAPE, "why": "", "made": "", "measured": {}}
    (run,) = find_results(["runs"])
    keep_certificates(tmp_path / "runs", {run.certificate: about | {"budget": {}}})
    main([*words, "--out", "new"])
    assert "\x1b" not in "".join(capfd.readouterr())
    assert "\x1b" not in rejection(["report", f"runs/{ESCAPE}"])


@pytest.mark.parametrize(
    "shapes",
    [
        {"clean": (2, 3, 8, 8), "corrupted": (1, 9, 8, 8), "return": (2,)},
        {"clean": (0, 3, 8, 8), "corrupted": (0, 9, 8, 8), "return": (0,)},
        {"clean": (2, 3, 8, 8), "corrupted": (2, 9, 8, 4), "return": (2,)},
        {"clean": (2, 3, 8, 8), "corrupted": (2, 8, 8, 8), "return": (2,)},
        {"clean": (2, 3, 8, 8), "corrupted": (2, 9, 8, 8), "return": (1,)},
    ],
)
def test_films_of_arrays_that_do_not_fit_are_rejected(tmp_path, shapes):
    np.savez(tmp_path / "film.npz", **{name: np.zeros(shape, np.uint8) for name, shape in shapes.items()})
    with pytest.raises(UserError, match=r"film.npz: cannot be read \(its arrays have other shapes\)"):
        films.read_film(tmp_path / "film.npz")


def test_films_are_read_once_and_limited_by_size(tmp_path, monkeypatch):
    for method in ("acro", "mik", "random"):
        for seed in (0, 1):
            write_run(tmp_path / f"runs/{method}{seed}", method, seed, {10: [1.0]}, film=True)
    read, read_film = [], films.read_film
    monkeypatch.setattr(films, "read_film", lambda path: (read.append(path), read_film(path))[1])
    page, *_ = write_report([tmp_path / "runs"], tmp_path / "out")
    assert len(read) == len(set(read)) == 3
    text = page.read_text()
    assert text.count("data:image/webp") == text.count("data:image/png;base64") == 3
    monkeypatch.setattr(films, "MOST_BYTES", 1.5 * len(text) / 3)
    page, *_ = write_report([tmp_path / "runs"], tmp_path / "other")
    assert page.read_text().count("data:image/webp") == 1
    assert "2 more films are left out" in page.read_text()


def test_seeds_of_a_condition_share_one_entry(tmp_path):
    for seed in range(2):
        describe(write_run(tmp_path / f"runs/{seed}", "acro", seed, {10: [1.0]}), {}, seed=seed)
    page, *_ = write_report([tmp_path / "runs"], tmp_path / "out")
    entries = re.findall(r"<summary>(.*?)</summary>", page.read_text())
    assert entries == ["finetune acro, walker_walk expert, patch, seeds 0, 1"]


def test_figure_file_names_are_safe_and_unique():
    names = ("patch+zero_frames", "../up", "up", "a b/c", "a-b-c", "ζ", "")
    found = [figures.file_name("scores", name) for name in names]
    assert found[0] == "scores_patch+zero_frames"
    assert len(set(found)) == len(names)
    assert all(re.fullmatch(r"[A-Za-z0-9+._-]+", name) and ".." not in name for name in found)


def test_differing_data_and_code_are_reported(tmp_path, capsys):
    before = {"sources": {"method mine": "mine.py 0", "frame_encoder own": "own.py 0"}}
    after = {
        "plugins": {"frame_encoder own": "theirs 1.0"},
        "sources": {"method mine": "x", "frame_encoder own": "own.py 1"},
    }
    for seed, record in enumerate(({}, after)):
        run = describe(write_run(tmp_path / f"runs/{seed}", "mine", seed, {10: [1.0]}), {}, "one")
        write_json(run / "config.json", read_json(run / "config.json") | record)
        kept = {"origin": before} if seed else before  # seed 0: the layout of earlier versions
        write_json(run / "encoder/config.json", read_json(run / "encoder/config.json") | kept)
    other = describe(write_run(tmp_path / "runs/other", "random", 0, {10: [1.0]}), data="two")
    words = ["report", str(tmp_path / "runs"), "--out", str(tmp_path / "out")]
    main(words)
    warnings = [
        "the set of walker_walk expert has 2 contents: one (mine); two (random)",
        "frame_encoder own has 2 states of its code: own.py 0 (mine); own.py 0 then theirs 1.0, own.py 1 (mine)",
    ]
    assert capsys.readouterr().err == "".join(f"warning: {sentence}\n" for sentence in warnings)
    page = (tmp_path / "out" / "index.html").read_text()
    assert all(sentence in page for sentence in warnings)
    shutil.rmtree(other)
    shutil.rmtree(tmp_path / "runs/1")
    main([*words[:3], str(tmp_path / "again")])
    assert capsys.readouterr().err == ""
    assert "Differences in provenance" not in (tmp_path / "again" / "index.html").read_text()


def test_tables_fit_eighty_columns(tmp_path):
    runs = tmp_path / "runs"
    scores = {("mik+a", "patch"): (50.0, 60.0, 55.0), ("acro", "patch"): (10.0, 12.0, 11.0, 9.0, 8.0, 7.0)}
    write_seeds(runs, scores, 600)
    write_seeds(runs, {("mik+a", "none"): (70.0, 71.0, 72.0)}, 600, random_histories=0.5)
    shown = io.StringIO()
    print_summary(write_report([runs], tmp_path / "out"), Console(file=shown, width=80))
    assert "seeds 3, 4, 5" in shown.getvalue(), "the widest column"
    assert shown.getvalue().count("random_histories") == 2, "once per table"
    borders = [line[-1] for line in shown.getvalue().splitlines() if line[:1] in tuple("┏┃┡│└")]
    assert set(borders) == set("┓┃┩│┘"), "a table wider than the terminal loses its right border"

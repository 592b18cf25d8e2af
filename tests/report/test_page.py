"""What a page carries: figures with files and words, tables that can be set elsewhere, and thousands of runs."""

import csv
import re
import shutil
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path

import pretrain.objectives
from tests.helpers_report import METHODS, describe, grid, pretraining, write_grid, write_run
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.data.reference import Reference
from vd4rl_pomdp.report import figures, films, layout, tables, write, write_report
from vd4rl_pomdp.report.figures import style
from vd4rl_pomdp.report.load import LoadedRun
from vd4rl_pomdp.runs.files import read_json, write_json


class Page(HTMLParser):
    """Links of a page, and the words of its pictures."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.words: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        if "href" in values:
            self.links.append(values["href"])
        if values.get("role") == "img" or tag == "img":
            self.words.append(values.get("aria-label") or values.get("alt") or "")


def test_every_figure_has_its_files_its_words_and_n(tmp_path, figure_files):
    runs = grid(tmp_path)
    pretraining(runs / "pretrain")
    for seed in (0, 1):
        write_json(runs / f"acro{seed}" / "probe.json", {"probe_pose": 20.0 + seed, "probe_velocity": 40.0})
        Reference(500.0, None, 0.01).write(runs / f"acro{seed}")
    page, *_ = write_report([runs], tmp_path / "out")
    found = {path.name for path in (tmp_path / "out" / "figures").iterdir()}
    names = {"scores_patch", "profiles", "curves_patch", "probes_patch", "errors_patch", "costs", "losses"}
    assert found == {f"{name}.{kind}" for name in names for kind in ("csv", "png", "pdf")}
    shown = Page(page)
    assert {link for link in shown.links if link.startswith("figures/")} == {f"figures/{name}" for name in found}
    assert all((tmp_path / "out" / link).is_file() for link in shown.links if not link.startswith("#")), shown.links
    assert len(shown.words) == page.read_text().count("<figure>")
    assert all(len(words) > 40 for words in shown.words)
    captions = re.findall(r"<figcaption>(.*?)</figcaption>", page.read_text(), re.DOTALL)
    assert all("n = " in caption for caption in captions)
    assert "(warning: fewer than 5)" in captions[0]
    with (tmp_path / "out" / "figures" / "scores_patch.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert sorted(row["score"] for row in rows if row["kind"] == "seed" and row["method"] == "acro") == [
        "20.0", "21.0", "22.0", "9.0",
    ]  # fmt: skip
    (tmp_path / "out" / "figures" / "scores_old.png").touch()
    write_report([runs], tmp_path / "out")
    assert {path.name for path in (tmp_path / "out" / "figures").iterdir()} == found, "an earlier one goes"


def test_lines_of_many_methods_differ_in_more_than_colour():
    looks = [tuple(map(str, style(number).values())) for number in range(60)]
    assert len(set(looks)) == 60
    for one, other in pairwise(looks):
        assert sum(a != b for a, b in zip(one, other, strict=True)) == 3
    alike = [(a, b) for a in looks[:14] for b in looks[:14] if a < b and a[0] == b[0]]
    assert all(a[1] != b[1] and a[2] != b[2] for a, b in alike), "what shares a colour has other dashes and markers"


def test_the_packages_methods_look_the_same_whatever_else_a_report_tells_of():
    assert set(tables.LOOKS) == set(pretrain.objectives.METHODS)
    few, many = write._looks(["acro", "random"]), write._looks(["acro", "acro, m 4", "mine", "mik", "random"])
    assert {name: many[name] for name in few} == few
    assert list(many) == ["acro", "acro, m 4", "mine", "mik", "random"], "places are those of the names"
    assert {many["acro, m 4"], many["mine"]} == {len(tables.LOOKS), len(tables.LOOKS) + 1}


def test_last_and_best_evaluation_stand_apart(tmp_path):
    for seed in range(2):
        write_run(tmp_path / f"runs/{seed}", "acro", seed, {5: [90.0 + seed], 10: [20.0 + seed]})
    page, summary, *_ = write_report([tmp_path / "runs"], tmp_path / "out")
    cells = re.findall(r"<td[^>]*>([^<]*)</td>", page.read_text().partition("<h3>walker_walk")[2])[:9]
    assert cells == ["acro", "20.5", "[14.1, 26.9]", "10", "90.5", "[84.1, 96.9]", "5", "2†", "2"]
    assert round(summary[0]["best_low"], 1) == 84.1


def test_published_scores_are_lines_where_the_set_is_theirs_and_nothing_is_hidden(tmp_path):
    places = {
        "theirs": ({"corruption": "none"}, {"collection": {}}),
        "ours": ({"corruption": "none", "task": "cheetah_run"}, {"collection": {"episodes": 2}}),
        "unknown": ({"corruption": "none", "task": "humanoid_walk"}, {}),
        "hidden": ({"corruption": "patch"}, {"collection": {}}),
    }
    for name, (labels, record) in places.items():
        run = write_run(tmp_path / "runs" / name, "acro", 0, {10: [50.0]}, labels=labels)
        write_json(run / "config.json", read_json(run / "config.json") | record)
    page, *_ = write_report([tmp_path / "runs"], tmp_path / "out")
    text = page.read_text()
    assert text.count("<!-- DrQ+BC -->") == 1
    after = text.partition("<!-- DrQ+BC -->")[2].partition("</svg>")[0]
    titles = re.findall(r"<!-- (\w+_(?:run|walk) expert) -->", after)
    assert titles == ["walker_walk expert"], "a panel's title is drawn after its lines"
    captions = re.findall(r"<figcaption>(Final scores.*?)</figcaption>", text, re.DOTALL)
    assert ["published scores" in caption for caption in captions] == ["under none" in caption for caption in captions]


def test_latex_sets_any_text():
    table = layout.ShownTable(
        "50% & $x_1$", ("a", "b#"), [layout.Line(("{~^\\}", "–")), layout.Line(("x",), "seed_2 <missing>")]
    )
    found = layout.latex([table], "n")
    for text in (
        r"\caption{50\% \& \$x\_1\$. n}",
        r"\begin{tabular}{lr}",
        r"a & b\# \\",
        r"\{\textasciitilde{}\textasciicircum{}\textbackslash{}\} & -- \\",
        r"x & \multicolumn{1}{l}{\emph{seed\_2 \textless{}missing\textgreater{}}} \\",
        *(r"\toprule", r"\midrule", r"\bottomrule"),
    ):
        assert text in found


def test_a_film_is_read_once_and_those_beyond_the_pages_room_are_counted(tmp_path, monkeypatch):
    for method in ("acro", "mik", "random"):
        for seed in (0, 1):
            write_run(tmp_path / f"runs/{method}{seed}", method, seed, {10: [1.0]}, film=True)
    read = []
    film = LoadedRun.film
    monkeypatch.setattr(LoadedRun, "film", lambda self: (read.append(self.path), film(self))[1])
    page, *_ = write_report([tmp_path / "runs"], tmp_path / "out")
    assert len(read) == len(set(read)) == 3
    text = page.read_text()
    assert text.count("data:image/webp") == text.count("data:image/png;base64") == 3
    assert ".movie { display: none; }" in text.partition("@media print")[2], "strips are printed, movies are not"
    monkeypatch.setattr(films, "MOST_BYTES", 1.5 * len(text) / 3)
    page, *_ = write_report([tmp_path / "runs"], tmp_path / "other")
    assert page.read_text().count("data:image/webp") == 1
    assert "2 more films are left out" in page.read_text()


def test_a_report_of_five_thousand_runs_drops_nothing_and_stays_small(tmp_path):
    runs = write_grid(tmp_path / "grid", episodes=2)
    assert runs > 4900
    page, summary, *_ = write_report([tmp_path / "grid"], tmp_path / "out")
    assert page.stat().st_size < 10 * 2**20
    assert sum(row["seeds"] for row in summary) == runs
    for name, expected in (("runs.csv", runs), ("episodes.csv", 6 * runs)):
        with (tmp_path / "out" / name).open() as file:
            assert sum(1 for _ in file) == expected + 1
    assert len(summary) == 3 * 3 * 2 * len(METHODS)
    assert (tmp_path / "out" / "runs.jsonl").read_bytes() == (tmp_path / "grid" / "runs.jsonl").read_bytes()
    text = page.read_text()
    assert all(f"<td>{method}</td>" in text for method in METHODS)
    panels = re.findall(r"<!-- cheetah_run (\w+) -->", text)
    assert panels[:3] == ["expert", "medium_expert", "medium"], "the paper's qualities first, a row each"


def test_runs_of_a_condition_share_one_entry(tmp_path):
    for seed in range(15):
        describe(write_run(tmp_path / f"runs/{seed}", "acro", seed, {10: [1.0]}), {}, seed=seed)
    page, *_ = write_report([tmp_path / "runs"], tmp_path / "out")
    entries = re.findall(r"<summary>(.*?)</summary>", page.read_text())
    assert entries == ["finetune acro, walker_walk expert, patch, seeds 0, 1, 2, ..., 14"]


def test_files_of_figures_have_plain_names_of_their_own():
    names = ("patch+zero_frames", "../up", "up", "a b/c", "a-b-c", "ζ", "")
    found = [figures.file_name("scores", name) for name in names]
    assert found[0] == "scores_patch+zero_frames"
    assert len(set(found)) == len(names)
    assert all(re.fullmatch(r"[A-Za-z0-9+._-]+", name) for name in found)
    assert not any(".." in name for name in found[1:])


def test_code_of_a_pretraining_and_of_its_policy_is_told(tmp_path, capsys):
    before = {"sources": {"method mine": "mine.py 0", "frame_encoder own": "own.py 0"}}
    after = {"sources": {"method mine": "mine.py 1", "frame_encoder own": "own.py 1"}}
    for seed, told in enumerate(({}, after)):
        run = describe(write_run(tmp_path / f"runs/{seed}", "mine", seed, {10: [1.0]}), {}, "one")
        write_json(run / "config.json", read_json(run / "config.json") | told)
        write_json(run / "encoder/config.json", read_json(run / "encoder/config.json") | {"origin": before})
    main(["report", str(tmp_path / "runs"), "--out", str(tmp_path / "out")])
    told = "frame_encoder own has 2 states of its code: own.py 0 (mine); own.py 0 then own.py 1 (mine)"
    assert capsys.readouterr().err == f"warning: {told}\n", "nothing of a method is used after its pretraining"


def test_what_was_not_made_of_the_same_is_told(tmp_path, capsys):
    parts = {"plugins": {"method mine": "theirs 1.0"}, "sources": {"method mine": "mine.py 1"}}
    for number, (method, data, told) in enumerate(
        (
            ("acro", "one", {}),
            ("mine", "one", parts),
            ("mine", "one", parts | {"sources": {"method mine": "mine.py 2"}}),
        )
    ):
        run = describe(write_run(tmp_path / f"runs/{number}", method, number, {10: [1.0]}), data=data)
        write_json(run / "config.json", read_json(run / "config.json") | told)
    other = describe(write_run(tmp_path / "runs/other", "random", 0, {10: [1.0]}), data="two")
    describe(write_run(tmp_path / "runs/medium", "acro", 0, {10: [1.0]}, labels={"quality": "medium"}), data="three")
    words = ["report", str(tmp_path / "runs"), "--out", str(tmp_path / "out")]
    main(words)
    told = [
        "the set of walker_walk expert has 2 contents: one (acro, mine); two (random)",
        "method mine has 2 states of its code: theirs 1.0, mine.py 1 (mine); theirs 1.0, mine.py 2 (mine)",
    ]
    assert capsys.readouterr().err == "".join(f"warning: {sentence}\n" for sentence in told)
    page = (tmp_path / "out" / "index.html").read_text()
    assert [sentence in page for sentence in told] == [True, True]
    for run in (other, tmp_path / "runs/2"):
        shutil.rmtree(run)
    main([*words[:3], str(tmp_path / "again")])
    assert capsys.readouterr().err == ""
    assert "Not made of the same" not in (tmp_path / "again" / "index.html").read_text()

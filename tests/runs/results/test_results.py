"""Results folders hold the content of their runs' files and lose nothing."""

import contextlib
import errno
import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.helpers_bad_input import rejection
from tests.helpers_report import describe, grid, pretraining, without_figures, write_run
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.data.reference import Reference
from vd4rl_pomdp.report.page import write_report
from vd4rl_pomdp.runs.episodes import append_episodes, read_episodes
from vd4rl_pomdp.runs.files import read_json, write_json
from vd4rl_pomdp.runs.results import Result, add_results, certificates_of, find_results, read_results, read_run
from vd4rl_pomdp.runs.run import identity


@pytest.fixture(autouse=True)
def _fewer_figures(monkeypatch):
    without_figures(monkeypatch)


def whole_run(place: Path, seed: int = 0, score: float = 2.0) -> Path:
    """A fine-tuning run with all its small files."""
    run = describe(write_run(place, "acro", seed, {5: [1.0], 10: [score]}), {"seed": seed}, data="f00", seed=seed)
    write_json(run / "machine.json", {"processor": "two cores"})
    write_json(run / "render.json", {"mujoco": "3.11.0"})
    write_json(run / "probe.json", {"probe_pose": 12.5, "probe_velocity": None})
    write_json(run / "pretrain_timing.json", {"seconds": 7.0, "steps": 20})
    Reference(500.0, None, 0.01, 1.0).write(run)
    write_json(run / "critic.json", {"value": 150.0, "moved": 0.01, "data": 160.0})
    card = read_json(run / "encoder" / "config.json")
    write_json(run / "encoder" / "config.json", {"pretrain": card["pretrain"] | {"seed": seed}})
    return run


def content(run: Result) -> tuple:
    return run.id, run.files, run.step, run.losses, run.rows


def test_results_round_trip(tmp_path):
    run, before = whole_run(tmp_path / "runs/a"), pretraining(tmp_path / "runs/b")
    added = add_results([tmp_path / "runs"], tmp_path / "out")
    assert added == "2 runs added"
    (one, other) = read_results(str(tmp_path / "out"))
    for name in ("config", "labels", "timing", "machine", "render", "probe", "pretrain_timing", "reference", "critic"):
        assert one.files[name] == read_json(run / f"{name}.json"), name
    assert one.files["encoder"] == read_json(run / "encoder" / "config.json")
    assert one.rows == read_episodes(run / "episodes.csv")
    assert one.id == identity(one.record, one.card)
    assert one.finished
    assert other.id == identity(read_json(before / "config.json"), {})
    assert other.losses == [(1, 0.5), (2, 0.25)]
    assert [content(run) for run in (one, other)] == [content(read_run(path)) for path in (run, before)]


def test_full_disk_leaves_results_unchanged(tmp_path, monkeypatch):
    begin = Path.open

    def full(path: Path, *args, **options):
        if path.name == f".{full_at}.tmp":
            raise OSError(errno.ENOSPC, "No space left on device")
        return begin(path, *args, **options)

    for number, full_at in enumerate(("runs.jsonl", "episodes.csv")):
        whole_run(tmp_path / "runs" / full_at, number)
        before = {path: path.read_bytes() for path in tmp_path.glob("out/*")}
        with monkeypatch.context() as patch:
            patch.setattr(Path, "open", full)
            with pytest.raises(UserError, match="the disk is full"):
                add_results([tmp_path / "runs"], tmp_path / "out")
        assert {path: path.read_bytes() for path in tmp_path.glob("out/[!.]*")} == before
        assert add_results([tmp_path / "runs"], tmp_path / "out").startswith("1 run added")


def test_resumed_run_names_every_machine_and_commit(tmp_path):
    run = whole_run(tmp_path / "run")
    first = {"processor": "A", "cores": 2, "gpu": None}
    later = [first | {"git_commit": "two"}, first | {"gpu": "B", "git_commit": "two"}]
    write_json(run / "machine.json", first | {"continued": later})
    write_json(run / "config.json", read_json(run / "config.json") | {"git_commit": "one"})
    result = read_run(run)
    assert (result.machine, result.commit) == ("A, 2 cores then B", "one then two")
    for damaged in ("two", [1], 5):
        write_json(run / "machine.json", first | {"continued": damaged})
        with pytest.raises(UserError, match="its files are damaged"):
            read_run(run)


def test_added_runs_are_unique_and_never_replaced(tmp_path, capsys):
    run = whole_run(tmp_path / "runs/0")
    (whole_run(tmp_path / "runs/1", seed=1) / "timing.json").unlink()
    words = ["results", "add", str(tmp_path / "runs"), "--out", str(tmp_path / "out")]
    main(words)
    assert capsys.readouterr().out == f"{tmp_path / 'out'}: 1 run added, 1 unfinished and left out\n"
    before = [content(one) for one in read_results(tmp_path / "out")]
    shutil.rmtree(run)
    whole_run(run, score=3.0)
    write_json(tmp_path / "runs/1/timing.json", {"seconds": 1.0})
    main(words)
    assert "1 run added, 1 there already with other rows or records, which stay" in capsys.readouterr().out
    assert [content(one) for one in read_results(tmp_path / "out")][:1] == before
    main(["results", "add", str(tmp_path / "out"), "--out", str(tmp_path / "copy")])
    main([*words[:3], "--out", str(tmp_path / "copy")])
    assert (tmp_path / "copy" / "runs.jsonl").read_bytes() == (tmp_path / "out" / "runs.jsonl").read_bytes()


@pytest.mark.parametrize(("name", "taken"), [("README.md", True), ("grid.toml", True), ("notes.txt", False)])
def test_results_folder_may_hold_page_and_grid(tmp_path, name, taken):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).touch()
    run = whole_run(tmp_path / "run")
    if taken:
        assert add_results([run], tmp_path / "out").startswith("1 run added")
    else:
        with pytest.raises(UserError, match="is not empty and holds no results; choose another"):
            add_results([run], tmp_path / "out")
        with pytest.raises(UserError, match="holds no runs"):
            read_results(tmp_path / "out")


def test_run_without_its_last_evaluation_is_rejected(tmp_path):
    run = whole_run(tmp_path / "run")
    write_json(run / "timing.json", {"seconds": 1.0, "updates": 10})
    record = read_json(run / "config.json")
    write_json(run / "config.json", record | {"config": record["config"] | {"eval_episodes": 1}})
    assert read_run(run).finished
    rows = (run / "episodes.csv").read_text().splitlines(keepends=True)
    (run / "episodes.csv").write_text("".join(rows[:-1]))
    with pytest.raises(UserError, match=r"has 0 of 1 episodes of the last evaluation; put it back, or remove"):
        read_run(run)


def test_diverged_run_is_added_and_replaced_once_finished(tmp_path):
    run = whole_run(tmp_path / "runs/0", score=1.5)
    (run / "timing.json").rename(tmp_path / "timing.json")
    write_json(run / "diverged.json", {"step": 7, "message": "critic_loss is nan"})
    for out in ("out", "report"):
        assert add_results([run], tmp_path / out) == "1 run added"
    (found,) = read_results(tmp_path / "out")
    assert (found.finished, found.ending, found.diverged["step"]) == (False, 1, 7)
    diverged = shutil.copytree(run, tmp_path / "diverged")
    (run / "diverged.json").unlink()
    shutil.rmtree(run)
    whole_run(run)
    for paths in ([run, tmp_path / "out"], [tmp_path / "out", run]):
        assert [found.finished for found in find_results(paths)] == [True]
    write_report([run], tmp_path / "report")
    assert add_results([run], tmp_path / "out") == "1 run added"
    for out in ("out", "report"):
        assert [(found.finished, found.rows[-1]["score"]) for found in read_results(tmp_path / out)] == [(True, 2.0)]
    assert add_results([diverged], tmp_path / "out").startswith("0 runs added, 1 there already with other rows")


def test_later_evaluations_are_added(tmp_path):
    """As by `evaluate --keep`: earlier rows stay."""
    run = whole_run(tmp_path / "runs/0")
    add_results([run], tmp_path / "out")
    write_report([run], tmp_path / "report")
    earlier = shutil.copytree(tmp_path / "out", tmp_path / "earlier")
    kept = [
        row | {"evaluated_under": "truncate", "score": 1.0, "return": 10.0}
        for row in read_episodes(run / "episodes.csv")
    ]
    append_episodes(run / "episodes.csv", kept[-1:])
    for paths in ([run, earlier], [earlier, run]):
        assert [len(found.rows) for found in find_results(paths)] == [3], "the copy with more evaluations"
    write_report([run], tmp_path / "report")
    assert add_results([run], tmp_path / "out") == "0 runs added, 1 there already, with later evaluations added"
    for out in ("report", "out"):
        assert read_results(tmp_path / out)[0].rows == read_run(run).rows
    copy, taken = shutil.copytree(run, tmp_path / "copy"), shutil.copytree(earlier, tmp_path / "taken")
    write_json(copy / "config.json", read_json(copy / "config.json") | {"git_commit": "another"})
    assert add_results([copy], taken) == "0 runs added, 1 there already, with later evaluations added"
    assert content(*read_results(taken)) == content(*read_results(tmp_path / "out")), "only rows are added"
    write_json(copy / "critic.json", {"value": 150.0, "moved": 0.05, "data": 160.0})
    taken = shutil.copytree(earlier, tmp_path / "other")
    assert add_results([copy], taken).startswith("0 runs added, 1 there already with other rows or records")
    assert content(*read_results(taken)) == content(*read_results(earlier))
    assert add_results([earlier], tmp_path / "out") == "0 runs added, 1 there already"
    assert len(read_results(tmp_path / "out")[0].rows) == 3
    assert [found.path for found in find_results([tmp_path / "out", earlier])] == [tmp_path / "out"]
    with pytest.raises(UserError, match="report: holds other rows or records of run"):
        write_report([earlier], tmp_path / "report")


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("critic.json", '{"value": 150.0, "moved": 0.5, "data": 160.0}'),
        ("reference.json", '{"data_return": 50.0, "actor": null, "path_error": 0.01, "mean_reward": 1.0}'),
        ("probe.json", '{"probe_pose": 1.5, "probe_velocity": null}'),
        ("results.json", '{"rows": [], "seconds": 2.0}'),
        ("metrics.jsonl", '{"step": 1, "action_loss": 0.1}\n{"step": 2, "action_loss": 0.25}\n'),
    ],
)
def test_copies_with_other_measures_are_rejected(tmp_path, file, text):
    """Else the order of the paths would decide verdicts."""
    run = (pretraining if file == "metrics.jsonl" else whole_run)(tmp_path / "run")
    if file == "results.json":
        write_json(run / file, {"rows": [], "seconds": 1.0})
    add_results([run], tmp_path / "out")
    before = (tmp_path / "out" / "runs.jsonl").read_bytes()
    (run / file).write_text(text)
    for paths in ([run, tmp_path / "out"], [tmp_path / "out", run]):
        with pytest.raises(UserError, match="two runs with the same method, setting and seed"):
            find_results(paths)
    assert add_results([run], tmp_path / "out").startswith("0 runs added, 1 there already with other rows or records")
    if file != "metrics.jsonl":
        with pytest.raises(UserError, match="out: holds other rows or records of run"):
            write_report([run], tmp_path / "out")
    assert (tmp_path / "out" / "runs.jsonl").read_bytes() == before


def test_copy_with_more_files_is_read_in_any_order(tmp_path):
    add_results([whole_run(tmp_path / "run")], tmp_path / "whole")
    (tmp_path / "run" / "critic.json").unlink()
    add_results([tmp_path / "run"], tmp_path / "less")
    for paths in ([tmp_path / "whole", tmp_path / "less"], [tmp_path / "less", tmp_path / "whole"]):
        assert ["critic" in run.files for run in find_results(paths)] == [True]


def test_report_does_not_replace_rows_of_a_finished_run(tmp_path):
    add_results([whole_run(tmp_path / "runs/0")], tmp_path / "kept")
    before = (tmp_path / "kept" / "episodes.csv").read_bytes()
    with pytest.raises(UserError, match=r"kept: holds other rows or records of run \w+, which would be lost"):
        write_report([whole_run(tmp_path / "again/0", score=3.0)], tmp_path / "kept")
    assert (tmp_path / "kept" / "episodes.csv").read_bytes() == before
    write_report([tmp_path / "runs"], tmp_path / "kept")


def test_truncated_row_of_unfinished_run_is_ignored(tmp_path):
    run = whole_run(tmp_path / "runs/0")
    whole_run(tmp_path / "runs/1", seed=1)
    (run / "timing.json").unlink()
    (run / "episodes.csv").write_text((run / "episodes.csv").read_text()[:-20])
    assert [row["step"] for row in read_run(run).rows] == [5]
    assert "unfinished" in write_report([tmp_path / "runs"], tmp_path / "report").page.read_text()


def test_interrupted_add_keeps_earlier_results(tmp_path, monkeypatch):
    add_results([whole_run(tmp_path / "runs/0")], tmp_path / "out")
    before = [content(run) for run in read_results(tmp_path / "out")]
    replace = Path.replace

    def killed(path: Path, target: Path) -> Path:
        if target.name == "runs.jsonl":
            raise KeyboardInterrupt
        return replace(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", killed)
        with pytest.raises(KeyboardInterrupt):
            add_results([whole_run(tmp_path / "runs/1", seed=1)], tmp_path / "out")
    assert {row["seed"] for row in read_episodes(tmp_path / "out" / "episodes.csv")} == {0, 1}, "one file was written"
    assert [content(run) for run in read_results(tmp_path / "out")] == before
    assert add_results([tmp_path / "runs"], tmp_path / "out") == "1 run added, 1 there already"
    assert [len(run.rows) for run in read_results(tmp_path / "out")] == [2, 2]


def test_run_found_in_folder_and_results_counts_once(tmp_path):
    runs = grid(tmp_path)
    add_results([runs / "acro0", runs / "mik+a1"], tmp_path / "some")
    assert [run.folder for run in find_results([tmp_path / "some", runs])].count(False) == 0, "folders take precedence"
    shutil.rmtree(runs / "acro0")
    found = find_results([runs, tmp_path / "some"])
    assert len(found) == len({run.id for run in found}) == 6
    assert [run.path for run in found if not run.folder] == [tmp_path / "some"]


def test_symlinked_runs_count_once(tmp_path):
    """Seeds may lie on other disks; a link to a parent folder must not cause endless recursion."""
    runs = grid(tmp_path / "disk")
    (tmp_path / "mixed").mkdir()
    (tmp_path / "mixed" / "seed0").symlink_to(runs / "acro0")
    assert len(find_results([tmp_path / "mixed"])) == 1
    (runs / "above").symlink_to(tmp_path)
    found = find_results([runs])
    assert len(found) == 6
    assert {run.path.parent for run in found} == {runs}, "the real folder is named, not a symlink"


def test_nested_results_folders_are_separate(tmp_path):
    for name, seed in (("outer", 0), ("outer/inner", 1)):
        run = write_run(tmp_path / f"runs/{seed}", "acro", seed, {10: [1.0]})
        add_results([run], tmp_path / name)
    shutil.rmtree(tmp_path / "runs")
    for paths, seeds in ((".",), {0}), (("outer",), {0}), (("outer/inner",), {1}), (("outer", "outer/inner"), {0, 1}):
        found = find_results([tmp_path / path for path in paths])
        assert {run.labels["seed"] for run in found} == seeds


BAD = {
    "runs.jsonl": [
        (lambda text: "", "is empty"),
        (lambda text: text[:40], "line 1: its files are damaged"),
        (lambda text: text + text, "names a run twice"),
        (lambda text: text.replace('"stage"', '"scene"', 1), "line 1: its files are damaged"),
        (lambda text: text.replace('"data_return": 500.0', '"data_return": "x"'), "reference"),
        (lambda text: text.replace('"seconds": 3.0', '"seconds": "x"'), "its files are damaged"),
    ],
    "episodes.csv": [
        (lambda text: "", "has 0 of 2 rows of run"),
        (lambda text: text.rpartition("\n")[0].rpartition("\n")[0] + "\n", "has 1 of 2 rows of run"),
        (lambda text: text.replace("id,", "name,", 1), "has no column 'id'"),
        (lambda text: text[:-20], "a row is not whole"),
    ],
}


@pytest.mark.parametrize(
    ("part", "odd"),
    [
        ("config", {"collection": [1]}),
        ("config", {"command": [1]}),
        ("config", {"plugins": [1]}),
        ("config", {"plugins": {"method acro": 1}}),
        ("config", {"inputs": []}),
        ("config", {"inputs": {"data": [1]}}),
        ("config", {"config": {"seed": 0, "data": 5}}),
        ("labels", {"method": 5}),
        ("labels", {"quality": None}),
        ("labels", {"seed": "x"}),
        ("encoder", {"pretrain": {"corruption": [1]}}),
    ],
)
def test_parts_of_other_types_are_rejected(tmp_path, part, odd):
    add_results([whole_run(tmp_path / "runs/0")], tmp_path / "out")
    file = tmp_path / "out" / "runs.jsonl"
    line = json.loads(file.read_text())
    file.write_text(json.dumps(line | {part: line[part] | odd}) + "\n")
    for words in (
        ["report", "out", "--out", "new"],
        ["results", "verify", "out"],
        ["results", "add", "out", "--out", "b"],
    ):
        with contextlib.chdir(tmp_path):
            assert "out/runs.jsonl: line 1: its files are damaged" in rejection(words)


CERTIFICATE = {
    **{"data": "f00", "corruption": {}, "name": "patch", "verdict": "needs a memory", "why": "R2", "made": "now"},
    **{"measured": {}, "budget": {"steps": 10, "updates": 0}},
}


def certified(folder: Path, place: Path, **changes: Any) -> None:
    """Write a certificate of the runs of a folder to a place."""
    (run,) = find_results([folder])
    place.mkdir(exist_ok=True)
    write_json(place / "certificates.json", {run.certificate: CERTIFICATE | changes})


def test_added_certificates_do_not_replace_those_there(tmp_path):
    run = whole_run(tmp_path / "runs/0")
    add_results([run], tmp_path / "mine")
    shutil.copytree(tmp_path / "mine", tmp_path / "theirs")
    certified(run, tmp_path / "mine")
    before = (tmp_path / "mine" / "certificates.json").read_bytes()
    assert add_results([tmp_path / "mine"], tmp_path / "mine") == "0 runs added, 1 there already"
    certified(run, tmp_path / "theirs", verdict="needs no memory", budget={"steps": 10**9, "updates": 10**9})
    assert add_results([tmp_path / "theirs"], tmp_path / "mine").endswith(
        "1 certificates unlike those there, which stay (remove those from certificates.json to replace them)"
    )
    assert (tmp_path / "mine" / "certificates.json").read_bytes() == before


@pytest.mark.parametrize("odd", [{"budget": [1]}, {"budget": {"steps": "x"}}, {"measured": None}])
def test_certificates_of_other_types_are_rejected(tmp_path, odd):
    add_results([whole_run(tmp_path / "runs/0")], tmp_path / "out")
    certified(tmp_path / "out", tmp_path / "out", **odd)
    with pytest.raises(UserError, match=r"certificates\.json: is damaged; remove it, or write it again"):
        write_report([tmp_path / "out"], tmp_path / "report")


def test_certificates_of_a_runs_dataset_are_not_searched_below_it(tmp_path):
    run = whole_run(tmp_path / "runs/0")
    record = read_json(run / "config.json")
    write_json(run / "config.json", record | {"config": record["config"] | {"data": str(tmp_path / "set")}})
    for place, found in (("set", True), ("set/below", False)):
        shutil.rmtree(tmp_path / "set", ignore_errors=True)
        (tmp_path / "set").mkdir()
        certified(run, tmp_path / place)
        assert bool(certificates_of([read_run(run)], [])) == found


def test_links_at_temporary_names_are_not_followed(tmp_path):
    whole_run(tmp_path / "runs/0")
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "out").mkdir()
    for name in ("runs.jsonl", "episodes.csv"):
        (tmp_path / "out" / f".{name}.tmp").symlink_to(tmp_path / "mine")
    add_results([tmp_path / "runs"], tmp_path / "out")
    assert (tmp_path / "mine").read_text() == "mine"
    assert len(read_results(tmp_path / "out")) == 1


@pytest.mark.parametrize(("name", "change", "words"), [(name, *case) for name, cases in BAD.items() for case in cases])
def test_damaged_results_are_rejected(tmp_path, name, change, words):
    add_results([whole_run(tmp_path / "runs/0")], tmp_path / "out")
    file = tmp_path / "out" / name
    file.write_text(change(file.read_text()))
    with pytest.raises(UserError, match=words) as found:
        write_report([tmp_path / "out"], tmp_path / "report")
    assert str(tmp_path / "out") in str(found.value)
    assert not (tmp_path / "report").exists()

"""Plans and attempts on the disk."""

import os
import shutil
from pathlib import Path

import pytest

from tests.helpers_sweeps import job
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import DiskFullError, UserError
from vd4rl_pomdp.runs import files
from vd4rl_pomdp.sweeps import folder as module
from vd4rl_pomdp.sweeps.folder import SweepFolder, plan_name
from vd4rl_pomdp.sweeps.plan import Job
from vd4rl_pomdp.sweeps.work import CAUSES, DONE, FAILED, Work, code_of, ended, told_seconds


def test_jobs_are_read_as_they_were_written_each_once(tmp_path):
    folder = SweepFolder(tmp_path)
    first = Job("a/b", "pretrain", tmp_path / "a" / "b", ("pretrain", "--seed", "0"), ("data/x",), True, (("k", "v"),))
    second = job(tmp_path, "c", "a/b")
    folder.keep_plan("one", [first])
    folder.keep_plan("two", [first, second])
    assert folder.jobs() == [first, second]


def test_two_drivers_write_a_plan_at_once(tmp_path, monkeypatch):
    """The second begins and ends while the first has written its file, and not yet put it in place."""
    folder, jobs, rest = SweepFolder(tmp_path), [job(tmp_path, "a"), job(tmp_path, "b")], []
    synchronise = files.synchronise

    def another(path):
        synchronise(path)
        if not rest:
            rest.append(1)
            folder.keep_plan("one", jobs[1:])

    monkeypatch.setattr(files, "synchronise", another)
    folder.keep_plan("one", jobs[:1])
    assert folder.jobs() == jobs[:1]
    assert [path.name for path in (tmp_path / "sweep" / "plans").iterdir()] == ["one.json"]


def test_a_damaged_plan_is_named(tmp_path):
    folder = SweepFolder(tmp_path)
    folder.keep_plan("one", [])
    (tmp_path / "sweep" / "plans" / "one.json").write_text("[{")
    with pytest.raises(UserError, match=r"one\.json: is damaged"):
        folder.jobs()


def paths(job):
    return job.folder.resolve()


def test_a_plan_is_read_from_elsewhere_and_carried_out_where_it_was_made(tmp_path, monkeypatch):
    """Its commands name folders as seen from there: elsewhere they would make other ones."""
    (tmp_path / "made").mkdir()
    monkeypatch.chdir(tmp_path / "made")
    out, data = Path("runs"), Path("../sets/walker")
    jobs = [Job("data/walker", "collect", data, ()), job(out, "mik", "data/walker")]
    SweepFolder(out).keep_plan("one", jobs)
    SweepFolder(out).own_jobs()
    monkeypatch.chdir(tmp_path)
    seen = SweepFolder(Path("made/runs"))
    assert [paths(job) for job in seen.jobs()] == [tmp_path / "sets" / "walker", tmp_path / "made" / "runs" / "mik"]
    with pytest.raises(UserError, match=r"^made/runs: was planned in /.*/made as runs: `sweep retry` it there, or"):
        seen.own_jobs()


def test_a_sweep_that_was_moved_is_judged_by_its_own_folders(tmp_path):
    out, data = tmp_path / "runs", tmp_path / "sets"
    SweepFolder(out).keep_plan("one", [Job("data/x", "collect", data, ()), job(out, "a")])
    out.rename(tmp_path / "moved")
    moved = SweepFolder(tmp_path / "moved")
    assert [job.folder for job in moved.jobs()] == [data, tmp_path / "moved" / "a"]
    with pytest.raises(UserError, match=r"was planned in .*plan it anew by `sweep run GRID --out .*moved`"):
        moved.own_jobs()


def test_a_sweep_of_a_file_of_ones_own_is_taken_up_again_by_that_file_alone(tmp_path, monkeypatch, capsys):
    mine, other = ({"init_main_from_path": str(tmp_path / f"{name}.py")} for name in ("mine", "other"))
    folder = SweepFolder(tmp_path)

    def from_file(file):
        monkeypatch.setattr(module, "own_file", lambda: file)

    monkeypatch.setattr(module, "parts_by_call", lambda jobs: (job.name for job in jobs if job.name != "c"))
    from_file(mine)
    folder.keep_plan("one", [job(tmp_path, "a")])
    assert [job.name for job in folder.own_jobs()] == ["a"]
    (tmp_path / "link.py").symlink_to(tmp_path / "mine.py")
    from_file({"init_main_from_path": str(tmp_path / "link.py")})
    assert [job.name for job in folder.own_jobs()] == ["a"]
    for here in ({}, other):
        from_file(here)
        with pytest.raises(UserError, match=r"parts that this process has not: start `python .*/mine.py sweep retry /"):
            folder.own_jobs()
    folder.keep_plan("two", [job(tmp_path, "b")])
    folder.keep_plan("of the program's own parts", [job(tmp_path, "c")])
    for here, names in ((mine, ["a", "c"]), (other, ["b", "c"]), ({}, ["c"])):
        from_file(here)
        capsys.readouterr()
        assert sorted(job.name for job in folder.own_jobs()) == names
        told = capsys.readouterr().err
        assert [file for file in ("mine", "other") if f"/{file}.py sweep retry" in told] == [
            file for file, own in (("mine", "a"), ("other", "b")) if own not in names
        ]


def test_absolute_folders_are_the_same_from_everywhere(tmp_path, monkeypatch):
    SweepFolder(tmp_path).keep_plan("one", [job(tmp_path, "a")])
    monkeypatch.chdir("/")
    SweepFolder(tmp_path).own_jobs()


@pytest.mark.parametrize("text", ["{}", "[3]", '[{"name": "a"}]', '{"from": "/", "out": "runs", "jobs": []}'])
def test_a_plan_of_something_else_is_named(tmp_path, text):
    folder = SweepFolder(tmp_path)
    folder.keep_plan("one", [])
    (tmp_path / "sweep" / "plans" / "one.json").write_text(text)
    with pytest.raises(UserError, match=r"one\.json: is damaged"):
        folder.jobs()


@pytest.mark.parametrize("cause", [DONE, *CAUSES])
def test_a_cause_comes_through_an_exit_code(tmp_path, cause):
    (tmp_path / "log").write_text("first\nlast line\n\n")
    found = ended(Work("a", (), tmp_path / "log"), code_of(cause))
    assert (found.cause, found.line) == (cause, "" if cause == DONE else "last line")


@pytest.mark.parametrize(("code", "cause"), [(-9, "killed"), (1, FAILED), (139, FAILED), (63, FAILED)])
def test_other_codes_are_kills_and_defects(tmp_path, code, cause):
    assert ended(Work("a", (), tmp_path / "nothing"), code).cause == cause


@pytest.mark.parametrize(("seconds", "text"), [(42, "42 s"), (99.6, "100 s"), (600, "10 min"), (12240, "3.4 h")])
def test_times_are_told_as_one_reads_them(seconds, text):
    assert told_seconds(seconds) == text


def test_the_row_after_one_that_a_full_disk_cut_is_whole(tmp_path, monkeypatch):
    folder, write = SweepFolder(tmp_path), os.write
    folder.add({"job": "a", "cause": FAILED})
    with monkeypatch.context() as patch:
        patch.setattr(os, "write", lambda handle, line: write(handle, line[:9]))
        with pytest.raises(DiskFullError):
            folder.add({"job": "a", "cause": FAILED})
    folder.forget("a")
    folder.add({"job": "b", "cause": DONE})
    assert folder.attempts() == {"b": [{"job": "b", "cause": DONE}]}


def test_a_part_of_a_grid_has_a_plan_of_its_own(tmp_path, monkeypatch):
    """So that two machines may share a grid by `--only`, and each sees what all of them do."""
    (tmp_path / "grid.toml").write_text(
        'preset = "smoke"\nseed = [0, 1]\n[collect]\ntask = "walker_walk"\nquality = "expert"\n'
        '[pretrain]\nmethod = "acro"\n'
    )
    monkeypatch.setattr("vd4rl_pomdp.cli.sweeps._carry_out", lambda *told: None)
    run = ["sweep", "run", str(tmp_path / "grid.toml"), "--out", str(tmp_path / "out")]
    for only in ("seed=0", "seed=1", "seed=1"):
        main([*run, "--only", only])
    names = {job.name for job in SweepFolder(tmp_path / "out").jobs()}
    assert {name.split("/")[-1 if name.startswith("data/") else -2] for name in names} == {"expert", "seed0", "seed1"}
    assert len(list((tmp_path / "out" / "sweep" / "plans").iterdir())) == 2
    (tmp_path / "other").mkdir()
    shutil.copy(tmp_path / "grid.toml", tmp_path / "other")
    main(["sweep", "run", str(tmp_path / "other" / "grid.toml"), "--out", str(tmp_path / "out"), "--only", "seed=0"])
    assert len(list((tmp_path / "out" / "sweep" / "plans").iterdir())) == 3, "another file is another grid"
    assert plan_name("grid", []) == "grid"
    assert plan_name("grid", ["b=1", "a=0"]) == plan_name("grid", ["a=0", "b=1"]) != plan_name("grid", ["a=0"])

"""Plans and attempts on the disk."""

import pytest

from tests.helpers_sweeps import job
from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.runs import files
from vd4rl_pomdp.sweeps.folder import SweepFolder
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


@pytest.mark.parametrize("text", ["{}", "[3]", '[{"name": "a"}]'])
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

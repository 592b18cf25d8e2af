"""What is started when, what is tried again, and that nothing is done twice."""

import errno
import os
import shutil
import time
from dataclasses import replace
from pathlib import Path

import pytest

from tests.helpers_sweeps import Scripted, finish, job
from vd4rl_pomdp.sweeps import driver
from vd4rl_pomdp.sweeps.driver import Driver, given_up
from vd4rl_pomdp.sweeps.folder import SweepFolder


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(driver, "POLL_S", 0.0)
    monkeypatch.setattr(driver, "PAUSE_S", 0.0)
    monkeypatch.setattr(driver, "IN_USE_S", 0.0)


@pytest.fixture
def jobs(tmp_path):
    return [job(tmp_path, "set"), job(tmp_path, "a", "set"), job(tmp_path, "b", "set", "a"), job(tmp_path, "c", "set")]


def carry_out(jobs, tmp_path, script=None, slots=2):
    executor = Scripted(jobs, script, slots)
    return Driver(jobs, executor, SweepFolder(tmp_path)).run(), executor


def names(executor):
    return [name for name, _ in executor.started]


def test_every_job_runs_once_after_those_it_needs(jobs, tmp_path):
    finished, executor = carry_out(jobs, tmp_path)
    assert finished
    assert names(executor) == ["set", "a", "c", "b"]
    assert executor.most == 2


def test_no_more_run_at_a_time_than_there_are_slots(jobs, tmp_path):
    assert carry_out(jobs, tmp_path, slots=1)[1].most == 1


def test_what_is_finished_is_not_run_again(jobs, tmp_path):
    carry_out(jobs, tmp_path)
    assert carry_out(jobs, tmp_path)[1].started == []


@pytest.mark.parametrize(
    ("cause", "attempts"),
    [
        *[("killed", 5), ("out of memory", 5), ("disk full", 5), ("unavailable", 5)],
        *[("failed", 1), ("refused", 1), ("diverged", 1)],
    ],
)
def test_a_cause_decides_how_often_a_job_is_tried(jobs, tmp_path, cause, attempts):
    finished, executor = carry_out(jobs, tmp_path, {"a": [cause] * 99})
    assert not finished
    assert names(executor).count("a") == attempts
    assert "c" in names(executor), "the others go on"
    assert "b" not in names(executor), "what needs it does not"


def test_a_killed_job_that_gets_further_is_tried_as_often_as_it_takes(jobs, tmp_path, monkeypatch):
    steps = iter(range(100))
    monkeypatch.setattr(driver, "progress_of", lambda job: next(steps))
    finished, executor = carry_out(jobs, tmp_path, {"a": ["killed"] * 30})
    assert finished
    assert names(executor).count("a") == 31


@pytest.mark.parametrize("cause", ["out of memory", "killed"])
def test_a_job_that_the_memory_may_not_have_sufficed_for_has_half_as_many_beside_it(jobs, tmp_path, cause):
    """The kernel kills without saying why."""
    finished, executor = carry_out(jobs, tmp_path, {"a": [cause] * 3}, slots=4)
    assert finished
    assert [slots for name, slots in executor.started if name == "a"] == [1, 2, 4, 4]


def test_what_another_driver_has_given_up_is_not_tried_here(jobs, tmp_path, monkeypatch):
    executor, other = Scripted(jobs), SweepFolder(tmp_path)
    start = executor.start

    def meanwhile(work):
        start(work)
        if work.name == "set":
            other.add({"job": "a", "cause": "refused", "line": "", "step": 0, "ended": 0.0})

    monkeypatch.setattr(executor, "start", meanwhile)
    assert not Driver(jobs, executor, SweepFolder(tmp_path)).run()
    assert names(executor) == ["set", "c"]


def test_a_pause_is_kept_whoever_made_the_last_attempt(jobs, tmp_path, monkeypatch):
    monkeypatch.setattr(driver, "PAUSE_S", 3600.0)
    monkeypatch.setattr(driver, "IDLE_S", 0.2)
    SweepFolder(tmp_path).add({"job": "set", "cause": "disk full", "line": "", "step": 0, "ended": time.time()})
    executor = Scripted(jobs)
    assert not Driver(jobs, executor, SweepFolder(tmp_path), helps=True).run()
    assert executor.started == []


def test_a_driver_that_helps_ends_when_others_have_all_that_could_start(jobs, tmp_path, monkeypatch):
    monkeypatch.setattr(driver, "IDLE_S", 0.2)
    monkeypatch.setattr(driver, "in_use", lambda folder: folder.name == "a")
    executor = Scripted(jobs)
    assert not Driver(jobs, executor, SweepFolder(tmp_path), helps=True).run()
    assert sorted(names(executor)) == ["c", "set"]


def test_a_job_that_another_driver_began_first_costs_no_attempt(jobs, tmp_path):
    assert carry_out(jobs, tmp_path, {"a": ["in use"] * 9})[0]
    assert [row["cause"] for row in SweepFolder(tmp_path).attempts()["a"]] == ["done"]


def test_a_job_of_another_command_has_not_been_tried(jobs, tmp_path):
    carry_out(jobs, tmp_path, {"a": ["refused"]})
    corrected = [replace(one, words=("list", "--device", "cpu")) if one.name == "a" else one for one in jobs]
    finished, executor = carry_out(corrected, tmp_path)
    assert finished
    assert names(executor) == ["a", "b"]


def test_a_job_whose_own_part_was_mended_has_not_been_tried(jobs, tmp_path, monkeypatch):
    of_files = {"sources": {"method mine": "mine.py 1"}}
    monkeypatch.setattr("vd4rl_pomdp.sweeps.driver.sources", lambda settings: of_files["sources"])
    monkeypatch.setattr("vd4rl_pomdp.core.registry.sources", lambda settings: of_files["sources"])
    carry_out(jobs, tmp_path, {"a": ["refused"]})
    assert "a" not in names(carry_out(jobs, tmp_path)[1])
    of_files["sources"] = {"method mine": "mine.py 2"}
    finished, executor = carry_out(jobs, tmp_path)
    assert finished
    assert names(executor) == ["a", "b"]


def test_a_disk_that_does_not_answer_costs_one_attempt_and_no_other_job(jobs, tmp_path, monkeypatch):
    silent, progress_of = [errno.ESTALE, errno.EIO], driver.progress_of

    def ask(job):
        if job.name == "a" and silent:
            raise OSError(silent.pop(), "it does not answer")
        return progress_of(job)

    monkeypatch.setattr(driver, "progress_of", ask)
    finished, executor = carry_out(jobs, tmp_path, {"a": ["killed"]})
    assert finished
    assert not executor.stopped
    assert [row["cause"] for row in SweepFolder(tmp_path).attempts()["a"]] == ["unavailable", "unavailable"]


@pytest.mark.parametrize("where", ["in_use", "progress_of"])
def test_a_folder_that_may_not_be_used_costs_its_own_job_alone(jobs, tmp_path, monkeypatch, where):
    """As one that another user's driver made: before the job begins, or after it has ended."""
    done = getattr(driver, where)

    def ask(asked):
        folder = asked if where == "in_use" else asked.folder
        if folder.name == "c":
            raise PermissionError(errno.EACCES, "Permission denied")
        return done(asked)

    monkeypatch.setattr(driver, where, ask)
    finished, executor = carry_out(jobs, tmp_path)
    assert finished == (where == "progress_of"), "its folder tells it in the end"
    assert [name for name in names(executor) if name != "c"] == ["set", "a", "b"]
    (row,) = SweepFolder(tmp_path).attempts()["c"]
    assert row["cause"] == "refused"
    assert "may not be used" in row["line"]


def test_a_job_that_cannot_be_started_costs_itself_alone(jobs, tmp_path, monkeypatch):
    executor = Scripted(jobs)
    start = executor.start

    def refused(work):
        if work.name == "c":
            raise OSError(errno.ENAMETOOLONG, "File name too long")
        start(work)

    monkeypatch.setattr(executor, "start", refused)
    assert not Driver(jobs, executor, SweepFolder(tmp_path)).run()
    assert names(executor) == ["set", "a", "b"]
    assert SweepFolder(tmp_path).attempts()["c"][-1]["cause"] == "refused"


def test_what_a_network_disk_shows_late_is_looked_for_anew(jobs, tmp_path, monkeypatch):
    """NFS may remember that a file was not there, until its folder is listed."""
    listed, is_file, listdir = set(), Path.is_file, os.listdir
    monkeypatch.setattr(
        Path, "is_file", lambda path: (path.name == "attempts.jsonl" or str(path.parent) in listed) and is_file(path)
    )
    monkeypatch.setattr(os, "listdir", lambda folder: listed.add(str(folder)) or listdir(folder))
    finished, executor = carry_out(jobs, tmp_path)
    assert finished
    assert names(executor) == ["set", "a", "c", "b"], "once each"


def test_failures_stay_until_they_are_taken_up_again(jobs, tmp_path):
    carry_out(jobs, tmp_path, {"a": ["diverged"]})
    assert "a" not in names(carry_out(jobs, tmp_path)[1])
    SweepFolder(tmp_path).forget("a")
    finished, executor = carry_out(jobs, tmp_path)
    assert finished
    assert names(executor) == ["a", "b"]


def test_a_job_that_was_given_up_here_and_finished_elsewhere_is_finished(jobs, tmp_path, monkeypatch):
    executor = Scripted(jobs, {"c": ["diverged"]})
    worker, collect = Driver(jobs, executor, SweepFolder(tmp_path)), Driver._collect

    def meanwhile(own):
        collect(own)
        if "c" in own._lost:
            finish(jobs[3].folder)

    monkeypatch.setattr(Driver, "_collect", meanwhile)
    assert worker.run()
    assert names(executor).count("c") == 1


def test_a_job_that_another_driver_finished_meanwhile_is_left_alone(jobs, tmp_path):
    executor = Scripted(jobs)
    worker = Driver(jobs, executor, SweepFolder(tmp_path))
    for other in jobs[:2]:
        finish(other.folder)
    assert worker.run()
    assert sorted(names(executor)) == ["b", "c"]


def test_a_job_that_another_process_is_at_is_waited_for(jobs, tmp_path, monkeypatch):
    asked = []

    def busy(folder):
        asked.append(folder.name)
        return asked.count("a") < 5 and folder.name == "a"

    monkeypatch.setattr(driver, "in_use", busy)
    finished, executor = carry_out(jobs, tmp_path)
    assert finished
    assert names(executor).count("a") == 1
    assert asked.count("a") == 5


@pytest.mark.parametrize("other", [{"seed": 1}, {"content": "another set"}])
def test_another_run_that_came_into_a_jobs_folder_does_not_finish_it(jobs, tmp_path, other):
    finish(jobs[0].folder, **other)
    _, executor = carry_out(jobs, tmp_path)
    assert names(executor)[0] == "set"


def test_what_was_done_once_and_is_gone_is_done_again(jobs, tmp_path):
    carry_out(jobs, tmp_path)
    shutil.rmtree(tmp_path / "a")
    finished, executor = carry_out(jobs, tmp_path)
    assert finished
    assert names(executor) == ["a"]


def test_a_job_that_ends_well_and_leaves_nothing_has_failed(jobs, tmp_path):
    executor = Scripted(jobs)
    executor.folders["c"] = tmp_path / "elsewhere"
    assert not Driver(jobs, executor, SweepFolder(tmp_path)).run()
    assert names(executor).count("c") == 1
    row = SweepFolder(tmp_path).attempts()["c"][-1]
    assert row["cause"] == "failed"
    assert "holds nothing finished" in row["line"]


def test_an_interruption_stops_the_jobs_and_is_told(jobs, tmp_path, monkeypatch):
    executor = Scripted(jobs)

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(driver.interrupt, "check", interrupted)
    with pytest.raises(KeyboardInterrupt):
        Driver(jobs, executor, SweepFolder(tmp_path)).run()
    assert executor.stopped


@pytest.mark.parametrize(
    ("number", "cause"), [(errno.ENOSPC, "disk full"), (errno.EAGAIN, "unavailable"), (errno.ENOMEM, "out of memory")]
)
def test_what_passes_at_the_start_of_a_job_is_tried_again(jobs, tmp_path, monkeypatch, number, cause):
    executor = Scripted(jobs)
    start, refused = executor.start, [True]

    def refused_once(work):
        if refused and refused.pop():
            raise OSError(number, os.strerror(number))
        start(work)

    monkeypatch.setattr(executor, "start", refused_once)
    assert Driver(jobs, executor, SweepFolder(tmp_path)).run()
    assert [row["cause"] for row in SweepFolder(tmp_path).attempts()["set"]] == [cause, "done"]


def test_rows_tell_every_attempt(jobs, tmp_path):
    carry_out(jobs, tmp_path, {"a": ["killed"]})
    rows = SweepFolder(tmp_path).attempts()["a"]
    assert [(row["cause"], row["line"]) for row in rows] == [("killed", "its killed line"), ("done", "")]


def test_a_row_that_a_full_disk_cut_is_left_out(tmp_path):
    history = SweepFolder(tmp_path)
    history.add({"job": "a", "cause": "killed", "step": 0})
    with (tmp_path / "sweep" / "attempts.jsonl").open("a") as file:
        file.write('{"job": "a", "cau\n')
    history.add({"job": "a", "cause": "killed", "step": 0})
    assert len(history.attempts()["a"]) == 2


def test_attempts_count_from_the_last_checkpoint_or_interruption():
    killed, interrupted = {"cause": "killed", "step": 0}, {"cause": "interrupted", "step": 0}
    assert given_up([killed] * 5) == "killed"
    assert given_up([killed] * 4) == given_up([*[killed] * 4, interrupted, *[killed] * 4]) == ""
    assert given_up([*[killed] * 4, killed | {"step": 5}]) == ""
    assert given_up([killed | {"cause": "abducted"}]) == "abducted", "of another version"

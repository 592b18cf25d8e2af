"""What is started when, what is tried again, and that nothing is done twice."""

import errno
import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from tests.helpers_sweeps import Scripted, finish, job
from vd4rl_pomdp.sweeps import driver
from vd4rl_pomdp.sweeps.driver import Driver, Retry, given_up
from vd4rl_pomdp.sweeps.folder import SweepFolder


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(driver, "POLL_S", 0.0)
    without_waits = {cause: Retry(retry.times) for cause, retry in driver.RETRIES.items()}
    monkeypatch.setattr(driver, "RETRIES", without_waits)


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
        ("killed", 5),
        ("failed", 2),
        ("out of memory", 2),
        ("disk full", 21),
        ("unavailable", 21),
        ("refused", 1),
        ("diverged", 1),
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


def test_out_of_memory_is_tried_with_twice_the_slots_while_half_as_many_run(jobs, tmp_path):
    finished, executor = carry_out(jobs, tmp_path, {"a": ["out of memory"]}, slots=4)
    assert finished
    assert [slots for name, slots in executor.started if name == "a"] == [1, 2]


def test_without_more_slots_out_of_memory_is_final(jobs, tmp_path):
    _, executor = carry_out(jobs, tmp_path, {"a": ["out of memory"]}, slots=1)
    assert names(executor).count("a") == 1


def test_out_of_memory_with_less_than_all_slots_is_not_final_whoever_looks(jobs, tmp_path):
    carry_out(jobs, tmp_path, {"a": ["out of memory"] * 2}, slots=2)
    once, twice = SweepFolder(tmp_path).attempts()["a"]
    assert (given_up([once]), given_up([once, twice])) == ("", "out of memory")


def test_out_of_memory_beside_others_is_tried_again_where_there_is_one_slot(jobs, tmp_path):
    folder = SweepFolder(tmp_path)
    folder.add({"job": "set", "cause": "out of memory", "step": None, "slots": 1, "largest": 2})
    finished, executor = carry_out(jobs, tmp_path, slots=1)
    assert finished
    assert executor.started[0] == ("set", 1)


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
    finished, executor = carry_out(jobs, tmp_path, {"a": ["failed"]})
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
    monkeypatch.setattr(Path, "is_file", lambda path: str(path.parent) in listed and is_file(path))
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
    monkeypatch.setitem(driver.RETRIES, "in use", Retry(10**6, 0.01))
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
    assert names(executor).count("c") == 2
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
    assert [(row["cause"], row["line"], row["slots"]) for row in rows] == [
        ("killed", "its killed line", 1),
        ("done", "", 1),
    ]


def test_a_cause_counts_in_a_row_only():
    rows = [{"cause": cause, "step": 0, "slots": 1} for cause in ["killed"] * 4 + ["interrupted"] + ["killed"] * 4]
    assert given_up(rows) == ""
    assert given_up([*rows, rows[0]]) == "killed"


def test_causes_that_take_turns_at_one_step_are_given_up():
    rows = [{"cause": cause, "step": 0, "slots": 1} for cause in ("failed", "killed", "failed")]
    assert (given_up(rows[:2]), given_up(rows)) == ("", "failed")
    assert given_up([rows[0], rows[1] | {"step": 5}, rows[2] | {"step": 5}]) == ""


def test_a_job_that_waits_for_its_time_is_not_forgotten(jobs, tmp_path, monkeypatch):
    monkeypatch.setitem(driver.RETRIES, "disk full", Retry(3, 0.02))
    finished, executor = carry_out(jobs[:1], tmp_path, {"set": ["disk full"] * 3})
    assert finished
    assert len(executor.started) == 4


def test_an_attempt_of_another_version_counts_as_final(tmp_path):
    assert given_up([{"cause": "abducted", "step": 0, "slots": 1}]) == "abducted"

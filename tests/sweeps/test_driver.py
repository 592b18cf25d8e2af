"""The sweep driver: job order, retries, shared work and reports; with real processes."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from multiprocessing import get_context

import pytest

from tests.helpers_bad_input import rejection
from tests.helpers_sweeps import RECORD, begun, job, keep_plan, until
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import TEMPORARY, DiskFullError, UserError
from vd4rl_pomdp.runs.files import write_json
from vd4rl_pomdp.sweeps import driver
from vd4rl_pomdp.sweeps.driver import Driver, Place
from vd4rl_pomdp.sweeps.folder import TRIES, SweepFolder, is_finished, lost_among, status
from vd4rl_pomdp.sweeps.options import JOB_VARIABLE, LocalOptions


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    for name, seconds in {"POLL_S": 0.01, "PAUSE_S": 0.0, "IN_USE_S": 0.1, "IDLE_S": 0.5}.items():
        monkeypatch.setattr(driver, name, seconds)


def sweep(out, *jobs, at_once=2, **options):
    return Driver([keep_plan(out, *jobs)], LocalOptions(jobs=at_once), SweepFolder(out), **options).run()


def causes(out, job):
    return [row["cause"] for row in SweepFolder(out).attempts([job])[job.name]]


@pytest.mark.parametrize("at_once", [1, 2])
def test_jobs_run_once_in_dependency_order(tmp_path, at_once):
    a, b, c = jobs = [job(tmp_path, "a"), job(tmp_path, "b", "a"), job(tmp_path, "c", "a")]
    assert sweep(tmp_path, *jobs, at_once=at_once)
    assert sweep(tmp_path, *jobs, at_once=at_once), "finished jobs are not repeated"
    spans = [(seen["time"], float((one.folder / "ended").read_text())) for one in jobs for seen in begun(one)]
    assert len(spans) == 3
    assert spans[0][1] < min(spans[1][0], spans[2][0])
    if at_once == 1:
        assert spans[1][1] < spans[2][0] or spans[2][1] < spans[1][0]
    assert [causes(tmp_path, one) for one in (a, b, c)] == [["done"]] * 3


@pytest.mark.parametrize(("end", "cause", "attempts"), [
    ("kill", "killed", TRIES), (143, "killed", TRIES), (TEMPORARY, "unavailable", TRIES), ("defect", "failed", 1),
    (1, "failed", 1), (2, "failed", 1),
])  # fmt: skip
def test_temporary_failures_are_retried_and_failures_reported(tmp_path, capsys, end, cause, attempts):
    bad, after, other = jobs = [
        job(tmp_path, "bad", ends=(end,) * attempts), job(tmp_path, "after", "bad"), job(tmp_path, "other"),
    ]  # fmt: skip
    assert not sweep(tmp_path, *jobs)
    assert (causes(tmp_path, bad), begun(after), other.finished) == ([cause] * attempts, [], True)
    assert not sweep(tmp_path, *jobs), "failed jobs are not repeated"
    assert len(begun(bad)) == attempts
    capsys.readouterr()
    main(["sweep", "status", str(tmp_path), "--json"])
    status = json.loads(capsys.readouterr().out)
    assert status["states"] == {"bad": "failed", "after": "blocked", "other": "done"}
    line = "ValueError: what is wrong" if end == "defect" else "its last line"
    assert status["failures"]["bad"]["line"] == line
    main(["sweep", "retry", str(tmp_path)])
    assert capsys.readouterr().out == "all 3 jobs are finished\n"
    assert (len(begun(bad)), len(begun(other))) == (attempts + 1, 1)


def test_failed_sweep_prints_failures_and_retry_command(tmp_path, capsys):
    keep_plan(tmp_path, job(tmp_path, "bad", ends=(2,)))
    with pytest.raises(SystemExit, match="1"):
        main(["sweep", "retry", str(tmp_path)])
    shown = capsys.readouterr()
    assert shown.err.splitlines()[-1] == f"failed: bad: its last line (see {tmp_path}/sweep/logs/bad.log)"
    program = tmp_path / "program.py"
    line = f"1 of 1 jobs are not finished, 1 failed; `python {program} sweep retry {tmp_path}` retries them\n"
    assert shown.out == line
    main(["sweep", "status", str(tmp_path)])
    assert "1 jobs: 1 failed\n" in capsys.readouterr().out


def test_corrected_command_runs_again(tmp_path):
    bad, flaky = job(tmp_path, "bad", ends=(2,)), job(tmp_path, "flaky", ends=("kill",) * (TRIES - 1))
    assert not sweep(tmp_path, bad, flaky)
    assert flaky.finished
    assert sweep(tmp_path, replace(bad, words=[*bad.words, "--corrected"]), flaky)


def test_job_without_finished_run_has_failed(tmp_path):
    nothing, another = job(tmp_path, "nothing", ends=(0,)), replace(job(tmp_path, "another"), recipe="of another run")
    assert not sweep(tmp_path, nothing, another)
    for one in (nothing, another):
        (row,) = SweepFolder(tmp_path).attempts([one])[one.name]
        assert row["line"] == f"{one.folder}: holds nothing finished, though the command ended well"


def test_deleted_run_is_repeated(tmp_path):
    one = job(tmp_path, "one")
    sweep(tmp_path, one)
    shutil.rmtree(one.folder)
    assert sweep(tmp_path, one)


def command(*words):
    """Run a sweep command in a fork, which need not import the package again."""
    process = get_context("fork").Process(target=main, args=(["sweep", *map(str, words)],))
    process.start()
    return process


def code(process):
    process.join(60)
    return process.exitcode


def test_other_drivers_take_over_after_a_killed_driver(tmp_path):
    """Jobs started by the killed driver continue, and the others wait for them."""
    jobs = [job(tmp_path, name, ends=("wait",)) for name in "abcdef"]
    keep_plan(tmp_path, *jobs)
    first = command("retry", tmp_path, "--jobs", "2")
    until(lambda: sum(map(len, map(begun, jobs))) == 2)
    first.kill()
    first.join()
    others = [command("retry", tmp_path, "--jobs", "1"), command("join", tmp_path, "--jobs", "1")]
    until(lambda: sum(map(len, map(begun, jobs))) == 4)
    (tmp_path / "go").touch()
    assert code(others[0]) == 0
    others[1].kill()
    others[1].join()
    assert [len(begun(one)) for one in jobs] == [1] * 6
    assert all(map(is_finished, jobs))


def test_interrupted_jobs_do_not_count_as_attempts(tmp_path):
    one = job(tmp_path, "one", ends=("wait",) * 9)
    keep_plan(tmp_path, one)
    process = command("retry", tmp_path)
    until(lambda: begun(one))
    process.terminate()
    assert code(process) == 143
    assert causes(tmp_path, one) == ["interrupted"]
    (tmp_path / "go").touch()
    main(["sweep", "retry", str(tmp_path)])


SIGNALLED = """
import signal
from vd4rl_pomdp.cli import main, studies
from vd4rl_pomdp.runs import interrupt

def bench(words, program):
    with interrupt.deferred():
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)
        print("a checkpoint is written", flush=True)

studies.bench = bench
main(["bench"])
"""


def test_second_signal_does_not_kill_a_job(monkeypatch):
    """A cluster signals all processes of a task; then the driver also signals its jobs."""

    def end():
        done = subprocess.run([sys.executable, "-c", SIGNALLED], capture_output=True, text=True, check=False)
        return done.returncode, done.stdout

    assert end() == (-signal.SIGTERM, "")
    monkeypatch.setenv(JOB_VARIABLE, "1")
    assert end() == (143, "a checkpoint is written\n")


def test_joined_driver_reports_left_work_by_its_exit_code(tmp_path):
    keep_plan(tmp_path, job(tmp_path, "bad", ends=(2,)))
    with pytest.raises(SystemExit, match="1"):
        main(["sweep", "join", str(tmp_path)])
    (tmp_path / "sweep" / "attempts.jsonl").unlink()
    main(["sweep", "join", str(tmp_path)])


def test_joined_driver_ends_when_no_job_can_start(tmp_path):
    one, _ = jobs = [job(tmp_path, "one", ends=("wait",)), job(tmp_path, "after", "one")]
    keep_plan(tmp_path, *jobs)
    process = command("retry", tmp_path)
    until(lambda: begun(one))
    assert not sweep(tmp_path, *jobs, helps=True)
    (tmp_path / "go").touch()
    assert code(process) == 0
    assert [len(begun(one)) for one in jobs] == [1, 1]


def test_failure_is_known_before_the_jobs_that_need_it_in_any_order(tmp_path):
    """Plans of two grids may list a policy before its encoder."""
    jobs = [job(tmp_path, "last", "after"), job(tmp_path, "after", "one"), job(tmp_path, "one", ends=(1,))]
    assert not sweep(tmp_path, *jobs)
    assert lost_among(jobs, SweepFolder(tmp_path).attempts(jobs)) == {"one", "after", "last"}


def test_drivers_pause_after_temporary_failures(tmp_path, monkeypatch):
    one = job(tmp_path, "one", ends=(TEMPORARY,))
    monkeypatch.setattr(driver, "PAUSE_S", 1.0)
    assert sweep(tmp_path, one)
    first, second = (seen["time"] for seen in begun(one))
    assert second - first > 1
    monkeypatch.setattr(driver, "PAUSE_S", 3600.0)
    two = job(tmp_path, "two")
    row = {"job": "two", "cause": "killed", "line": "", "seconds": 1.0, "words": two.words}
    SweepFolder(tmp_path).add(row | {"ended": time.time()})
    assert not sweep(tmp_path, two, helps=True)
    assert begun(two) == []


def test_unwritable_log_fails_only_its_job(tmp_path):
    (tmp_path / "sweep" / "logs").mkdir(parents=True)
    (tmp_path / "sweep" / "logs" / "a.log").mkdir()
    a, b = jobs = [job(tmp_path, "a"), job(tmp_path, "b")]
    assert not sweep(tmp_path, *jobs)
    assert causes(tmp_path, a) == ["unavailable"] * TRIES
    assert b.finished


def test_jobs_divide_cores_and_gpus(tmp_path, monkeypatch):
    monkeypatch.setattr(driver, "visible_gpus", list)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    assert [place.cores for place in driver.places(LocalOptions(jobs=3))] == [(0, 1), (2, 3, 4), (5, 6, 7)]
    assert [place.cores for place in driver.places(LocalOptions(jobs=16))] == [(n // 2,) for n in range(16)]
    assert len(driver.places(LocalOptions())) == 1, "one per GPU, or one"
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "4")
    unbound = driver.places(LocalOptions(jobs=2))
    assert [(len(place.cores), place.pinned) for place in unbound] == [(2, False)] * 2, "of 4 unbound ones"
    monkeypatch.undo()
    monkeypatch.setattr(driver, "visible_gpus", lambda: ["2", "5"])
    assert sorted(place.gpu for place in driver.places(LocalOptions(jobs_per_gpu=3))) == ["2"] * 3 + ["5"] * 3
    with pytest.raises(UserError, match="is more than 2 GPUs take"):
        driver.places(LocalOptions(jobs=3))
    with monkeypatch.context() as patch:  # as on macOS
        patch.delattr(os, "sched_getaffinity")
        patch.setattr(os, "cpu_count", lambda: 8)
        assert [(len(place.cores), place.pinned) for place in driver.places(LocalOptions())] == [(4, False)] * 2
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    one, before = job(tmp_path, "one"), os.sched_getaffinity(0)
    sweep(tmp_path, one)
    (seen,) = begun(one)
    share = max(1, len(before) // 2)
    assert (seen["CUDA_VISIBLE_DEVICES"], seen["OMP_NUM_THREADS"], seen["cores"]) == ("2", str(share), share)
    assert os.sched_getaffinity(0) == before


def test_jobs_prefer_the_least_busy_gpu(tmp_path, monkeypatch):
    monkeypatch.setattr(driver, "places", lambda _: [Place((0,), gpu, pinned=False) for gpu in "0011"])
    jobs = [job(tmp_path, name) for name in "ab"]
    assert sweep(tmp_path, *jobs)
    assert {begun(one)[0]["CUDA_VISIBLE_DEVICES"] for one in jobs} == {"0", "1"}


@pytest.mark.parametrize(("threads", "expected"), [(0, "7"), (3, "3")])
def test_job_threads_come_from_the_flag_then_the_environment(tmp_path, monkeypatch, threads, expected):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    one = job(tmp_path, "one")
    assert Driver([keep_plan(tmp_path, one)], LocalOptions(threads=threads), SweepFolder(tmp_path)).run()
    assert begun(one)[0]["OMP_NUM_THREADS"] == expected


def test_failure_counts_while_its_row_cannot_be_written(tmp_path, monkeypatch, capsys):
    bad, _ = jobs = [job(tmp_path, "bad", ends=(1,) * 9), job(tmp_path, "slow", ends=("wait",))]
    add, tries = SweepFolder.add, []

    def full(folder, row):
        tries.append(row)
        if len(tries) == 1:
            (tmp_path / "go").touch()
            raise DiskFullError("the disk is full")
        add(folder, row)

    monkeypatch.setattr(SweepFolder, "add", full)
    assert not sweep(tmp_path, *jobs)
    assert len(begun(bad)) == 1
    assert capsys.readouterr().err.count("warning: the disk is full") == 1
    assert [causes(tmp_path, one) for one in jobs] == [["failed"], ["done"]], "both are written in the end"


def test_sweep_outlives_a_full_disk_under_its_log(tmp_path, monkeypatch):
    finished = None
    with suppress(OSError), open("/dev/full", "w", buffering=1) as full, monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", full)
        finished = sweep(tmp_path, job(tmp_path, "one", ends=(TEMPORARY,)))
    assert finished


def attempt(one, ended, seconds, cause="done"):
    return {"job": one.name, "cause": cause, "line": "", "words": one.words, "ended": ended, "seconds": seconds}


@pytest.mark.parametrize(("ends", "seconds", "per_hour"), [
    ([0.0, *(86400 + 30.0 * n for n in range(10))], 30, 120),  # after a pause of a day
    ([10800.0 * n for n in range(3)], 10800, 1 / 3),
    ([10800.0, 10800, 21600, 21600], 10800, 2 / 3),  # two at a time
])  # fmt: skip
@pytest.mark.parametrize("repeated", [False, True])
def test_time_left_follows_the_last_finished_jobs(tmp_path, ends, seconds, per_hour, repeated):
    now = time.time()
    made, left = ([job(tmp_path, f"{kind}{n}") for n in range(len(ends))] for kind in ("made", "left"))
    rows = {
        one.name: [attempt(one, now - ends[-1] + end, seconds)] * (1 + repeated)
        for one, end in zip(made, ends, strict=True)
    }
    for one in made:
        write_json(one.folder / "config.json", RECORD)
        write_json(one.folder / "timing.json", {})
    found = status([*made, *left], rows | {one.name: [] for one in left})
    assert found["counts"] == {"done": len(ends), "waiting": len(ends)}
    assert found["per_hour"] == pytest.approx(per_hour)
    assert found["seconds_left"] == pytest.approx(len(ends) * 3600 / per_hour)


def test_relative_and_absolute_commands_share_attempts(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    one = replace(job(tmp_path, "one"), words=["pretrain", "--out", "runs/one"])
    SweepFolder(tmp_path).add(attempt(one, 2.0, 1.0, "failed"))
    for out, number in (("runs/one", 1), (f"{tmp_path}/runs/one", 1), ("runs/other", 0)):
        assert len(causes(tmp_path, replace(one, words=["pretrain", "--out", out]))) == number


def test_row_after_a_truncated_row_is_complete(tmp_path, monkeypatch):
    folder, one = SweepFolder(tmp_path), job(tmp_path, "one")
    row = {"job": "one", "cause": "killed", "line": "", "seconds": 1.0, "ended": 2.0, "words": one.words}
    folder.add(row)
    path = tmp_path / "sweep" / "attempts.jsonl"
    path.write_bytes(path.read_bytes() + b'{"job": "one", "cau')
    folder.add(row)
    assert folder.attempts([one])["one"] == [row, row]
    os.symlink("/dev/full", tmp_path / "full")
    monkeypatch.setattr(folder, "_attempts", tmp_path / "full")
    with pytest.raises(DiskFullError):
        folder.add(row)


def test_moved_plan_is_readable_but_not_executed(tmp_path, monkeypatch, capsys):
    (tmp_path / "made").mkdir()
    monkeypatch.chdir(tmp_path / "made")
    out = tmp_path / "made" / "runs"
    one = job(out, "one")
    plan = keep_plan(out, replace(one, folder=one.folder.relative_to(tmp_path / "made"), words=["runs/one"]))
    SweepFolder(out.relative_to(tmp_path / "made")).keep_plan("plan", plan.jobs, plan.program)
    monkeypatch.chdir(tmp_path)
    main(["sweep", "retry", "made/runs"])
    assert one.finished, "the job ran in the folder where the plan was made"
    (tmp_path / "made" / "runs").rename(tmp_path / "moved")
    capsys.readouterr()
    main(["sweep", "status", "moved"])
    assert "1 jobs: 1 done" in capsys.readouterr().out
    old = "error: moved: was planned as .*: move it back, or remove moved/sweep/plans/plan.json and plan it again with"
    assert re.match(old, rejection(["sweep", "retry", "moved"]))
    keep_plan(tmp_path / "moved", job(tmp_path / "moved", "one"), name="new")
    assert re.match(old, rejection(["sweep", "join", "moved"]))
    (tmp_path / "moved" / "sweep" / "plans" / "plan.json").unlink()
    main(["sweep", "retry", "moved"])


def test_hidden_files_are_no_plans(tmp_path):
    plan = keep_plan(tmp_path, job(tmp_path, "one"))
    (tmp_path / "sweep" / "plans" / "._plan.json").write_bytes(b"\0\5\x16\7")  # as macOS writes it
    folder = SweepFolder(tmp_path)
    assert (folder.plans(), folder.jobs_of_others("")) == ([plan], plan.jobs)


@pytest.mark.parametrize("text", ["[{", "{}", "[3]", '{"made_in": "/", "out": "runs", "program": [], "jobs": [{}]}'])
def test_damaged_plan_is_rejected(tmp_path, text):
    keep_plan(tmp_path, job(tmp_path, "one"))
    (tmp_path / "sweep" / "plans" / "plan.json").write_text(text)
    assert "plan.json: is damaged" in rejection(["sweep", "status", str(tmp_path)])

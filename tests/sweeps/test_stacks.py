"""Stacks of fine-tuning jobs in one process, each with its own attempts, log and run; with real processes."""

import os
from dataclasses import asdict, replace

import pytest

from tests.helpers_data import write_fake_set
from tests.helpers_sweeps import begun, job, keep_plan, policy, until
from tests.sweeps.test_driver import causes, code, command, quick  # noqa: F401 (a fixture for every test)
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import TEMPORARY
from vd4rl_pomdp.nn.encoder import EncoderCard, EncoderConfig, EncoderRecord
from vd4rl_pomdp.runs.files import write_json
from vd4rl_pomdp.runs.outputs import owned
from vd4rl_pomdp.runs.results import read_run
from vd4rl_pomdp.sweeps import driver
from vd4rl_pomdp.sweeps.driver import Driver, in_stacks, width_of, words_of_stack
from vd4rl_pomdp.sweeps.folder import SweepFolder, is_finished
from vd4rl_pomdp.sweeps.options import LocalOptions


def sweep(out, *jobs, at_once=1, stack=3, **options):
    return Driver([keep_plan(out, *jobs)], LocalOptions(jobs=at_once, stack=stack), SweepFolder(out), **options).run()


def together(jobs):
    """Job names grouped by process, in the order in which they began."""
    seen = sorted((one["time"], one["process"], job.name) for job in jobs for one in begun(job))
    processes = {}
    for _, process, name in seen:
        processes.setdefault(process, []).append(name)
    return list(processes.values())


def encoder(folder, **config):
    card = EncoderCard("acro", "walker_walk", "expert", {"corruption": "none"}, 0, 1, "cpu")
    record = EncoderRecord(EncoderConfig(6, **config), card, "", "")
    folder.mkdir(parents=True)
    write_json(folder / "config.json", asdict(record))


def test_stackable_jobs_differ_only_in_seed_encoder_data_and_folder(tmp_path):
    a, b, c = (policy(tmp_path, name) for name in "abc")
    flags = {"a": "--seed 0 --data x", "b": "--seed 1 --data y --view-seed 0", "c": "--seed 2 --data x"}
    a, b, c = jobs = [replace(one, words=[*one.words, *flags[one.name].split()]) for one in (a, b, c)]
    assert in_stacks(jobs, 5, {}) == [jobs]
    assert in_stacks(jobs, 2, {}) == [[a, b], [c]]
    assert in_stacks(jobs, 1, {}) == [[a], [b], [c]]
    words = [*a.words, "+", *b.words[1:]]
    assert words_of_stack([a, b]) == words
    other = replace(b, words=[*b.words, "--hidden-dim", "8"])
    assert in_stacks([a, other, c], 5, {}) == [[a, c], [other]]
    for settings in ({"algorithm": "bc"}, {"task": "cheetah_run"}):  # determined by the encoder, not the command
        assert in_stacks([a, replace(b, settings=settings), c], 5, {}) == [[a, c], [replace(b, settings=settings)]]
    pixels = [replace(one, settings={"views": "0"}) for one in jobs]
    assert in_stacks(pixels, 5, {}) == [[one] for one in pixels]
    encoders = [job(tmp_path, name) for name in "de"]
    assert in_stacks(encoders, 5, {}) == [[one] for one in encoders]


def test_policy_input_width_is_read_from_encoder_config(tmp_path):
    one = policy(tmp_path, "one", "before")
    assert width_of(one, tmp_path) is None
    encoder(tmp_path / "before" / "encoder", feature_dim=50, history="gru", hidden_dim=64)
    assert width_of(one, tmp_path) == 64
    assert width_of(replace(one, settings={"readout": "frame+state"}), tmp_path) == 114
    other = policy(tmp_path, "other", "memoryless")
    encoder(tmp_path / "memoryless" / "encoder", feature_dim=64)
    assert width_of(other, tmp_path) == 64


def test_stacks_share_a_width_and_jobs_keep_rows_and_logs(tmp_path):
    encoders = [replace(job(tmp_path, name), done=True) for name in ("x", "y", "z")]
    for one, width in zip(encoders, (64, 50, 64), strict=True):
        encoder(one.folder / "encoder", feature_dim=width)
    jobs = [policy(tmp_path, f"of_{one.name}", one.name) for one in encoders]
    assert sweep(tmp_path, *encoders, *jobs)
    assert sorted(together(jobs)) == [["of_x", "of_z"], ["of_y"]]
    rows = SweepFolder(tmp_path).attempts(jobs)
    assert [[(row["cause"], row.get("stack"), row["log"]) for row in rows[one.name]] for one in jobs] == [
        [("done", 2, "sweep/logs/of_x.log")], [("done", None, "sweep/logs/of_y.log")],
        [("done", 2, "sweep/logs/of_x.log")],
    ]  # fmt: skip
    logs = tmp_path / "sweep" / "logs"
    assert (logs / "of_x.log").read_text() == "its last line\n" * 2
    assert (logs / "of_z.log").read_text() == f"in one process with of_x: see {logs / 'of_x.log'}\n"


def test_stack_uses_cores_that_no_other_job_needs(tmp_path, monkeypatch):
    monkeypatch.setattr(driver, "places", lambda _: [driver.Place((core,), None) for core in cores])
    cores = sorted(os.sched_getaffinity(0))[:2]
    jobs = [policy(tmp_path, name) for name in "abc"]
    assert sweep(tmp_path, *jobs)
    assert [one["cores"] for job in jobs for one in begun(job)] == [len(cores)] * 3
    jobs = [policy(tmp_path, name) for name in "de"]
    assert sweep(tmp_path, *jobs, job(tmp_path, "f"))
    assert [one["cores"] for job in jobs for one in begun(job)] == [1] * 2


@pytest.mark.parametrize("end", [2, "kill", "defect"])
def test_failed_stack_continues_as_single_jobs(tmp_path, end):
    a, b, c, d = jobs = [policy(tmp_path, name, ends=(end, 2) if name == "b" else ()) for name in "abcd"]
    assert not sweep(tmp_path, *jobs, stack=4)
    assert together(jobs) == [["a", "b"], ["b"], ["c"], ["d"]]
    assert [one.finished for one in jobs] == [True, False, True, True]
    assert (causes(tmp_path, a), causes(tmp_path, b)[1:]) == (["done"], ["failed"])
    first = causes(tmp_path, b)[0]
    assert (causes(tmp_path, c), causes(tmp_path, d)) == ([first, "done"],) * 2
    assert not sweep(tmp_path, *jobs, stack=4), "b stays failed"
    main(["sweep", "retry", str(tmp_path), "--stack", "4"])
    assert [len(begun(one)) for one in jobs] == [1, 3, 1, 1]


def test_temporary_failures_are_retried_as_a_stack(tmp_path):
    jobs = [policy(tmp_path, name, ends=(TEMPORARY,) if name == "a" else ()) for name in "ab"]
    assert sweep(tmp_path, *jobs)
    assert together(jobs) == [["a"], ["a", "b"]]


def test_stack_waits_only_for_running_dependencies(tmp_path):
    """With two slots, policies of the first encoder wait for those of the second, not for those of a later one."""
    encoders = [job(tmp_path, "x"), job(tmp_path, "y", ends=("wait",)), job(tmp_path, "z", "never")]
    never = job(tmp_path, "never", ends=(2,))
    one, two, other = jobs = [
        policy(tmp_path, "one", "x"), policy(tmp_path, "two", "y"), policy(tmp_path, "other", "x", updates=80),
    ]  # fmt: skip
    last = policy(tmp_path, "last", "z")
    keep_plan(tmp_path, never, *encoders, *jobs, last)
    process = command("retry", tmp_path, "--jobs", "2", "--stack", "3")
    until(lambda: is_finished(other))
    assert begun(one) == []
    (tmp_path / "go").touch()
    assert code(process) == 1
    assert together([one, two]) == [["one", "two"]]


def test_interrupted_stack_resumes_its_unfinished_jobs(tmp_path):
    jobs = [policy(tmp_path, name, ends=("wait",) if name == "b" else ()) for name in "abc"]
    keep_plan(tmp_path, *jobs)
    process = command("retry", tmp_path, "--stack", "3")
    until(lambda: begun(jobs[1]))
    process.terminate()
    assert code(process) == 143
    assert [causes(tmp_path, one) for one in jobs] == [["done"], ["interrupted"], ["interrupted"]]
    assert sweep(tmp_path, *jobs)
    assert together(jobs) == [["a", "b"], ["b", "c"]]


def test_drivers_share_jobs_and_skip_those_in_use(tmp_path):
    jobs = [policy(tmp_path, name) for name in "abcdef"]
    keep_plan(tmp_path, *jobs)
    with owned(jobs[1].folder):
        process = command("join", tmp_path, "--jobs", "1", "--stack", "3")
        until(lambda: sum(map(is_finished, jobs)) == 5)
    others = command("join", tmp_path, "--jobs", "1", "--stack", "3")
    assert (code(process), code(others)) == (0, 0)
    assert [len(begun(one)) for one in jobs] == [1] * 6
    assert all(set(causes(tmp_path, one)) == {"done"} for one in jobs)


GRID = """
seed = [0, 1]
preset = "smoke"
[collect]
task = "walker_walk"
quality = "expert"
[pretrain]
method = "random"
[finetune]
eval_clean = false
"""


def test_grid_policies_train_as_stack_with_separate_runs(tmp_path, capsys):
    write_fake_set(tmp_path / "out" / "data" / "walker_walk" / "expert", [20, 25])
    (tmp_path / "grid.toml").write_text(GRID)
    words = ["sweep", "run", str(tmp_path / "grid.toml"), "--out", str(tmp_path / "out"), "--stack", "2"]
    main([*words, "--dry-run"])
    assert capsys.readouterr().out.endswith("# 5 jobs, 1 done, 4 to do in at least 3 processes\n")
    main(words)
    assert capsys.readouterr().out == "all 5 jobs are finished\n"
    (plan,) = SweepFolder(tmp_path / "out").plans()
    policies = [one for one in plan.jobs if one.section == "finetune"]
    rows = SweepFolder(tmp_path / "out").attempts(policies)
    assert [(row["cause"], row["stack"]) for one in policies for row in rows[one.name]] == [("done", 2)] * 2
    assert [read_run(one.folder).labels["seed"] for one in policies] == [0, 1]
    main([*words[:-2], "--dry-run"])
    assert capsys.readouterr().out.endswith("# 5 jobs, 5 done, 0 to do\n"), "stacked runs count without --stack"

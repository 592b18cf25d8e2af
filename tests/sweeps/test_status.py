"""Where a sweep stands."""

import time

import pytest

from tests.helpers_sweeps import finish, job
from vd4rl_pomdp.runs.files import write_json
from vd4rl_pomdp.sweeps import status as status_module
from vd4rl_pomdp.sweeps.estimate import Estimates
from vd4rl_pomdp.sweeps.found import FoundRun
from vd4rl_pomdp.sweeps.plan import Job, cost_of
from vd4rl_pomdp.sweeps.status import lines, status


@pytest.fixture
def jobs(tmp_path, monkeypatch):
    monkeypatch.setattr(status_module, "in_use", lambda folder: folder.name == "running")
    finish(tmp_path / "done")
    return [job(tmp_path, name) for name in ("done", "running", "waiting", "broken", "nan")]


def row(cause, seconds=100.0, ago=60.0):
    return {
        "cause": cause,
        "step": 0,
        "line": f"its {cause}",
        "ended": time.time() - ago,
        "seconds": seconds,
    }


def attempts():
    done = [row("killed", ago=1900), row("done", ago=1700)]
    return {"done": done, "waiting": [row("killed")], "broken": [row("refused")], "nan": [row("diverged")]}


def test_states_come_from_folders_owners_and_attempts(jobs):
    found = status(jobs, attempts(), Estimates([]))
    assert found.states == {
        "done": "done", "running": "running", "waiting": "waiting", "broken": "failed", "nan": "diverged"
    }  # fmt: skip
    assert not found.finished
    assert {name: last["line"] for name, last in found.failures.items()} == {
        "broken": "its refused", "nan": "its diverged"
    }  # fmt: skip
    assert found.per_hour == pytest.approx(3600 / 2000, rel=0.01)
    assert found.seconds_left is None


def test_what_needs_a_failed_job_is_blocked_and_is_no_time_left(jobs, tmp_path):
    after = [job(tmp_path, "policy", "broken"), job(tmp_path, "table", "policy"), job(tmp_path, "other", "waiting")]
    found = status([*jobs, *after], attempts(), Estimates([]))
    assert [found.states[name] for name in ("policy", "table", "other")] == ["blocked", "blocked", "waiting"]
    assert set(found.failures) == {"broken", "nan"}
    finish(tmp_path / "waiting")
    finish(tmp_path / "running")
    finish(tmp_path / "other")
    assert status([*jobs, *after], attempts(), Estimates([])).seconds_left == 0.0


def test_an_attempt_at_another_command_says_nothing_of_a_job(jobs):
    rows = {"waiting": [row("refused") | {"words": ["other"]}], "broken": [row("refused") | {"words": ["list"]}]}
    found = status(jobs, rows, Estimates([]))
    assert (found.states["waiting"], list(found.failures)) == ("waiting", ["broken"])


def test_the_text_names_failures_with_their_last_line(jobs):
    text = "\n".join(lines(status(jobs, attempts(), Estimates([]))))
    assert "5 jobs: 1 diverged, 1 done, 1 failed, 1 running, 1 waiting" in text
    assert "1.8 jobs an hour, about unknown left" in text
    assert "refused: broken: its refused" in text
    assert "running: running" in text


def past(tmp_path, seconds, **config):
    record = {"stage": "pretrain", "config": {"seed": 0, "out": "x", "steps": 10, "method": "acro"} | config}
    return FoundRun(tmp_path, record, {}, seconds)


def planned(tmp_path, **settings):
    return Job("a", "pretrain", tmp_path, (), settings=cost_of({"steps": 10, "method": "acro", "seed": 3} | settings))


def test_the_same_settings_take_as_long_as_they_did(tmp_path):
    estimates = Estimates([past(tmp_path, 30.0), past(tmp_path, 50.0), past(tmp_path, 40.0), past(tmp_path, None)])
    assert estimates.seconds(planned(tmp_path)) == 40.0


def test_other_settings_take_as_long_a_step_as_their_stage(tmp_path):
    estimates = Estimates([past(tmp_path, 30.0), past(tmp_path, 100.0, steps=20)])
    assert estimates.seconds(planned(tmp_path, method="mik", steps=100)) == pytest.approx(400.0)
    assert estimates.seconds(Job("s", "collect", tmp_path, ())) is None


def test_runs_of_the_same_method_tell_more_than_others(tmp_path):
    estimates = Estimates([past(tmp_path, 30.0), past(tmp_path, 0.1, method="random")])
    assert estimates.seconds(planned(tmp_path, method="random", steps=100)) == pytest.approx(1.0)
    assert estimates.seconds(planned(tmp_path, steps=100)) == pytest.approx(300.0)


def test_a_run_that_does_not_say_its_steps_tells_no_pace(tmp_path):
    estimates = Estimates([past(tmp_path, 30.0, steps=None), past(tmp_path, 20.0, steps=0)])
    assert estimates.seconds(planned(tmp_path)) is None
    assert estimates.seconds(planned(tmp_path, steps=0)) == 20.0


def test_sets_that_were_collected_tell_what_others_take_by_their_episodes(tmp_path):
    def collecting(name, task, episodes):
        return Job(name, "collect", tmp_path / name, (), settings=cost_of({"task": task, "episodes": episodes}))

    there, begun = collecting("there", "walker_walk", 10), collecting("begun", "walker_walk", 40)
    there.folder.mkdir()
    begun.folder.mkdir()
    write_json(there.folder / "provenance.json", {"seconds": 50.0})
    write_json(begun.folder / "collection.json", {})
    estimates = Estimates([], [there, begun])
    assert estimates.seconds(there) == 50.0
    assert estimates.seconds(begun) == pytest.approx(200.0)
    assert estimates.seconds(collecting("new", "cheetah_run", 100)) == pytest.approx(500.0)


def test_time_left_is_shared_by_the_jobs_that_run(jobs, tmp_path):
    estimates = Estimates([past(tmp_path, 30.0)])
    found = status(jobs, attempts(), estimates)
    assert found.seconds_left == pytest.approx(2 * 3.0), "two jobs of one step at 3 s a step, one at a time"

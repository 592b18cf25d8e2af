"""How many tasks a driver in front asks a cluster for, and what it tells."""

import pytest

from tests.helpers_sweeps import finish, job
from vd4rl_pomdp.core.errors import UnavailableError, UserError
from vd4rl_pomdp.sweeps import cluster as module
from vd4rl_pomdp.sweeps.cluster import watch
from vd4rl_pomdp.sweeps.folder import SweepFolder


class Fake:
    """A cluster on which a script tells what happens at each look."""

    jobs_per_task, threads = 2, 0

    def __init__(self, folder, script, tasks=10):
        self.folder, self.tasks, self._script = folder, tasks, iter(script)
        self.asked, self.waiting, self.stopped = [], 0, False

    def live(self):
        self.waiting = next(self._script)(self.waiting)
        return self.waiting

    def submit(self, task, number):
        self.asked.append(number)
        self.waiting += number
        self.words = task.work.words

    def stop(self):
        self.stopped = True


@pytest.fixture
def jobs(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "LOOK_S", 0.0)
    return [job(tmp_path, "set"), *(job(tmp_path, name, "set") for name in "abcde")]


def same(waiting):
    return waiting


def test_as_many_tasks_are_asked_for_as_the_jobs_need_that_can_start(jobs, tmp_path, monkeypatch, capsys):
    folder = SweepFolder(tmp_path)

    def ends(*names):
        def happens(waiting):
            for name in names:
                finish(tmp_path / name)
                folder.add({"job": name, "cause": "done", "line": "", "seconds": 3.0, "step": 0})
            return 0 if names == ("set",) else waiting

        return happens

    fake = Fake(tmp_path, [same, same, ends("set"), same, ends("a", "b"), ends("c", "d", "e")])
    assert watch(jobs, fake, folder, "plan")
    assert fake.asked == [1, 1, 2], "one for the set, and three for five jobs"
    assert fake.words[:3] == ("sweep", "join", str(tmp_path))
    assert "[6/6] done" in capsys.readouterr().err


def test_what_is_given_up_is_not_waited_for(jobs, tmp_path):
    SweepFolder(tmp_path).add({"job": "set", "cause": "refused", "line": "", "seconds": 0.0, "step": 0})
    fake = Fake(tmp_path, [])
    assert not watch(jobs, fake, SweepFolder(tmp_path), None)
    assert fake.asked == []


def test_tasks_that_end_and_do_nothing_end_the_sweep(jobs, tmp_path):
    log = tmp_path / "sweep" / "logs" / "tasks" / "node-1.log"
    log.parent.mkdir(parents=True)
    log.write_text("No module named torch\n")
    fake = Fake(tmp_path, [lambda waiting: 0] * 9)
    with pytest.raises(UserError, match=r"tasks end before they begin a job \(No module named torch\): see"):
        watch(jobs, fake, SweepFolder(tmp_path), None)
    assert fake.asked == [1] * 4
    assert fake.stopped


def test_a_cluster_that_falls_silent_is_told_once_and_one_that_never_spoke_ends_the_sweep(jobs, tmp_path, capsys):
    def silent(waiting):
        raise UnavailableError("it does not answer")

    def end(waiting):
        raise KeyboardInterrupt

    with pytest.raises(UnavailableError):
        watch(jobs, Fake(tmp_path, [silent]), SweepFolder(tmp_path), None)
    fake = Fake(tmp_path, [same, silent, silent, end])
    with pytest.raises(KeyboardInterrupt):
        watch(jobs, fake, SweepFolder(tmp_path), None)
    assert capsys.readouterr().err == "warning: it does not answer; trying again\n"
    assert fake.stopped

"""A sweep on a cluster: tasks that each are a driver of their own, on its machine, in the sweep's one folder.

The driver in front only counts: as long as there are jobs that could run, it keeps as many tasks in the queue as they
need. Which task takes which job is settled where it is for any two drivers: a run folder has one owner.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterable

from vd4rl_pomdp.core.errors import UserError, disk_errors
from vd4rl_pomdp.core.registry import sources
from vd4rl_pomdp.runs import interrupt
from vd4rl_pomdp.runs.ownership import in_use
from vd4rl_pomdp.sweeps.driver import attempts_at, lost_among, say
from vd4rl_pomdp.sweeps.folder import SweepFolder
from vd4rl_pomdp.sweeps.own_file import own_file
from vd4rl_pomdp.sweeps.plan import Job
from vd4rl_pomdp.sweeps.work import Cluster, ClusterTask, Work, last_line

LOOK_S = 15.0
"""Seconds between two looks at the cluster."""
STEP_S = 0.5
VAIN = 3
"""Times that tasks may be asked for again without anything having happened."""


def watch(jobs: Iterable[Job], cluster: Cluster, folder: SweepFolder, plan: str | None) -> bool:
    """Keep a sweep's tasks on a cluster until nothing is left that can be done; whether all is finished.

    Args:
        jobs: those of the sweep, each after those it needs.
        cluster: where it runs.
        folder: the sweep's.
        plan: name of its plan; None: all plans in its folder.

    Raises:
        UserError: the cluster refuses the first tasks, or tasks end and nothing happens.
    """
    jobs = list(jobs)
    told = {name: now for job in jobs for name, now in sources(dict(job.settings)).items()}
    words = ["sweep", "join", str(folder.out), "--jobs", str(cluster.jobs_per_task)]
    words += ["--jobs-per-gpu", str(cluster.jobs_per_task), "--threads", str(cluster.threads)]
    words += [] if plan is None else ["--plan", plan]
    task = ClusterTask(Work("join", tuple(words), folder.path / "logs" / "tasks", 1, own_file(), told), os.getcwd())
    front = _Front(jobs, cluster, folder, task)
    try:
        while front.look():
            until = time.monotonic() + LOOK_S
            while time.monotonic() < until:
                time.sleep(min(STEP_S, LOOK_S))
                interrupt.check("the sweep's tasks have ended")
    except BaseException:
        cluster.stop()
        raise
    return all(job.finished for job in jobs)


class _Front:
    """What is known of a sweep's jobs and tasks."""

    def __init__(self, jobs: list[Job], cluster: Cluster, folder: SweepFolder, task: ClusterTask) -> None:
        self._jobs, self._cluster, self._folder, self._task = jobs, cluster, folder, task
        self._left = [job for job in jobs if not job.finished]
        self._said = {name: len(rows) for name, rows in folder.attempts().items()}
        self._vain = self._size = 0
        self._heard = False
        """Whether the cluster has answered: at first what it refuses ends the sweep, later it is asked again."""
        self._warned = ""

    def look(self) -> bool:
        """Tell what has happened, and ask for the tasks that are missing; whether anything can still be done."""
        try:
            with disk_errors(self._folder.path):
                could, running = self._open()
                if could + running:
                    self._ask(could + running, running)
        except UserError as error:
            if not self._heard:
                raise
            if str(error) != self._warned:
                print(f"warning: {error}; trying again", file=sys.stderr, flush=True)
            self._warned = str(error)
            return True
        self._heard = True
        if self._vain > VAIN:
            logs = sorted(self._task.work.log.glob("*.log"), key=lambda log: log.stat().st_mtime)
            line = last_line(logs[-1]) if logs else "they print nothing"
            raise UserError(f"tasks end before they begin a job ({line}): see {self._cluster.folder}")
        return could + running > 0

    def _open(self) -> tuple[int, int]:
        """How many jobs could start now, and how many run."""
        self._left = [job for job in self._left if not job.finished]
        attempts = self._folder.attempts()
        for name, rows in attempts.items():
            for row in rows[self._said.get(name, 0) :]:
                done = len(self._jobs) - len(self._left)
                say(name, row["cause"], row["seconds"], row["line"], done, len(self._jobs))
            self._said[name] = len(rows)
        since = {job.name: attempts_at(job, attempts) for job in self._jobs}
        lost, left = lost_among(self._left, since), {job.name for job in self._left}
        ready = [job for job in self._left if job.name not in lost and left.isdisjoint(job.needs)]
        running = sum(in_use(job.folder) for job in ready)
        return len(ready) - running, running

    def _ask(self, jobs: int, running: int) -> None:
        """Ask for tasks where fewer than the jobs need wait or run."""
        live = self._cluster.live()
        size = self._folder.attempts_size()
        if running or size != self._size:
            self._vain = 0
        self._size = size
        wanted = min(self._cluster.tasks, -(-jobs // self._cluster.jobs_per_task)) - live
        if wanted > 0:
            self._vain += not live
            with interrupt.deferred():  # what is half asked for could not be taken back
                self._cluster.submit(self._task, wanted)

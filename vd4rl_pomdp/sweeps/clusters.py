"""A sweep on a cluster: tasks that each are a driver of their own, on its machine, in the sweep's one folder.

The driver in front only counts: as long as there are jobs that could run, it keeps as many tasks in the queue as they
need. Which task takes which job is settled where it is for any two drivers: a run folder has one owner.
"""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vd4rl_pomdp.core.errors import UnavailableError, UserError, disk_errors, first_line
from vd4rl_pomdp.runs import interrupt
from vd4rl_pomdp.runs.outputs import in_use
from vd4rl_pomdp.sweeps.driver import PATIENCE_S, Driver, in_stacks, say
from vd4rl_pomdp.sweeps.folder import Plan, SweepFolder, is_finished, jobs_of, lost_among
from vd4rl_pomdp.sweeps.options import LocalOptions, RayOptions, SlurmOptions

LOOK_S = 15.0
"""Seconds between two looks at the cluster."""
ANSWER_S = 30.0
"""Seconds that a cluster has to answer."""
VAIN = 3
"""Times that tasks may be asked for again without anything having happened."""


@dataclass(frozen=True)
class ClusterTask:
    """What runs on a node: a driver that helps with a sweep."""

    out: Path
    plan: str
    """Name of the plan; empty: all plans in the folder."""
    options: LocalOptions
    cwd: str
    """In which relative paths begin."""

    def __call__(self) -> None:
        """Take jobs that nobody has until none is left; SIGTERM and SIGUSR2, Slurm's warning, end it in peace."""
        try:
            os.chdir(self.cwd)
        except OSError as error:
            raise UserError(f"{self.cwd}: not on node {socket.gethostname()}; use a disk that all share") from error
        with interrupt.handled():
            # submitit's own answer to it would be to submit the task again, which is for `watch` to decide.
            signal.signal(signal.SIGUSR2, lambda *_: os.kill(os.getpid(), signal.SIGTERM))
            folder = SweepFolder(self.out)
            Driver(folder.plans_to_do(self.plan), self.options, folder, helps=True).run()


def watch(plans: list[Plan], cluster: SlurmCluster | RayCluster, folder: SweepFolder, name: str) -> bool:
    """Keep a sweep's tasks on a cluster until nothing is left that can be done; whether all is finished.

    Args:
        plans: of which the jobs are carried out.
        cluster: where; tasks see the folders of runs and sets at the same paths.
        folder: the sweep's.
        name: of its plan; empty: all plans in its folder.

    Raises:
        UserError: the cluster refuses the first tasks, or tasks end and nothing happens.
    """
    jobs = jobs_of(plans)
    task = ClusterTask(folder.out, name, cluster.local, os.getcwd())
    said = {name: len(rows) for name, rows in folder.attempts(jobs).items()}
    vain, heard = 0, False
    try:
        while True:
            attempts, left = folder.attempts(jobs), [job for job in jobs if not is_finished(job)]
            for job, rows in attempts.items():
                for row in rows[said[job] :]:
                    say(row, len(jobs) - len(left), len(jobs))
                    vain = 0
                said[job] = len(rows)
            lost, names = lost_among(left, attempts), {job.name for job in left}
            could = [job for job in left if job.name not in lost and names.isdisjoint(job.needs)]
            if not could:
                return not left
            if any(in_use(job.folder) for job in could):
                vain = 0
            try:
                live = cluster.live()
                processes = len(in_stacks(could, cluster.local.stack, attempts))
                wanted = min(cluster.tasks, -(-processes // cluster.local.jobs)) - live
                if wanted > 0:
                    vain += not live  # tasks that wait in the queue, perhaps for days, are not in vain
                    if vain > VAIN:
                        raise UserError(f"tasks end before they begin a job: see {cluster.folder}")
                    with interrupt.deferred():  # what is half asked for could not be taken back
                        cluster.submit(task, wanted)
                heard = True
            except UnavailableError as error:
                if not heard:  # what a cluster refuses at first ends the sweep, later it is asked again
                    raise
                print(f"warning: {error}; trying again", file=sys.stderr, flush=True)
            until = time.monotonic() + LOOK_S
            while time.monotonic() < until:
                time.sleep(0.5)
                interrupt.check("the sweep's tasks have ended")
    except BaseException:
        cluster.stop()
        raise


class SlurmCluster:
    """A sweep's tasks as arrays of Slurm, submitted by submitit; its queue knows them by a name of the folder's."""

    def __init__(self, options: SlurmOptions, folder: Path) -> None:
        """Asks Slurm for nothing yet; UserError if submitit or Slurm's commands are missing.

        Args:
            options: what a task gets.
            folder: for what submitit and the tasks write, on a disk that all nodes share.
        """
        try:
            import submitit
        except ImportError as error:
            extra = "pip install '.[slurm]' in a clone of vd4rl-pomdp"
            raise UserError(f"--executor slurm needs submitit: {extra}") from error
        for name in ("sbatch", "squeue", "scancel", "srun"):
            if shutil.which(name) is None:
                raise UserError(f"--executor slurm finds no {name} here: start the sweep where Slurm's commands are")
        self.folder, self.tasks = folder, options.tasks
        self.local = LocalOptions(options.jobs_per_task, options.jobs_per_task, stack=options.stack)
        digest = hashlib.blake2b(str(folder.resolve()).encode(), digest_size=4).hexdigest()
        self._name = f"vd4rl-pomdp-{digest}"
        self._executor = submitit.AutoExecutor(folder, cluster="slurm")
        self._executor.update_parameters(name=self._name, stderr_to_stdout=True, **parameters(options))

    def live(self) -> int:
        """How many tasks of this sweep wait or run; UnavailableError if Slurm does not answer."""
        return len(self._ask("squeue", "--array", "--noheader", "--format=%T").split())

    def submit(self, task: ClusterTask, number: int) -> None:
        """Submit one array; UserError if Slurm does not take it."""
        try:
            with disk_errors(self.folder):
                self._executor.submit_array([task] * number)
        except RuntimeError as error:  # submitit's for a command that failed
            lines = str(error).strip().splitlines()
            raise UserError(f"Slurm took no array ({lines[-1] if lines else 'it does not say why'})") from error

    def stop(self) -> None:
        """Take what waits out of the queue, ask every task to end where nothing is lost, and wait for it."""
        try:
            # Those that wait first: they would begin in the room of those that end.
            self._ask("scancel", "--quiet", "--state=PENDING")
            self._ask("scancel", "--quiet", "--signal=USR2")
            until = time.monotonic() + PATIENCE_S + 15
            while self.live() and time.monotonic() < until:
                time.sleep(1)
            self._ask("scancel", "--quiet")
        except UnavailableError as error:
            print(f"warning: {error}; tasks may be left: scancel --me --name={self._name}", file=sys.stderr)

    def _ask(self, command: str, *words: str) -> str:
        """What a command of Slurm's prints of this sweep's tasks; UnavailableError if it does not answer."""
        told = [command, "--me", f"--name={self._name}", *words]
        try:
            answer = subprocess.run(told, capture_output=True, text=True, check=False, timeout=ANSWER_S)
        except subprocess.TimeoutExpired as error:
            raise UnavailableError(f"Slurm does not answer: {command} has not ended after {ANSWER_S:g} s") from error
        if answer.returncode and command == "squeue":  # scancel fails where there is nothing to cancel
            raise UnavailableError(f"Slurm does not answer: see what squeue says ({answer.stderr.strip()})")
        return answer.stdout


def parameters(options: SlurmOptions) -> dict[str, Any]:
    """What submitit is told of a task."""
    names = ("partition", "account", "qos", "constraint", "time")
    found = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    if options.gpus:
        found["gpus_per_node"] = options.gpus
    if options.memory is not None:
        found["mem"] = f"{options.memory * 1024:.0f}M"
    further = [parameter.removeprefix("--").partition("=") for parameter in options.sbatch]
    found |= {
        "cpus_per_task": options.cpus,
        "srun_args": [f"--cpus-per-task={options.cpus}"],  # which some versions do not take from sbatch
        "array_parallelism": options.tasks,
        "signal_delay_s": round(PATIENCE_S + 15),
        "additional_parameters": {"requeue": True} | {name: value or True for name, _, value in further},
    }
    return {f"slurm_{name}": value for name, value in found.items()}


class RayCluster:
    """A sweep's tasks on a Ray cluster that is there already, each with one job at a time.

    Ray chooses nodes and GPUs, and ends a task with the driver that asked for it. It tries nothing again itself.
    """

    def __init__(self, options: RayOptions, folder: Path) -> None:
        """Connect to the cluster; UserError if Ray is missing, no cluster answers, or no node has room for a job."""
        try:
            import ray
        except ImportError as error:
            raise UserError("--executor ray needs Ray: pip install '.[ray]' in a clone of vd4rl-pomdp") from error
        self._ray, self._options, self.folder = ray, options, folder
        self.local = LocalOptions(jobs=1, threads=max(1, int(options.cpus)), stack=options.stack)
        self._running: list[Any] = []
        before = signal.getsignal(signal.SIGTERM)  # which Ray would answer in its own way
        try:
            host, colon, port = options.address.rpartition(":")
            if colon and port.isdecimal():  # `ray.init` would try for ten minutes, and answer no signal
                socket.create_connection((host, int(port)), ANSWER_S).close()
            ray.init(options.address, log_to_driver=False, logging_level=logging.WARNING, ignore_reinit_error=True)
        except (OSError, RuntimeError, ValueError) as error:  # a RuntimeError for a cluster of another version
            raise UserError(
                f"no Ray cluster at --address {options.address} ({first_line(error)}): start one with `ray start "
                "--head`, or name another"
            ) from error
        finally:
            signal.signal(signal.SIGTERM, before)
        if not self.tasks:
            ray.shutdown()
            raise UserError(
                f"no node of the Ray cluster has {options.cpus:.15g} CPUs and {options.gpus:.15g} GPUs: lower --cpus "
                "or --gpus, or say with --jobs how many jobs the cluster is to grow for"
            )

    @property
    def tasks(self) -> int:
        """What was asked for, or what the nodes take that are there now."""
        wanted = {"CPU": self._options.cpus, "GPU": self._options.gpus}
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        rooms = (min(int(one.get(name, 0) / share) for name, share in wanted.items() if share) for one in nodes)
        return self._options.jobs or sum(rooms)

    def live(self) -> int:
        """How many tasks wait or run. One that failed says why."""
        over: list[Any] = []
        if self._running:
            over, self._running = self._ray.wait(self._running, num_returns=len(self._running), timeout=0)
        for task in over:
            try:
                self._ray.get(task)
            except self._ray.exceptions.RayError as error:
                told = first_line(getattr(error, "cause", None) or error)
                print(f"warning: a task ended ({told})", file=sys.stderr, flush=True)
        return len(self._running)

    def submit(self, task: ClusterTask, number: int) -> None:
        """Start tasks; Ray finds their nodes."""
        run = self._ray.remote(max_retries=0)(lambda: task())  # the sweep's own rows decide what is tried again
        run = run.options(num_cpus=self._options.cpus, num_gpus=self._options.gpus, name=str(self.folder))
        self._running += [run.remote() for _ in range(number)]

    def stop(self) -> None:
        """Cancel what waits, ask every task to end where nothing is lost, and wait for it."""
        for task in self._running:
            self._ray.cancel(task)
        if self._running:
            _, left = self._ray.wait(self._running, num_returns=len(self._running), timeout=PATIENCE_S + 10)
            for task in left:
                self._ray.cancel(task, force=True)

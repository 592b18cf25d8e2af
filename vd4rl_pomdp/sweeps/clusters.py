"""Sweeps on a cluster: every task is a full driver that works on the sweep's shared folder.

The driver in front only counts: while jobs can run, it keeps enough tasks in the queue. Tasks need no other
coordination than any drivers that share a folder: a run folder has one owner at a time.
"""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import signal
import socket
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vd4rl_pomdp.core.errors import UnavailableError, UserError, disk_errors, first_line
from vd4rl_pomdp.core.text import one_line
from vd4rl_pomdp.runs import interrupt
from vd4rl_pomdp.runs.outputs import in_use
from vd4rl_pomdp.sweeps.driver import PATIENCE_S, Driver, in_stacks, note, say
from vd4rl_pomdp.sweeps.folder import Plan, SweepFolder, is_finished, jobs_of, lost_among
from vd4rl_pomdp.sweeps.options import LocalOptions, RayOptions, SlurmOptions

LOOK_S = 15.0  # seconds between polls of the cluster
ANSWER_S = 30.0  # timeout of a command to the cluster, seconds
VAIN = 3  # resubmissions without any progress before the sweep gives up


class RejectedError(UserError):
    """The cluster rejected a submission."""


@dataclass(frozen=True)
class ClusterTask:
    """What runs on a node: a driver that helps with a sweep."""

    out: Path
    plan: str  # name of the plan; empty: all plans in the folder
    options: LocalOptions
    cwd: str  # working directory, to which relative paths refer
    gpus: float = 1  # GPUs of the task

    def __call__(self) -> None:
        """Run unclaimed jobs until none is left. SIGTERM and SIGUSR2 (Slurm's warning) end it gracefully."""
        try:
            os.chdir(self.cwd)
        except OSError as error:
            raise UserError(
                f"{self.cwd}: does not exist on node {socket.gethostname()}; use a disk that all nodes share"
            ) from error
        granted = os.environ.get("SLURM_JOB_GPUS") or os.environ.get("SLURM_STEP_GPUS")  # e.g. by --sbatch gres
        if not self.gpus and not granted:  # clusters may show a task the GPUs of others
            os.environ["CUDA_VISIBLE_DEVICES"] = ""
        with interrupt.handled():
            # submitit would resubmit the task on SIGUSR2; here `watch` decides that.
            signal.signal(signal.SIGUSR2, lambda *_: os.kill(os.getpid(), signal.SIGTERM))
            folder = SweepFolder(self.out)
            Driver(folder.plans_to_do(self.plan), self.options, folder, helps=True).run()


def watch(plans: list[Plan], cluster: SlurmCluster | RayCluster, folder: SweepFolder, name: str) -> bool:
    """Keep a sweep's tasks on the cluster until no job can run any more. Return whether all jobs are finished.

    The cluster's nodes see all folders at the same paths. `name` is that of the plan; empty: all plans in the folder.
    UserError if the cluster rejects the first tasks, or later ones again and again while none is left, or tasks keep
    ending without progress.
    """
    jobs = jobs_of(plans)
    task = ClusterTask(folder.out, name, cluster.local, os.getcwd(), cluster.gpus)
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
                heard |= live > 0
                processes = len(in_stacks(could, cluster.local.stack, attempts))
                wanted = min(cluster.tasks, -(-processes // cluster.local.jobs)) - live
                if wanted > 0:
                    vain += not live  # queued tasks may wait for days: no failure
                    if vain > VAIN:
                        raise UserError(f"tasks end before they start a job: see {cluster.folder}")
                    with interrupt.deferred():  # an interrupted submission could not be cancelled
                        cluster.submit(task, wanted)
                heard = True
            except (UnavailableError, RejectedError) as error:
                # Fail on the first contact. Later, keep trying: a rejection may pass, and must not end running tasks.
                if not heard or (isinstance(error, RejectedError) and not live and vain == VAIN):
                    raise
                note(f"warning: {error}; trying again")
            until = time.monotonic() + LOOK_S
            while time.monotonic() < until:
                time.sleep(0.5)
                interrupt.check("the sweep's tasks have ended")
    except BaseException:
        cluster.stop()
        raise


class SlurmCluster:
    """A sweep's tasks as Slurm job arrays, submitted by submitit under a job name hashed from folder and plan."""

    def __init__(self, options: SlurmOptions, folder: Path, plan: str = "") -> None:
        """Check that submitit and Slurm's commands are installed, or raise UserError. Slurm is not contacted yet.

        Submitit and the tasks write into `folder`, on a disk shared by all nodes.
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
        at_once = options.jobs_per_task
        self.local = LocalOptions(at_once, at_once, max(1, options.cpus // at_once), options.stack)
        self.gpus = options.gpus
        # Sweeps of other plans in the folder have other names: each counts and cancels only its own tasks.
        digest = hashlib.blake2b(f"{folder.resolve()}\n{plan}".encode(), digest_size=4).hexdigest()
        self._name = f"vd4rl-pomdp-{digest}"
        self._executor = submitit.AutoExecutor(folder, cluster="slurm")
        self._executor.update_parameters(name=self._name, stderr_to_stdout=True, **parameters(options))

    def live(self) -> int:
        """Number of this sweep's tasks in the queue or running; UnavailableError if Slurm does not answer."""
        return len(self._ask("squeue", "--array", "--noheader", "--format=%T").split())

    def submit(self, task: ClusterTask, number: int) -> None:
        try:
            with disk_errors(self.folder):
                self._executor.submit_array([task] * number)
        except RuntimeError as error:  # how submitit reports a failed command
            reason = (str(error).strip() or "it does not say why").splitlines()[-1]
            raise RejectedError(f"Slurm rejected the job array ({reason})") from error

    def stop(self) -> None:
        """Cancel pending tasks, signal the running ones to checkpoint and exit, and wait for them."""
        try:
            # Pending tasks first, or they would start as the running ones end.
            self._ask("scancel", "--quiet", "--state=PENDING")
            self._ask("scancel", "--quiet", "--signal=USR2")
            until = time.monotonic() + PATIENCE_S + 15
            while self.live() and time.monotonic() < until:
                time.sleep(1)
            self._ask("scancel", "--quiet")
        except UnavailableError as error:
            note(f"warning: {error}; tasks may still be running: scancel --me --name={self._name}")

    def _ask(self, command: str, *words: str) -> str:
        """Stdout of a Slurm command on this sweep's tasks; UnavailableError if it fails or times out."""
        line = [command, "--me", f"--name={self._name}", *words]
        try:
            answer = subprocess.run(line, capture_output=True, text=True, check=False, timeout=ANSWER_S)
        except subprocess.TimeoutExpired as error:
            raise UnavailableError(f"Slurm does not answer: {command} has not ended after {ANSWER_S:g} s") from error
        if answer.returncode and command == "squeue":  # scancel also fails when there is nothing to cancel
            raise UnavailableError(f"Slurm does not answer: see what squeue says ({one_line(answer.stderr.strip())})")
        return answer.stdout


def parameters(options: SlurmOptions) -> dict[str, Any]:
    """Task options as submitit's `slurm_*` parameters."""
    further = [parameter.removeprefix("--").partition("=") for parameter in options.sbatch]
    found = {
        **{name: getattr(options, name) for name in ("partition", "account", "qos", "constraint", "time")},
        "gpus_per_node": options.gpus or None,
        "mem": None if options.memory is None else f"{options.memory * 1024:.0f}M",
        "cpus_per_task": options.cpus,
        "srun_args": [f"--cpus-per-task={options.cpus}"],  # some Slurm versions do not inherit it from sbatch
        "array_parallelism": options.tasks,
        "signal_delay_s": round(PATIENCE_S + 15),
        "additional_parameters": {"requeue": True} | {name: value or True for name, _, value in further},
    }
    return {f"slurm_{name}": value for name, value in found.items() if value is not None}


class RayCluster:
    """A sweep's tasks on an existing Ray cluster, one job at a time each.

    Ray picks nodes and GPUs, and kills a task when the driver that submitted it dies. Ray's own retries are off.
    """

    def __init__(self, options: RayOptions, folder: Path) -> None:
        """Connect to the cluster; UserError if Ray is missing, no cluster answers, or no node fits a job."""
        try:
            import ray
        except ImportError as error:
            raise UserError("--executor ray needs Ray: pip install '.[ray]' in a clone of vd4rl-pomdp") from error
        self._ray, self._options, self.folder = ray, options, folder
        self.local = LocalOptions(jobs=1, threads=max(1, int(options.cpus)), stack=options.stack)
        self.gpus = options.gpus
        self._running: list[Any] = []
        before = signal.getsignal(signal.SIGTERM)  # ray.init replaces this handler
        try:
            host, colon, port = options.address.rpartition(":")
            if colon and port.isdecimal():  # fail fast: `ray.init` retries for ten minutes and ignores signals
                socket.create_connection((host, int(port)), ANSWER_S).close()
            ray.init(options.address, log_to_driver=False, logging_level=logging.WARNING, ignore_reinit_error=True)
        except (OSError, RuntimeError, ValueError) as error:  # RuntimeError: the cluster runs another Ray version
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
                "or --gpus, or set --jobs, so that the cluster can grow"
            )

    @property
    def tasks(self) -> int:
        """Number of concurrent tasks: `--jobs`, or as many as the current nodes fit."""
        wanted = {"CPU": self._options.cpus, "GPU": self._options.gpus}
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        rooms = (min(int(one.get(name, 0) / share) for name, share in wanted.items() if share) for one in nodes)
        return self._options.jobs or sum(rooms)

    def live(self) -> int:
        """Number of tasks waiting or running. Prints why a task failed."""
        over: list[Any] = []
        if self._running:
            over, self._running = self._ray.wait(self._running, num_returns=len(self._running), timeout=0)
        for task in over:
            try:
                self._ray.get(task)
            except self._ray.exceptions.RayError as error:
                reason = first_line(getattr(error, "cause", None) or error)
                note(f"warning: a task ended ({reason})")
        return len(self._running)

    def submit(self, task: ClusterTask, number: int) -> None:
        run = self._ray.remote(max_retries=0)(lambda: task())  # retries are decided from the sweep's attempt log
        run = run.options(num_cpus=self._options.cpus, num_gpus=self._options.gpus, name=str(self.folder))
        self._running += [run.remote() for _ in range(number)]

    def stop(self) -> None:
        """Cancel pending tasks, ask the running ones to checkpoint and exit, and wait for them."""
        for task in self._running:
            self._ray.cancel(task)
        if self._running:
            _, left = self._ray.wait(self._running, num_returns=len(self._running), timeout=PATIENCE_S + 10)
            for task in left:
                self._ray.cancel(task, force=True)

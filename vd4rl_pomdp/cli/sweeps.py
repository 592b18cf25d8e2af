"""`vd4rl-pomdp sweep`: run grids on this machine, Slurm or Ray."""

from __future__ import annotations

import os
import shlex
import sys
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import tyro

from vd4rl_pomdp.cli.parsing import command, parse_stage, show
from vd4rl_pomdp.core.errors import UserError, flag_of, refuse_no_folder, refuse_unknown
from vd4rl_pomdp.core.options import NO_OPTIONS, Options, StageConfig
from vd4rl_pomdp.runs.outputs import refuse_kept
from vd4rl_pomdp.sweeps.grid import SHARED, load_grid, names, narrow
from vd4rl_pomdp.sweeps.options import (
    EXECUTORS,
    JOB_VARIABLE,
    LocalOptions,
    own_program,
    program_name,
    refuse_unknown_to_jobs,
)

if TYPE_CHECKING:
    from vd4rl_pomdp.sweeps.folder import Plan, SweepFolder
    from vd4rl_pomdp.sweeps.plan import Job


@dataclass(frozen=True, kw_only=True)
class _ExecutorConfig(StageConfig):
    """The executor of jobs."""

    executor: str = "local"
    """local (this machine), slurm or ray."""
    options: Annotated[Options, tyro.conf.arg(name="executor")] = NO_OPTIONS
    """Options of the executor."""

    preset: tyro.conf.Suppress[str] = "paper"
    choosers: ClassVar[tuple[str, ...]] = ("executor",)

    @classmethod
    def parts(cls, values: Mapping[str, Any]) -> dict[str, Options]:
        """Options of the executor."""
        refuse_unknown("executor", values["executor"], EXECUTORS)
        return {"options": EXECUTORS[values["executor"]].fill(values)}


@dataclass(frozen=True, kw_only=True)
class RunCommand(_ExecutorConfig):
    """Run a grid: collect its datasets, pretrain each encoder once, and fine-tune its policies.

    Re-run the same command to resume. Exit code 0: all jobs are finished; 1: some are not.
    """

    grid: tyro.conf.Positional[str] = ""
    """A shipped grid (`vd4rl-pomdp sweep list`), or a TOML or Python file."""
    out: Path = Path()
    """Folder of the runs; existing runs are reused."""
    data: Path | None = None
    """Folder of datasets, DATA/TASK/QUALITY; existing ones are reused, others collected. Default: OUT/data."""
    only: list[str] = field(default_factory=list)
    """Run only cells with these values: method=mik+a,acro seed=0."""
    change: list[str] = field(default_factory=list)
    """Overrides for the blocks with that section: preset=cpu finetune.updates=20000."""
    testing: bool = False
    """Run the grid's testing subset: minutes, to check that everything works."""
    done: list[Path] = field(default_factory=list)
    """Results folders whose runs count as finished."""
    dry_run: bool = False
    """Print every job, which are finished and which are shared; run nothing."""


def run(words: list[str], program: str) -> None:
    """Run or resume a grid."""
    for name in SHARED:
        if flag_of(name) in (word.partition("=")[0] for word in words):
            raise UserError(f"{flag_of(name)} is a setting of the grid's trainings: change it by --change {name}=VALUE")
    config = parse_stage(RunCommand, words, program)
    from vd4rl_pomdp.sweeps import folder as folders  # after --help, which needs no torch
    from vd4rl_pomdp.sweeps import plan as planning
    from vd4rl_pomdp.sweeps.stages import check_cells

    grid = load_grid(config.grid, config.change, config.testing)
    cells = narrow(grid.cells(), config.only)
    check_cells(cells, config.grid)
    # Check before planning, which may decode datasets for minutes.
    for place in (config.out, config.data or config.out):
        refuse_no_folder(place)
    refuse_kept(config.out)
    folder = folders.SweepFolder(config.out)
    file = [str(Path(config.grid).resolve())] * (config.grid not in names())  # a different file is a different grid
    changes = (f"change {word}" for word in config.change)  # not to be taken for the same words of --only
    name = folders.plan_name(grid.name, [*file, *config.only, *changes, *["testing"] * config.testing])
    data, others = config.data or config.out / planning.DATA, folder.jobs_of_others(name)
    jobs, warnings = planning.plan_jobs(cells, config.out, data, planning.runs_kept(config.done), others)
    for job in jobs:
        refuse_unknown_to_jobs(job.settings)
    for warning in warnings:
        print(f"warning: {warning}", file=sys.stderr)
    if config.dry_run:
        _print_plan(jobs, getattr(config.options, "stack", 1))
        return
    plan = folder.keep_plan(name, jobs, own_program())
    carry_out([plan], folder, config.executor, config.options, name)


def _print_plan(jobs: list[Job], stack: int) -> None:
    """Print each job as one shell line, shared jobs, and the number of processes."""
    from vd4rl_pomdp.sweeps.driver import in_stacks

    users = Counter(name for job in jobs for name in job.needs)
    left: list[Job] = []
    for job in jobs:
        state = "done" if job.finished else "resumes" if job.begun else "new"
        print(f"# {job.name}: {state}" + f", for {users[job.name]} jobs" * (users[job.name] > 1))
        if state != "done":
            print(f"{program_name()} {shlex.join(job.words)}")
            left.append(job)
    processes = len(in_stacks(left, stack, {}))
    packed = f" in at least {processes} processes" if processes < len(left) else ""
    print(f"# {len(jobs)} jobs, {len(jobs) - len(left)} done, {len(left)} to do{packed}")


def carry_out(plans: list[Plan], folder: SweepFolder, kind: str, options: Any, name: str = "") -> None:
    """Run plans to their end by an executor and its options; SystemExit 1 if some jobs are not finished.

    `name` is the plan's, empty for all plans in the folder.
    """
    from vd4rl_pomdp.sweeps import clusters
    from vd4rl_pomdp.sweeps import folder as folders
    from vd4rl_pomdp.sweeps.driver import Driver

    if JOB_VARIABLE in os.environ:
        raise UserError("a job cannot start a sweep: end the file in `main()`, which reads the job's own command line")
    if kind == "local":
        finished = Driver(plans, options, folder).run()
    else:
        place = folder.path / kind
        cluster = (
            clusters.SlurmCluster(options, place, name) if kind == "slurm" else clusters.RayCluster(options, place)
        )
        finished = clusters.watch(plans, cluster, folder, name)
    jobs = folders.jobs_of(plans)
    if not finished:
        found = folders.status(jobs, folder.attempts(jobs))
        for row in found["failures"].values():
            print(folders.failure(row, folder.out), file=sys.stderr)
        left = f"{len(jobs) - found['counts'].get('done', 0)} of {len(jobs)} jobs are not finished"
        retry = f"sweep retry {shlex.quote(str(folder.out))}" + (f" --executor {kind}" if kind != "local" else "")
        same = "" if kind == "local" else ", given this command's flags,"
        failures = f"{len(found['failures'])} failed; `{program_name(plans[0].program)} {retry}`"
        print(f"{left}, {failures}{same} retries them")
        sys.exit(1)
    print(f"all {len(jobs)} jobs are finished")


@command
def show_status(out: tyro.conf.Positional[Path], json: bool = False) -> None:
    """Show a sweep's progress: counts, rate, time left, and failures with their error and log.

    Args:
        out: Folder of the sweep.
        json: Print one JSON object.
    """
    from vd4rl_pomdp.sweeps import folder as folders

    folder = folders.SweepFolder(out)
    jobs = folders.jobs_of(folder.plans())
    found = folders.status(jobs, folder.attempts(jobs))
    if json:
        show(found, True)
    else:
        print(*folders.in_lines(found, out), sep="\n")


@dataclass(frozen=True, kw_only=True)
class RetryCommand(_ExecutorConfig):
    """Retry a sweep's failed jobs, and run the unfinished ones."""

    out: tyro.conf.Positional[Path] = Path()
    """Folder of the sweep."""


def retry(words: list[str], program: str) -> None:
    """Retry failed jobs."""
    config = parse_stage(RetryCommand, words, program)
    from vd4rl_pomdp.sweeps import folder as folders  # after --help, as in `run`

    folder = folders.SweepFolder(config.out)
    plans = folder.plans_to_do()
    # Append a row instead of deleting some: other drivers may be reading the file.
    for name, rows in folder.attempts(folders.jobs_of(plans)).items():
        if folders.failed(rows):
            folder.forget(name)
    carry_out(plans, folder, config.executor, config.options)


@command
def join(out: tyro.conf.Positional[Path], local: LocalOptions, plan: str = "") -> None:
    """Work on a running sweep from this machine: run jobs that no other driver runs, and exit when none are left.

    Slurm and Ray tasks do this; on any other cluster, start as many as you like.

    Args:
        out: Folder of the sweep.
        local: Options of the jobs that run here.
        plan: Run only this plan's jobs; default: all plans in OUT/sweep/plans.
    """
    from vd4rl_pomdp.sweeps.driver import Driver
    from vd4rl_pomdp.sweeps.folder import SweepFolder

    local.check()
    folder = SweepFolder(out)
    finished = Driver(folder.plans_to_do(plan), local, folder, helps=True).run()
    print("all jobs are finished" if finished else "no job can start now; `sweep status` shows what is left")
    if not finished:
        sys.exit(1)


@command
def list_grids() -> None:
    """List the grids that ship with the package."""
    for name in names():
        grid = load_grid(name)
        print(f"{name:<18} {len(grid.cells()):>5} cells  {grid.title}")

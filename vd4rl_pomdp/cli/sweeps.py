"""`vd4rl-pomdp sweep`: grids of runs on whatever there is to run them."""

from __future__ import annotations

import shlex
import sys
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import tyro

from vd4rl_pomdp.cli.parsing import parse, parse_stage, show
from vd4rl_pomdp.core.errors import UserError, flag_of, refuse_no_folder
from vd4rl_pomdp.core.options import NO_OPTIONS, Options, StageConfig
from vd4rl_pomdp.sweeps.executors import CLUSTERS, executor_options
from vd4rl_pomdp.sweeps.executors.local import LocalExecutor, LocalOptions
from vd4rl_pomdp.sweeps.own_file import program_here, refuse_unknown_to_jobs, refuse_while_loading

if TYPE_CHECKING:
    from vd4rl_pomdp.sweeps.folder import SweepFolder
    from vd4rl_pomdp.sweeps.plan import Job


@dataclass(frozen=True, kw_only=True)
class _ExecutorConfig(StageConfig):
    """What carries out jobs."""

    executor: str = "local"
    """local (this machine), slurm or ray."""
    options: Annotated[Options, tyro.conf.arg(name="executor")] = NO_OPTIONS
    """What the chosen executor can be told."""

    preset: tyro.conf.Suppress[str] = "paper"
    choosers: ClassVar[tuple[str, ...]] = ("executor",)

    @classmethod
    def parts(cls, values: Mapping[str, Any]) -> dict[str, Options]:
        """Options of the executor."""
        return {"options": executor_options(values["executor"]).fill(values)}


@dataclass(frozen=True, kw_only=True)
class RunCommand(_ExecutorConfig):
    """Carry out a grid: collect its sets, pretrain its encoders, once each, and fine-tune its policies.

    The same command goes on with what is left. Exit code 0: all is finished; 1: some is not.
    """

    grid: tyro.conf.Positional[str] = ""
    """A grid that ships (`vd4rl-pomdp sweep list`), or a TOML or Python file."""
    out: Path = Path()
    """Folder of the runs; runs that lie there are found by what they computed."""
    data: Path | None = None
    """Folder of the sets, DATA/TASK/QUALITY: those that are there are taken, others collected; default OUT/data."""
    only: list[str] = field(default_factory=list)
    """Cells with these values alone: method=mik+a,acro seed=0."""
    change: list[str] = field(default_factory=list)
    """Settings that replace those of every block: preset=cpu finetune.updates=20000."""
    testing: bool = False
    """Run the grid's testing subset: minutes, to see that all works."""
    done: list[Path] = field(default_factory=list)
    """Results folders whose runs count as finished."""
    dry_run: bool = False
    """Print every job, what is finished, what is shared, and an estimate of time; run nothing."""


def run(words: list[str], program: str) -> None:
    """Carry out a grid, or resume it."""
    from vd4rl_pomdp.runs.outputs import refuse_kept
    from vd4rl_pomdp.sweeps.folder import SweepFolder, plan_name
    from vd4rl_pomdp.sweeps.found import FoundRuns, runs_below, runs_kept
    from vd4rl_pomdp.sweeps.grid import SHARED, narrow
    from vd4rl_pomdp.sweeps.grid_file import load_grid, names
    from vd4rl_pomdp.sweeps.plan import DATA, JobPlanner
    from vd4rl_pomdp.sweeps.sets import set_of
    from vd4rl_pomdp.sweeps.stages import check_cells

    for name in SHARED:
        if flag_of(name) in (word.partition("=")[0] for word in words):
            raise UserError(f"{flag_of(name)} is a setting of the grid's trainings: change it by --change {name}=VALUE")
    command = parse_stage(RunCommand, words, program)
    grid = load_grid(command.grid, command.change, command.testing)
    cells = narrow(grid.cells(), command.only)
    for place in (command.out, command.data or command.out):
        refuse_no_folder(place)
    sets = command.data or command.out / DATA
    check_cells(cells, command.grid, lambda cell: not set_of(cell, sets).foreign)
    refuse_kept(command.out)
    here, kept = FoundRuns(runs_below(command.out)), FoundRuns(runs_kept(command.done))
    folder = SweepFolder(command.out)
    own = [str(Path(command.grid).resolve())] * (command.grid not in names())  # another file is another grid
    plan = plan_name(grid.name, [*own, *command.only, *command.change, *["testing"] * command.testing])
    planner = JobPlanner(command.out, sets, kept, here, folder.jobs_of_others(plan))
    jobs = planner.plan(cells)
    refuse_unknown_to_jobs(jobs)
    for name, number in planner.of_other_content.items():
        line = f"{number} kept runs are of a set collected alike, but with other content (from another machine?)"
        print(f"warning: {name}: {line}: they do not count", file=sys.stderr)
    for part, number in planner.changed_since.items():
        print(
            f"warning: {part}: {number} sets or runs count, though its code has changed since they began",
            file=sys.stderr,
        )
    if number := planner.on_other_encoders:
        line = f"{number} policies count that began with other encoders than their pretrainings' folders now hold"
        print(f"warning: {line}", file=sys.stderr)
    if command.dry_run:
        _print_plan(jobs, [*here.runs, *kept.runs])
        return
    folder.keep_plan(plan, jobs)
    _carry_out(jobs, command, folder, plan)


def _print_plan(jobs: list[Job], past: list[Any]) -> None:
    """Every job as one line of shell, then what is shared, and how long it takes."""
    from vd4rl_pomdp.sweeps.estimate import Estimates
    from vd4rl_pomdp.sweeps.work import told_seconds

    estimates, users = Estimates(past, jobs), Counter(name for job in jobs for name in job.needs)
    known, unknown, left = 0.0, 0, 0
    for job in jobs:
        seconds, done = estimates.seconds(job), job.finished
        state = "done" if done else "goes on" if job.begun else "new"
        took = "" if done or seconds is None else f", about {told_seconds(seconds)}"
        shared = f", for {users[job.name]} jobs" if users[job.name] > 1 else ""
        print(f"# {job.name}: {state}{shared}{took}")
        if not done:
            print(f"{program_here()} {shlex.join(job.words)}")
            known, unknown, left = known + (seconds or 0.0), unknown + (seconds is None), left + 1
    told = f"{told_seconds(known)} of work by past runs" + f", {unknown} jobs of unknown length" * (unknown > 0)
    print(f"# {len(jobs)} jobs, {len(jobs) - left} done, {left} to do: {told}")


def _carry_out(jobs: list[Job], command: _ExecutorConfig, folder: SweepFolder, plan: str | None = None) -> None:
    carry_out(jobs, folder, command.executor, command.options, plan)
    print(f"all {len(jobs)} jobs are finished")


def carry_out(jobs: list[Job], folder: SweepFolder, kind: str, options: Any, plan: str | None = None) -> None:
    """Run jobs to their end on an executor of a kind; SystemExit 1 if some are not finished.

    Args:
        jobs: each after those it needs.
        folder: the sweep's.
        kind: name of the executor.
        options: its options.
        plan: name of the plan that the jobs are of; None: of several.
    """
    from vd4rl_pomdp.sweeps.cluster import watch
    from vd4rl_pomdp.sweeps.driver import Driver

    refuse_while_loading()
    if kind in CLUSTERS:
        finished = watch(jobs, CLUSTERS[kind](options, folder.of_executor(kind)), folder, plan)
    else:
        finished = Driver(jobs, LocalExecutor(options), folder).run()
    if not finished:
        failures = _status(folder, jobs).failures
        for name, row in failures.items():
            print(f"{row['cause']}: {name}: {row['line']}", file=sys.stderr)
        left = f"{sum(not job.finished for job in jobs)} of {len(jobs)} jobs are not finished"
        retry = f"sweep retry {shlex.quote(str(folder.out))}" + (f" --executor {kind}" if kind != "local" else "")
        same = "" if kind == "local" else ", given this command's flags,"
        print(f"{left}, {len(failures)} failed; `{program_here()} {retry}`{same} takes those up again")
        sys.exit(1)


def _status(folder: SweepFolder, jobs: list[Job]) -> Any:
    from vd4rl_pomdp.sweeps.estimate import Estimates
    from vd4rl_pomdp.sweeps.found import runs_below
    from vd4rl_pomdp.sweeps.status import status

    return status(jobs, folder.attempts(), Estimates(runs_below(folder.out), jobs))


@dataclass(frozen=True)
class StatusCommand:
    """Show where a sweep stands: counts, rate, time left, and failures with their last line."""

    out: tyro.conf.Positional[Path]
    """Folder of the sweep."""
    json: bool = False
    """Print one JSON object."""


def show_status(words: list[str], program: str) -> None:
    """Show where a sweep stands."""
    from vd4rl_pomdp.sweeps.folder import SweepFolder
    from vd4rl_pomdp.sweeps.status import lines

    command = parse(StatusCommand, words, program)
    folder = SweepFolder(command.out)
    found = _status(folder, folder.jobs())
    if command.json:
        numbers = {"per_hour": found.per_hour, "seconds_left": found.seconds_left, "finished": found.finished}
        show({"counts": dict(found.counts)} | numbers | {"states": found.states, "failures": found.failures}, True)
    else:
        print(*lines(found), sep="\n")


@dataclass(frozen=True, kw_only=True)
class RetryCommand(_ExecutorConfig):
    """Take up the failures of a sweep again, and whatever else is left of its grids."""

    out: tyro.conf.Positional[Path] = Path()
    """Folder of the sweep."""


def retry(words: list[str], program: str) -> None:
    """Run failures again."""
    from vd4rl_pomdp.sweeps.folder import SweepFolder

    command = parse_stage(RetryCommand, words, program)
    folder = SweepFolder(command.out)
    jobs = folder.own_jobs()
    for name in _status(folder, jobs).failures:
        folder.forget(name)
    _carry_out(jobs, command, folder)


@dataclass(frozen=True)
class JoinCommand:
    """Help with a sweep on this machine: take jobs that nobody has, and end when there is none to take.

    What a task of Slurm or Ray does; on any other cluster, start it as often as you like.
    """

    out: tyro.conf.Positional[Path]
    """Folder of the sweep."""
    plan: str = ""
    """Jobs of this plan alone; default: all that lie in OUT/sweep/plans."""
    jobs: int = 0
    """Jobs at a time on this machine; 0: as many as its GPUs take, or one without a GPU."""
    jobs_per_gpu: int = 1
    """Jobs at a time on each GPU."""
    threads: int = 0
    """CPU threads of a job; 0: its share of the machine's cores."""


def join(words: list[str], program: str) -> None:
    """Help with a sweep."""
    from vd4rl_pomdp.sweeps.driver import Driver
    from vd4rl_pomdp.sweeps.folder import SweepFolder

    refuse_while_loading()
    command = parse(JoinCommand, words, program)
    options = LocalOptions(command.jobs, command.jobs_per_gpu, command.threads)
    options.check()
    folder = SweepFolder(command.out)
    finished = Driver(folder.own_jobs(command.plan), LocalExecutor(options), folder, helps=True).run()
    print("all is finished" if finished else "there is nothing to take now; `sweep status` tells what is left")


@dataclass(frozen=True)
class GridsCommand:
    """List the grids that ship with the package."""


def list_grids(words: list[str], program: str) -> None:
    """List the grids that ship."""
    from vd4rl_pomdp.sweeps.grid_file import load_grid, names

    parse(GridsCommand, words, program)
    for name in names():
        grid = load_grid(name)
        print(f"{name:<18} {len(grid.cells()):>5} cells  {grid.title}")

"""Commands that measure or summarise: report, results, theory, bench."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from vd4rl_pomdp.cli.dispatch import Arguments, Command
from vd4rl_pomdp.cli.parsing import parse, show

if TYPE_CHECKING:
    from vd4rl_pomdp.report.load import Choice


@dataclass(frozen=True)
class ReportCommand:
    """Write an HTML page, tables and figures about fine-tuning runs; `report compare A B` puts two sets together."""

    runs: tyro.conf.Positional[list[Path]]
    """Run folders, results folders, or folders that contain some; what `theory --out` wrote adds its section."""
    out: Path = Path("report")
    """Folder of the report."""
    grid: str = ""
    """Report the cells of this grid alone: one that ships (`vd4rl-pomdp sweep list`), or a TOML or Python file."""
    only: list[str] = field(default_factory=list)
    """Of the grid, cells with these values alone: method=mik+a,acro seed=0."""
    change: list[str] = field(default_factory=list)
    """Settings that the grid was carried out with in place of its own: preset=cpu finetune.updates=20000."""


@dataclass(frozen=True)
class CompareCommand:
    """Compare two result sets, condition by condition: scores, their difference, n, and settings that differ."""

    a: tyro.conf.Positional[Path]
    """Run folder, results folder, or folder that contains some."""
    b: tyro.conf.Positional[Path]
    """What it is compared with, likewise."""
    out: Path | None = None
    """Also write an HTML page, CSV and LaTeX into this folder."""


def _compare(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.report.compare import check_out, compare_results, print_comparison, write_comparison

    command = parse(CompareCommand, words, program)
    if command.out is not None:
        check_out(command.out)
    comparison = compare_results(command.a, command.b)
    page = None if command.out is None else write_comparison(comparison, command.out)
    print_comparison(comparison)
    if page is not None:
        print(f"comparison: {page}")


def _report(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.report import print_summary, write_report

    command = parse(ReportCommand, words, program)
    report = write_report(command.runs, command.out, _choice(command))
    print_summary(report)
    for sentence in report.unlike:
        print(f"warning: {sentence}", file=sys.stderr)
    print(f"report: {report.page}")


def _choice(command: ReportCommand) -> Choice:
    """What a report is about."""
    from vd4rl_pomdp.core.errors import UserError
    from vd4rl_pomdp.report.load import ALL

    if not command.grid:
        if command.only or command.change:
            raise UserError("--only and --change are about a grid's cells: name it with --grid")
        return ALL
    from vd4rl_pomdp.sweeps.grid import load_grid, narrow
    from vd4rl_pomdp.sweeps.members import GridMembers

    return GridMembers(command.grid, narrow(load_grid(command.grid, command.change).cells(), command.only))


@dataclass(frozen=True)
class AddCommand:
    """Append finished runs to a results folder: their small files and raw evaluation rows, without weights and films.

    A run that is there already stays as it is, whatever its rows.
    """

    runs: tyro.conf.Positional[list[Path]]
    """Run folders, results folders, or folders that contain some."""
    out: Path
    """The results folder, made if missing."""


def _add(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.runs.results import add_results

    command = parse(AddCommand, words, program)
    added = add_results(command.runs, command.out)
    print(f"{command.out}: {added.in_words}")


@dataclass(frozen=True)
class TheoryCommand:
    """Compute the paper's claims on finite worlds by enumeration, and list where its text differs."""

    json: bool = False
    """Print one JSON object."""
    out: Path | None = None
    """Also write an HTML page with figures, and the JSON, into this folder."""


def _theory(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.report.theory import FILE, print_theory, write_theory
    from vd4rl_pomdp.runs.outputs import refuse_foreign
    from vd4rl_pomdp.studies.theory import theory_study

    command = parse(TheoryCommand, words, program)
    if command.out is not None:
        refuse_foreign(command.out, "study of the theory", FILE)
        command.out.mkdir(parents=True, exist_ok=True)  # before anything is computed
    study = theory_study()
    if command.json:
        print(json.dumps(study))
    else:
        print_theory(study)
    if command.out is not None:
        print(f"page: {write_theory(study, command.out)}", file=sys.stderr if command.json else sys.stdout)


@dataclass(frozen=True)
class BenchCommand:
    """Measure speed and memory of every stage on this machine, as ratios within one run."""

    json: bool = False
    """Print one JSON object instead of a table."""
    quick: bool = False
    """A tenth of the frames and fewer repetitions: rougher numbers, and a peak memory that fixed costs dominate."""


def _bench(words: Arguments, program: str) -> None:
    from vd4rl_pomdp.bench.suite import bench, print_table

    command = parse(BenchCommand, words, program)
    results = bench(command.quick)
    if command.json:
        show(results, as_json=True)
    else:
        print_table(results)


COMMANDS: dict[str, Command | Mapping[str, Command]] = {
    "report": Command(
        "an HTML page, tables and figures about runs; report compare A B for two sets",
        _report,
        {"compare": Command("two result sets side by side", _compare)},
    ),
    "results": {"add": Command("append finished runs to a results folder", _add)},
    "theory": Command("the paper's claims on finite worlds, by enumeration", _theory),
    "bench": Command("speed and memory on this machine", _bench),
}

"""Commands that summarise runs: report, results."""

from __future__ import annotations

import sys
from pathlib import Path

import tyro

from vd4rl_pomdp.cli.parsing import command
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.text import one_line
from vd4rl_pomdp.runs.outputs import refuse_foreign
from vd4rl_pomdp.sweeps.grid import load_grid, narrow


@command
def report(
    runs: tyro.conf.Positional[list[Path]],
    out: Path = Path("report"),
    grid: str = "",
    only: tuple[str, ...] = (),
    change: tuple[str, ...] = (),
) -> None:
    """Write an HTML report with tables and figures about fine-tuning runs.

    `report compare A B` compares two sets of runs.

    Args:
        runs: One or more run folders, results folders, or folders that contain some; output of `theory --out` adds its
            section.
        out: Folder of the report.
        grid: Report only the cells of this grid: a shipped one (`vd4rl-pomdp sweep list`) or a TOML or Python file.
        only: Report only grid cells with these values: method=mik+a,acro seed=0.
        change: Overrides that the grid was run with: preset=cpu finetune.updates=20000.
    """
    from vd4rl_pomdp.report import load, page
    from vd4rl_pomdp.sweeps.members import GridMembers

    choice = load.ALL
    if grid:
        choice = GridMembers(grid, narrow(load_grid(grid, list(change)).cells(), list(only)))
    elif only or change:
        raise UserError("--only and --change apply to the cells of a grid: add --grid")
    written = page.write_report(runs, out, choice)
    page.print_summary(written)
    for sentence in written.unlike:
        print(f"warning: {one_line(sentence)}", file=sys.stderr)
    print(f"report: {written.page}")


@command
def compare(a: tyro.conf.Positional[Path], b: tyro.conf.Positional[Path], out: Path | None = None) -> None:
    """Compare two sets of runs by condition: scores, their difference, n, and settings that differ.

    Args:
        a: Run folder, results folder, or folder that contains some.
        b: The same, to compare with.
        out: Also write an HTML page, CSV and LaTeX into this folder.
    """
    from vd4rl_pomdp.report import compare as comparing

    if out is not None:
        refuse_foreign(out, "comparison", f"{comparing.FILE}.csv")
    comparison = comparing.compare_results(a, b)
    page = None if out is None else comparing.write_comparison(comparison, out)
    comparing.print_comparison(comparison)
    if page is not None:
        print(f"comparison: {page}")


@command
def add(runs: tyro.conf.Positional[list[Path]], out: Path) -> None:
    """Append finished runs to a results folder: small files and raw evaluation rows, without weights and videos.

    A run that is already there only gains rows of later evaluations.

    Args:
        runs: One or more run folders, results folders, or folders that contain some.
        out: The results folder; created if missing.
    """
    from vd4rl_pomdp.runs.results import add_results

    print(f"{out}: {add_results(runs, out)}")


@command
def verify(folder: tyro.conf.Positional[Path], replay: Path | None = None) -> None:
    """Check the rows of a results folder against their records, and optionally replay an episode of a run.

    Args:
        folder: The results folder.
        replay: Folder of a run with encoder and policy; the first episode of its last evaluation is replayed.
    """
    from vd4rl_pomdp.runs.results import verify_results
    from vd4rl_pomdp.studies.certify import contradictions

    runs, wrong = verify_results(folder)
    wrong += contradictions(folder)
    print("\n".join([*map(one_line, wrong), f"{len(runs)} runs, {len(wrong)} contradictions between rows and records"]))
    if replay is not None:
        from finetune import evaluation  # loads OpenGL

        row, now, where = evaluation.replay(replay, runs)
        print(f"episode 0 under {row['evaluated_under']} replays to a return of {now['return']}")
        differ = [
            f"{name} {now[name]} where it says {row[name]}" for name in evaluation.REPLAYED if now[name] != row[name]
        ]
        if differ:
            same = "digits are the same only where these are"
            raise UserError(f"{replay}: replays to {', '.join(differ)}; {where}: {same}")
    if wrong:
        raise UserError(f"{folder}: {len(wrong)} contradictions, see above; ask their author")

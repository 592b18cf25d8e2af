"""The table of results/methods/README.md: every method at one budget, made from rows of results."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from vd4rl_pomdp.report.gates import returns_of
from vd4rl_pomdp.report.load import PROBES, Run, load_runs
from vd4rl_pomdp.report.stats import number
from vd4rl_pomdp.sweeps.grid import load_grid
from vd4rl_pomdp.sweeps.members import GridMembers

RESULTS = Path(__file__).parents[1] / "results"
FOLDERS = ("methods", "offline", "control")
"""Where runs of the grid lie: other grids have some of its cells."""
HIDDEN = {"patch+zero_frames": "patches and frames", "none": "nothing"}
"""What is hidden, as the table calls it, in the order of its columns."""


def main_runs() -> list[Run]:
    """Finished fine-tunings of the grid `methods`."""
    members = GridMembers("methods", load_grid("methods").cells())
    found = load_runs([RESULTS / name for name in FOLDERS], choice=members)
    return [run for run in found if run.rows and run.finished]


def table_lines(runs: Sequence[Run]) -> Iterator[str]:
    """A row for every method, those that return most where patches and frames are hidden first."""
    told = "hidden: return (episodes) | probe: pose, velocity"
    yield f"| | {' | '.join(f'{words} {told}' for words in HIDDEN.values())} |"
    yield "|---|---:|---:|---:|---:|"
    cells = {(run.method, run.labels["corruption"]): run for run in runs}
    ranks = {method: _rank(cells, method) for method, _ in cells}
    for method in sorted(ranks, key=ranks.__getitem__, reverse=True):
        yield f"| `{method}` | {' | '.join(_told(cells.get((method, hidden))) for hidden in HIDDEN)} |"


def _rank(cells: dict[tuple[str, str], Run], method: str) -> tuple[float, ...]:
    """Returns by corruption; what was not trained under it comes last."""
    mine = (cells.get((method, hidden)) for hidden in HIDDEN)
    return tuple(returns_of([run]).item() if run else -1.0 for run in mine)


def _told(run: Run | None) -> str:
    """Return, lowest and highest episode, and probe errors; dashes if there is no run."""
    if run is None:
        return f"{number(None)} | {number(None)}"
    probes = ", ".join(number(run.measures[name], 1) for name in PROBES)
    episodes = [row["return"] for row in run.last]
    return f"{returns_of([run]).item():.0f} ({min(episodes):.0f} to {max(episodes):.0f}) | {probes}"

"""Make the tables of results/earlier/README.md from the rows of its folders."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from operator import itemgetter
from pathlib import Path

import numpy as np

from vd4rl_pomdp.core.text import table_lines
from vd4rl_pomdp.report.gates import difference, episodes_of, returns_of, sides
from vd4rl_pomdp.report.load import PROBES, Run, load_runs
from vd4rl_pomdp.report.stats import mean_interval, number, with_interval
from vd4rl_pomdp.runs.episodes import read_episodes
from vd4rl_pomdp.runs.files import groups
from vd4rl_pomdp.sweeps.grid import load_grid
from vd4rl_pomdp.sweeps.members import GridMembers

RESULTS = Path(__file__).parents[1] / "results"
GRIDS = ("offline", "control")
FOLDERS = tuple(f"earlier/{name}" for name in GRIDS)
HIDDEN, PATCHES, CLEAN = "patch+zero_frames", "patch", "none"
ALONE = ", patches only"
"""Suffix of a dataset's name for patches without zeroed frames."""
UNTRAINED = "random"
SETS = {
    ("walker_walk", "expert_noisy"): "walker_walk, noisy expert",
    ("walker_walk", "expert"): "walker_walk, expert",
    ("walker_walk", "medium_expert"): "walker_walk, medium_expert",
    ("cheetah_run", "medium_noisy"): "cheetah_run, noisy medium",
    ("cheetah_run", "expert_noisy"): "cheetah_run, noisy expert",
    ("cheetah_run", "expert"): "cheetah_run, expert",
    ("cheetah_run", "medium_expert"): "cheetah_run, medium_expert",
}
"""Names of datasets in the table of returns."""
MAIN = (UNTRAINED, "acro", "mik", "mik+a")
"""Methods in the table of returns and in the aggregates."""
EXPLORATORY = ("expert_noisy", "medium_noisy")
"""Qualities chosen after looking at first returns."""
CONTRASTS = {
    "a memory: `mik` minus `acro`": ("mik", "acro"),
    "past actions: `mik+a` minus `mik`": ("mik+a", "mik"),
    "both: `mik+a` minus `acro`": ("mik+a", "acro"),
}
"""The paper's claims, as differences of returns."""
CORRUPTIONS = {"patch+zero_frames": "patches and frames", "none": "nothing"}
"""Names of corruptions in the table of methods, in column order."""
ASIDE = RESULTS / "earlier" / "offline" / "clean_evaluation.csv"
"""Clean evaluations of policies, made after their runs had ended."""
PLACE = ("task", "quality")
IDENTIFIED = (*PLACE, "corruption", "method", "seed")
"""Columns of ASIDE that identify a run."""


def main_runs() -> list[Run]:
    """Finished TD3+BC runs of the grids offline and control, without variants, with the clean evaluations of ASIDE."""
    aside = groups(read_episodes(ASIDE), itemgetter(*IDENTIFIED))
    found = []
    for run in runs_of(GRIDS, FOLDERS):
        if not run.variant:
            clean = [] if run.last_clean else aside.get(run.of(IDENTIFIED), [])
            found.append(replace(run, result=replace(run.result, rows=[*run.result.rows, *clean])))
    return found


def runs_of(grids: Sequence[str], folders: Sequence[str], changes: Sequence[str] = ()) -> list[Run]:
    """Finished fine-tuning runs of some grids (names or TOML files), from results folders, since grids share cells.

    Also those of each grid with one of the `changes`, such as "finetune.updates=100".
    """
    kinds = [[], *([change] for change in changes)]
    cells = [cell for name in grids for kind in kinds for cell in load_grid(name, kind).cells()]
    found = load_runs([RESULTS / name for name in folders], choice=GridMembers(" and ".join(grids), cells))
    return [run for run in found if run.rows and run.finished]


def _of(runs: Sequence[Run], method: str, corruption: str) -> list[Run]:
    """Runs of a method under a corruption, by seed."""
    mine = [run for run in runs if (run.method, run.labels["corruption"]) == (method, corruption)]
    return sorted(mine, key=lambda run: run.labels["seed"])


def _measured_sets(runs: Sequence[Run]) -> Iterator[tuple[tuple[str, str], str, list[Run]]]:
    """Task and quality, corruption, and the runs under any, of the pages' datasets with results."""
    by_set = groups(runs, lambda run: run.of(PLACE))
    for corruption, place in product((HIDDEN, PATCHES), SETS):
        if any(run.labels["corruption"] == corruption for run in by_set.get(place, ())):
            yield place, corruption, by_set[place]


def _name(task: str, quality: str, corruption: str) -> str:
    return f"{task}, {quality}" + ALONE * (corruption == PATCHES)


def return_lines(runs: Sequence[Run]) -> Iterator[str]:
    """Returns of the main methods, one row per dataset and corruption."""
    rows = []
    for place, corruption, here in _measured_sets(runs):
        cells = [_mean_text(_of(here, method, corruption)) for method in MAIN]
        name = f"{SETS[place]} ({here[0].reference.data_return:.0f})" + ALONE * (corruption == PATCHES)
        rows.append((name + ", exploratory" * (place[1] in EXPLORATORY), *cells, _mean_text(_of(here, "acro", CLEAN))))
    head = (f"`{name}`" for name in MAIN)
    return table_lines(("set (data's return)", *head, "`acro` trained with nothing hidden"), rows)


def contrast_lines(runs: Sequence[Run]) -> Iterator[str]:
    """The paper's claims as differences with intervals on every dataset, evaluated as trained and clean."""
    rows = []
    for place, corruption, here in _measured_sets(runs):
        for clean, words in ((False, "as trained"), (True, "clean")):
            cells = [_difference(here, corruption, *pair, clean) for pair in CONTRASTS.values()]
            if any(cell != number(None) for cell in cells):
                rows.append((_name(*place, corruption), words, *cells))
    return table_lines(("set", "evaluated", *CONTRASTS), rows, (0, 1))


def _mean_text(runs: list[Run]) -> str:
    """Mean return with interval, and the number of seeds if below three; a dash if there is none."""
    if not runs:
        return number(None)
    return mean_text(episodes_of(runs)) + (f" (n = {len(runs)})" if len(runs) < 3 else "")


def mean_text(returns: np.ndarray) -> str:
    """Mean of (seeds, episodes) returns, with its interval if there is one."""
    return with_interval(returns.mean(), *(mean_interval(returns) or (None, None)), 0)


def _difference(runs: Sequence[Run], corruption: str, method: str, other: str, clean: bool) -> str:
    """Difference of two methods' mean returns with its interval; a dash if either was not evaluated so."""
    above, ends = difference(sides(_of(runs, method, corruption), _of(runs, other, corruption)), clean)
    text = with_interval(above, *ends, 0)
    return text if above is None else signed(text)


def signed(text: str) -> str:
    """A number in words with its sign."""
    return text if text.startswith("-") else f"+{text}"


def method_lines(runs: Sequence[Run]) -> Iterator[str]:
    """One row per method, by decreasing return under patches and zeroed frames; dashes for missing runs."""
    cells = {(run.method, run.labels["corruption"]): run for run in runs}
    returns = {place: returns_of([run]).item() for place, run in cells.items()}

    def cells_of(method: str, hidden: str) -> tuple[str, str]:
        run = cells.get((method, hidden))
        if run is None:
            return number(None), number(None)
        ends = [row["return"] for row in run.last]
        text = f"{returns[method, hidden]:.0f} ({min(ends):.0f} to {max(ends):.0f})"
        return text, ", ".join(number(run.measures[name], 1) for name in PROBES)

    methods = list(dict.fromkeys(method for method, _ in cells))
    methods.sort(key=lambda method: [returns.get((method, hidden), -1.0) for hidden in CORRUPTIONS], reverse=True)
    columns = [f"{words} hidden: return (episodes)|probe: pose, velocity" for words in CORRUPTIONS.values()]
    head = ["", *(name for both in columns for name in both.split("|"))]
    return table_lines(
        head, ((f"`{one}`", *(cell for h in CORRUPTIONS for cell in cells_of(one, h))) for one in methods)
    )

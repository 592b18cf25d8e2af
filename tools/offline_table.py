"""Make the tables of results/offline, results/control and results/methods/README.md from the rows there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import spearmanr

from vd4rl_pomdp.report.gates import FAILED, PASSED, UNKNOWN, episodes_of, gates, returns_of
from vd4rl_pomdp.report.load import (
    ACTION_ERRORS,
    CONDITION,
    PROBES,
    TOLD_STATES,
    Run,
    episodes_frame,
    groups,
    load_runs,
    runs_frame,
)
from vd4rl_pomdp.report.stats import difference_interval, mean_interval, number, with_interval
from vd4rl_pomdp.report.tables import aggregate, evaluations, improvement
from vd4rl_pomdp.runs.episodes import read_episodes
from vd4rl_pomdp.runs.files import Row
from vd4rl_pomdp.sweeps.grid import load_grid
from vd4rl_pomdp.sweeps.members import GridMembers

RESULTS = Path(__file__).parents[1] / "results"
GRIDS = ("offline", "control")
HIDDEN, PATCHES, CLEAN = "patch+zero_frames", "patch", "none"
ALONE = ", patches alone"
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
    "a memory: `mik` less `acro`": ("mik", "acro"),
    "past actions: `mik+a` less `mik`": ("mik+a", "mik"),
    "both: `mik+a` less `acro`": ("mik+a", "acro"),
}
"""The paper's claims, as differences of returns."""
CORRUPTIONS = {"patch+zero_frames": "patches and frames", "none": "nothing"}
"""Names of corruptions in the table of methods, in column order."""
ASIDE = RESULTS / "offline" / "clean_evaluation.csv"
"""Clean evaluations of policies, made after their runs had ended."""


def main_runs() -> list[Run]:
    """Finished TD3+BC runs of the grids offline and control, without variants."""
    return [run for run in runs_of(GRIDS, GRIDS) if not run.variant]


def runs_of(grids: Sequence[str], folders: Sequence[str]) -> list[Run]:
    """Finished fine-tuning runs of some grids, from results folders, since grids share cells."""
    cells = [cell for name in grids for cell in load_grid(name).cells()]
    found = load_runs([RESULTS / name for name in folders], choice=GridMembers(" and ".join(grids), cells))
    return [run for run in found if run.rows and run.finished]


def return_lines(runs: Sequence[Run]) -> Iterator[str]:
    """Returns of the main methods, one row per dataset and corruption."""
    shown = (*(f"`{name}`" for name in MAIN), "`mik+a` less `acro`", "the same, played clean")
    yield f"| set (data's return) | {' | '.join(shown)} | `acro` trained with nothing hidden |"
    yield "|---|" + "---:|" * (len(shown) + 1)
    for *place, corruption in measured_sets(runs):
        here = [run for run in runs if _place(run) == tuple(place)]
        cells = [_told(_of(here, method, corruption)) for method in MAIN]
        cells += [_less(here, corruption, "mik+a", "acro", clean) for clean in (False, True)]
        name = f"{SETS[tuple(place)]} ({here[0].reference.data_return:.0f})" + ALONE * (corruption == PATCHES)
        name += ", exploratory" * (place[1] in EXPLORATORY)
        yield f"| {name} | {' | '.join(cells)} | {_told(_of(here, 'acro', CLEAN))} |"


def contrast_lines(runs: Sequence[Run]) -> Iterator[str]:
    """The paper's claims as differences with intervals on every dataset, evaluated as trained and clean."""
    yield f"| set | played | {' | '.join(CONTRASTS)} | `mik+a` less the best other |"
    yield "|---|---|" + "---:|" * (len(CONTRASTS) + 1)
    for *place, corruption in measured_sets(runs):
        here = [run for run in runs if _place(run) == tuple(place)]
        other = _best_other(here, corruption)
        pairs = (*CONTRASTS.values(), ("mik+a", other))
        for clean, words in ((False, "as trained"), (True, "with nothing hidden")):
            cells = [_less(here, corruption, *pair, clean) for pair in pairs]
            if any(cell != number(None) for cell in cells):
                cells[-1] += f" (`{other}`)" * (cells[-1] != number(None))
                yield f"| {table_name(*place, corruption)} | {words} | {' | '.join(cells)} |"


def _best_other(runs: Sequence[Run], corruption: str) -> str:
    """The best method with at least two seeds, without `mik+a`, references and methods trained on states."""
    here = [run for run in runs if run.labels["corruption"] == corruption]
    methods = {run.method for run in here} - {"mik+a", "state", UNTRAINED, *TOLD_STATES}
    known = {method: _of(here, method, corruption) for method in methods}
    return max((m for m in known if len(known[m]) > 1), key=lambda method: returns_of(known[method]).mean())


def _less(runs: Sequence[Run], corruption: str, method: str, other: str, clean: bool) -> str:
    """Difference of two methods' mean returns with its interval; a dash if either was not evaluated so."""
    one, two = (_episodes(_of(runs, name, corruption), clean) for name in (method, other))
    if one is None or two is None:
        return number(None)
    text = with_interval(one.mean() - two.mean(), *(difference_interval(one, two) or (None, None)), 0)
    return text if text.startswith("-") else f"+{text}"


def _episodes(runs: list[Run], clean: bool) -> np.ndarray | None:
    """Returns of runs, (n, episodes); None if a policy lacks the clean evaluation."""
    if not clean:
        return episodes_of(runs) if runs else None
    if runs and all(run.last_clean for run in runs):
        return episodes_of(runs, clean=True)
    names = ("task", "quality", "corruption", "method", "seed")
    rows = read_episodes(ASIDE)
    found = [[row["return"] for row in rows if all(row[name] == run.labels[name] for name in names)] for run in runs]
    return np.array(found) if found and all(found) else None


def aggregate_lines(runs: Sequence[Run]) -> Iterator[str]:
    """The report's statistics over datasets, for methods that all of them have."""
    yield "| sets | method | interquartile mean | mean | chance that `mik+a` ends above it |"
    yield "|---|---|---:|---:|---:|"
    shown = [
        run
        for run in runs
        if _place(run) in SETS and run.labels["corruption"] in (HIDDEN, PATCHES) and run.method in MAIN
    ]
    for (exploratory, corruption), mine in groups(shown, _kind).items():
        kind = ("noisy, exploratory" if exploratory else "of the paper's qualities") + ALONE * (corruption == PATCHES)
        evaluated = evaluations(episodes_frame(mine))
        chances = improvement(evaluated)
        above = chances[chances["method"] == "mik+a"].set_index("other")
        table = aggregate(evaluated, pd.DataFrame(columns=list(CONDITION)))
        for row in table.sort_values("mean", ascending=False, kind="stable").to_dict("records"):
            cells = [with_interval(row[name], row[f"{name}_low"], row[f"{name}_high"]) for name in ("iqm", "mean")]
            known = row["method"] in above.index
            chance = above.loc[row["method"], ["probability", "low", "high"]] if known else [None] * 3
            cells.append(with_interval(*chance, 2))
            yield f"| {row['tasks']} {kind} | `{row['method']}` | {' | '.join(cells)} |"


def _kind(run: Run) -> tuple[bool, str]:
    return run.labels["quality"] in EXPLORATORY, run.labels["corruption"]


def measured_sets(runs: Sequence[Run]) -> Iterator[tuple[str, str, str]]:
    """Task, quality and corruption of the pages' datasets with results."""
    measured = {(*_place(run), run.labels["corruption"]) for run in runs}
    asked = ((*place, corruption) for corruption, place in product((HIDDEN, PATCHES), SETS))
    return (one for one in asked if one in measured)


def table_name(task: str, quality: str, corruption: str) -> str:
    """Name of a dataset's table."""
    return f"{task}, {quality}" + ALONE * (corruption == PATCHES)


def gate_lines(runs: Sequence[Run]) -> Iterator[str]:
    """Conditions that a dataset must meet before methods are ranked on it."""
    yield (
        "| set | data's return | `state`, of it | `acro` with nothing hidden, of it | its bar (published score) |"
        " best of it | best less `random` | passed |"
    )
    yield "|---|---:|---:|---:|---:|---:|---:|---|"
    for row in _judged(runs):
        shares = [
            number(row[f"{name}_share"], 2) + f" (n = {row[f'{name}_seeds']})" * (row[f"{name}_seeds"] < 3)
            for name in ("state", "acro")
        ]
        shares += [f"{number(row['acro_bar'], 2)} ({row['bar_from']})", number(row["best_share"], 2)]
        above = with_interval(row["above_random"], row["low"], row["high"], 0)
        yield f"| {row['name']} | {row['data_return']:.0f} | {' | '.join(shares)} | {above} | {row['passed']} |"


def rank_lines(runs: Sequence[Run]) -> Iterator[str]:
    """Rank correlation of policy diagnostics with returns on each dataset, with and without untrained encoders."""
    yield "| set | passed | runs | " + " | ".join(GOING_WITH.values()) + " |"
    yield "|---|---|---:|" + "---:|" * len(GOING_WITH)
    table = runs_frame(runs)
    table = table[table[PROBES[0]].notna() & ~table["method"].isin(TOLD_STATES)]  # with a held-out probe
    for row in _judged(runs):
        places = ["task", "quality", "corruption"]
        probed = table[(table[places] == [row[name] for name in places]).all(axis=1)]
        trained = probed[probed["method"] != UNTRAINED]
        cells = (f"{_rank_correlation(probed, name)}, {_rank_correlation(trained, name)}" for name in GOING_WITH)
        yield f"| {row['name']} | {row['passed']} | {len(probed)}, {len(trained)} | {' | '.join(cells)} |"


def _judged(runs: Sequence[Run]) -> Iterator[Row]:
    """Gates of the pages' datasets, by their `name`s there, and whether they are `passed`."""
    for row in gates(list(runs)):
        place = row["task"], row["quality"]
        if row["corruption"] in (HIDDEN, PATCHES) and place in SETS:
            passed = {PASSED: "yes", FAILED: "undecided", UNKNOWN: "not known"}[row["verdict"].partition(":")[0]]
            yield row | {"name": table_name(*place, row["corruption"]), "passed": passed}


def _rank_correlation(table: pd.DataFrame, error: str) -> str:
    """Spearman correlation of an error and the return over runs: -1 if a smaller error always has a larger return.

    A dash for a single run, or if a run lacks the error.
    """
    if len(table) < 2 or table[error].isna().any():
        return number(None)
    return f"{spearmanr(table[error], table['return']).statistic:.2f}"


GOING_WITH = {
    **dict(zip(PROBES, ("probe of the pose", "probe of the velocity"), strict=True)),
    **dict(zip(ACTION_ERRORS, ("actions on the data", "actions in closed loop"), strict=True)),
}
"""Errors to correlate with returns, by column of the frame of runs."""


def _place(run: Run) -> tuple[str, str]:
    return run.labels["task"], run.labels["quality"]


def _of(runs: Sequence[Run], method: str, corruption: str) -> list[Run]:
    """Runs of a method under a corruption, by seed."""
    mine = [run for run in runs if (run.method, run.labels["corruption"]) == (method, corruption)]
    return sorted(mine, key=lambda run: run.labels["seed"])


def _told(runs: list[Run]) -> str:
    """Mean return with interval, and the number of seeds if below three; a dash if there is none."""
    if not runs:
        return number(None)
    returns = episodes_of(runs)
    text = with_interval(returns.mean(), *(mean_interval(returns) or (None, None)), 0)
    return text + (f" (n = {len(runs)})" if len(runs) < 3 else "")


def method_lines(runs: Sequence[Run]) -> Iterator[str]:
    """One row per method, by decreasing return under patches and zeroed frames."""
    told = "hidden: return (episodes) | probe: pose, velocity"
    yield f"| | {' | '.join(f'{words} {told}' for words in CORRUPTIONS.values())} |"
    yield "|---|---:|---:|---:|---:|"
    cells = {(run.method, run.labels["corruption"]): run for run in runs}
    ranks = {method: _rank_of(cells, method) for method, _ in cells}
    for method in sorted(ranks, key=ranks.__getitem__, reverse=True):
        yield f"| `{method}` | {' | '.join(_told_once(cells.get((method, hidden))) for hidden in CORRUPTIONS)} |"


def _rank_of(cells: dict[tuple[str, str], Run], method: str) -> tuple[float, ...]:
    """Sort key: returns by corruption; missing ones come last."""
    mine = (cells.get((method, hidden)) for hidden in CORRUPTIONS)
    return tuple(returns_of([run]).item() if run else -1.0 for run in mine)


def _told_once(run: Run | None) -> str:
    """Return, lowest and highest episode, and probe errors; dashes if there is no run."""
    if run is None:
        return f"{number(None)} | {number(None)}"
    probes = ", ".join(number(run.measures[name], 1) for name in PROBES)
    episodes = [row["return"] for row in run.last]
    return f"{returns_of([run]).item():.0f} ({min(episodes):.0f} to {max(episodes):.0f}) | {probes}"

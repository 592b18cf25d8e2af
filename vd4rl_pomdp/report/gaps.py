"""What a report has no final score for, although other runs suggest one: the gaps in methods, settings and seeds."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import groupby
from operator import attrgetter

from vd4rl_pomdp.core.settings import LABELS
from vd4rl_pomdp.report.grouping import groups
from vd4rl_pomdp.report.load import CONDITION, SETTING, LoadedRun, without_options
from vd4rl_pomdp.report.variants import ENCODER_SEED
from vd4rl_pomdp.runs.files import Row

Setting = tuple[str, str, str]
"""Values of SETTING."""
MISSING = "missing"
STATE = "state"
"""The method that sees the simulator's state, whatever a setting hides."""


def find_gaps(runs: list[LoadedRun]) -> list[Row]:
    """One row for each run that is missing or unfinished: CONDITION, seed and `state`.

    Expected in a setting are all methods of the report with all their variants, each with every seed that any other
    run has in that setting.
    """
    grid = [run for run in runs if run.stage == "finetune" and run.labels["task"]]
    by_method = groups(grid, _method)
    rows = []
    for setting, here in groups(grid, _setting).items():
        evaluated_last = sorted(here, key=attrgetter("evaluated"))
        there = {(*_method(run), run.variant, run.labels["seed"]): run for run in evaluated_last}
        seeds = sorted({run.labels["seed"] for run in here})
        for algorithm, method, variant in _expected(by_method, setting):
            condition = dict(zip(CONDITION, (*setting, algorithm, method, variant), strict=True))
            for seed in seeds:
                run = there.get((algorithm, method, variant, seed))
                if not _is_own(variant, seed) and (run is None or not run.evaluated):
                    rows.append(condition | {"seed": seed, "state": _state(run)})
    return rows


def never_begun(runs: list[LoadedRun], gaps: Iterable[Row], wanted: Iterable[Row]) -> list[Row]:
    """One row, as of `find_gaps`, for each policy that is wanted and of which neither a run nor a gap tells.

    Of settings in which there is any run.

    Args:
        runs: all of the report.
        gaps: of `find_gaps`.
        wanted: labels (`settings.LABELS`) of policies.
    """
    policies = [run.labels for run in runs if run.stage == "finetune"]
    known = {without_options(row, LABELS) for row in (*policies, *gaps)}
    settings = {without_options(row, SETTING): row["corruption"] for row in policies}
    return [
        {name: row.get(name, "") for name in CONDITION}
        | {"corruption": settings[without_options(row, SETTING)], "seed": row["seed"], "state": MISSING}
        for row in wanted
        if without_options(row, LABELS) not in known and without_options(row, SETTING) in settings
    ]


def _is_own(variant: str, seed: int) -> bool:
    """Whether a variant's encoder is that of a seed: with it the seed is one of the method, not of the variant."""
    return f"{ENCODER_SEED} {seed}" in variant.split(", ")


def _setting(run: LoadedRun) -> Setting:
    task, quality, corruption = (run.labels[name] for name in SETTING)
    return task, quality, corruption


def _state(run: LoadedRun | None) -> str:
    return MISSING if run is None or run.finished else run.progress


def _expected(by_method: dict[tuple[str, str], list[LoadedRun]], setting: Setting) -> Iterator[tuple[str, str, str]]:
    """Algorithm, method and variant of every run that is expected in a setting; those by data where they are found."""
    for (algorithm, method), mine in by_method.items():
        for shared in _shared(mine, setting):
            here = [run for run in mine if run.parts[0] == shared and _setting(run) == setting]
            for data in {run.parts[1]: None for run in here} or [""]:
                yield algorithm, method, ", ".join(filter(None, (shared, data)))


def _shared(mine: list[LoadedRun], setting: Setting) -> Iterable[str]:
    """Variants of a method that are expected in a setting: those of all settings that share a variant with it.

    Where each setting has variants of its own, such as a budget for every task, nothing is missing; nor is `state`
    where other pixels of the same set are hidden.
    """
    by_setting: dict[Setting, dict[str, None]] = {}
    for run in mine:
        by_setting.setdefault(_setting(run), {})[run.parts[0]] = None
    own = by_setting.get(setting)
    if own is None and mine[0].labels["method"] == STATE and any(there[:2] == setting[:2] for there in by_setting):
        return ()
    wanted = [there for there in by_setting.values() if own is None or own.keys() & there.keys()]
    return {variant: None for there in wanted for variant in there}


def _method(run: LoadedRun) -> tuple[str, str]:
    return run.labels["algorithm"], run.labels["method"]


def in_words(gaps: list[Row]) -> str:
    """Gaps of one condition: "seeds 1, 2 missing; seed 3 unfinished at 20 of 40 updates"."""
    sentences = []
    for state, members in groupby(sorted(gaps, key=lambda row: row["state"]), lambda row: row["state"]):
        seeds = [str(row["seed"]) for row in members]
        sentences.append(f"seed{'s' * (len(seeds) > 1)} {', '.join(seeds)} {state}")
    return "; ".join(sentences)


def condition_of(row: Row) -> tuple[str, ...]:
    """The condition that a row of a table or of `find_gaps` is about."""
    return tuple(str(row[name]) for name in CONDITION)

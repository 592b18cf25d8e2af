"""What a report has no final score for, although other runs suggest one: the gaps in methods, settings and seeds."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from operator import attrgetter

from vd4rl_pomdp.core.options import LABELS
from vd4rl_pomdp.report.load import ALL, CONDITION, SETTING, Choice, Run, without_options
from vd4rl_pomdp.report.variants import ENCODER_SEED
from vd4rl_pomdp.runs.files import Row, groups

MISSING = "missing"
STATE = "state"
"""The method that sees the simulator's state, whatever a setting hides."""


def find_gaps(runs: list[Run], choice: Choice = ALL) -> list[Row]:
    """One row for each run that is missing or unfinished: CONDITION, seed and `state`.

    Expected in a setting are all methods of the report with all their variants, each with every seed that any other
    run has in that setting, and what the choice wants there.
    """
    grid = [run for run in runs if run.stage == "finetune" and run.labels["task"]]
    rows = []
    for setting, here in groups(grid, lambda run: run.of(SETTING)).items():
        there = {run.of((*CONDITION, "seed")): run for run in sorted(here, key=attrgetter("evaluated"))}
        seeds = sorted({run.labels["seed"] for run in here})
        for method, mine in groups(grid, lambda run: run.of(("algorithm", "method"))).items():
            for variant in _expected(mine, setting):
                # A seed on the encoder of its own is one of the method, not of the variant that shares it.
                own = {seed for seed in seeds if f"{ENCODER_SEED} {seed}" in variant.split(", ")}
                for seed in (seed for seed in seeds if seed not in own):
                    run = there.get((*setting, *method, variant, seed))
                    if run is None or not run.evaluated:
                        state = MISSING if run is None or run.finished else run.progress
                        values = (*setting, *method, variant)
                        rows.append(dict(zip(CONDITION, values, strict=True)) | {"seed": seed, "state": state})
    rows = [row for row in rows if choice.asks(row)]
    return rows + _never_begun(grid, rows, choice.wanted)


def _expected(mine: list[Run], setting: tuple[str, ...]) -> Iterator[str]:
    """Variants of a method that are expected in a setting: those of all settings that share a variant with it.

    Where each setting has variants of its own, such as a budget for every task, nothing is missing; nor is `state`
    where other pixels of the same set are hidden. Those by data are expected where they are found.
    """
    by_setting = groups(mine, lambda run: run.of(SETTING))
    here = by_setting.get(setting, [])
    if not here and mine[0].method == STATE and any(there[:2] == setting[:2] for there in by_setting):
        return
    own = {run.parts[0] for run in here}
    shared = [there for there in by_setting.values() if not own or own & {run.parts[0] for run in there}]
    for variant in dict.fromkeys(run.parts[0] for there in shared for run in there):
        for data in dict.fromkeys(run.parts[1] for run in here if run.parts[0] == variant) or [""]:
            yield ", ".join(filter(None, (variant, data)))


def _never_begun(grid: list[Run], gaps: list[Row], wanted: Iterable[Row]) -> list[Row]:
    """A row for each policy that is wanted in a setting of any run and of which neither a run nor a gap tells."""
    known = {without_options(row, LABELS) for row in (*(run.labels for run in grid), *gaps)}
    settings = {without_options(run.labels, SETTING): run.labels["corruption"] for run in grid}
    return [
        {name: row.get(name, "") for name in CONDITION}
        | {"corruption": settings[without_options(row, SETTING)], "seed": row["seed"], "state": MISSING}
        for row in wanted
        if without_options(row, LABELS) not in known and without_options(row, SETTING) in settings
    ]


def in_words(gaps: Iterable[Row]) -> str:
    """Gaps of one condition: "seeds 1, 2 missing; seed 3 unfinished at 20 of 40 updates"."""
    by_state = groups(sorted(gaps, key=lambda row: row["state"]), lambda row: str(row["state"]))
    told = {state: [str(row["seed"]) for row in members] for state, members in by_state.items()}
    return "; ".join(f"seed{'s' * (len(seeds) > 1)} {', '.join(seeds)} {state}" for state, seeds in told.items())

"""Means with standard errors that the pages tell, in sentences too, are those of committed rows."""

import importlib
import itertools
import math
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from vd4rl_pomdp.experiments.navigation.report import write_report
from vd4rl_pomdp.navigation.measures import online_error, refitted_error
from vd4rl_pomdp.report.gates import returns_of
from vd4rl_pomdp.report.load import load_runs
from vd4rl_pomdp.runs.episodes import read_episodes

ROOT = Path(__file__).parents[2]
TOLD = re.compile(r"[-+]?\d+(?:\.\d+)? ± \d+(?:\.\d+)?")
MAIN = ("control", "offline")
"""Folders whose rows count as one."""
ASIDE = ("control/budget", "control/histories", "control/expert")
REPORTS = sorted(found.parent for found in (ROOT / "results" / "navigation").rglob("tables.csv"))
MEASURES = (
    *(online_error(component).raw() for component in ("state", "position", "velocity")),
    *(refitted_error(component) for component in ("state", "position", "velocity")),
    *(refitted_error(component).raw() for component in ("state", "position", "velocity")),
)
"""Of mazes: the paper's way and units, and the refitted probe's in both units."""
Estimate = tuple[float, float]
"""A mean and its standard error."""


def estimate(numbers: Iterable[float]) -> Estimate | None:
    found = np.array(list(numbers))
    return (found.mean(), found.std(ddof=1) / math.sqrt(len(found))) if len(found) > 1 else None


def told(one: Estimate, digits: int) -> str:
    return f"{one[0]:.{digits}f} ± {one[1]:.{digits}f}"


def with_differences(estimates: Iterable[Estimate | None], digits: int) -> Iterator[str]:
    """Estimates that can be compared, and every difference of two."""
    known = [one for one in estimates if one]
    yield from (told(one, digits) for one in known)
    for one, other in itertools.permutations(known, 2):
        yield told((one[0] - other[0], math.hypot(one[1], other[1])), digits)


def of_returns(folders: Iterable[str]) -> Iterator[str]:
    """Of methods on one set, whatever was hidden from them, over seeds; of each run over its episodes."""
    groups = defaultdict(lambda: defaultdict(list))
    for run in load_runs([ROOT / "results" / name for name in folders]):
        if run.rows and run.finished:
            kind = run.labels["corruption"], run.labels["algorithm"], run.labels["method"], run.variant
            groups[run.set_name][kind].append(run)
            yield told(estimate(row["return"] for row in run.last), 0)
    for methods in groups.values():
        yield from with_differences((estimate(returns_of(mine)) for mine in methods.values()), 0)


def played_clean() -> Iterator[str]:
    """Of policies that were trained under a corruption and played again without."""
    seeds = defaultdict(list)
    for row in read_episodes(ROOT / "results" / "offline" / "clean_evaluation.csv"):
        seeds[row["method"], row["seed"]].append(row["return"])
    for method in {method for method, _ in seeds}:
        mine = [np.mean(returns) for (name, _), returns in seeds.items() if name == method]
        yield from with_differences([estimate(mine)], 0)


def of_mazes(script: ModuleType) -> Iterator[str]:
    """Of the pages' measures in every maze; differences only between settings of one method in one maze."""
    groups = defaultdict(lambda: defaultdict(list))
    for run in script.main_runs():
        groups[run.condition.maze, run.condition.method][run.condition].append(run)
    for conditions, measure in itertools.product(groups.values(), MEASURES):
        numbers = [script.entry_of(condition, measure, mine).numbers for condition, mine in conditions.items()]
        for digits in (1, 2):
            yield from with_differences(map(estimate, numbers), digits)


@pytest.fixture(scope="module")
def known() -> set[str]:
    places = [MAIN, *((name,) for name in (*MAIN, *ASIDE))]
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "scripts")
        script = importlib.import_module("navigation_table")
    return {word for folders in places for word in of_returns(folders)} | {*played_clean(), *of_mazes(script)}


def unknown(text: str, known: set[str]) -> list[str]:
    return [found for found in TOLD.findall(text) if found.lstrip("+") not in known]


@pytest.mark.parametrize(
    "page", ["README.md", "docs/navigation.md", "results/offline/README.md", "results/control/README.md"]
)
def test_what_a_page_tells_is_in_the_rows(page, known):
    text = (ROOT / page).read_text(encoding="utf-8")
    assert len(TOLD.findall(text)) > 20
    assert unknown(text, known) == []


@pytest.mark.parametrize("text", ["`mik+a` returns 521 ± 60", "`mik` minus `acro` +181 ± 13", "missed by 5.15 ± 0.11"])
def test_what_no_row_says_is_found(text, known):
    assert unknown(text, known) == TOLD.findall(text)


@pytest.mark.parametrize("place", REPORTS, ids=lambda place: place.name)
def test_a_report_on_mazes_is_what_its_rows_and_todays_code_make_of_it(place, tmp_path):
    """But for the sample observations, which take a renderer."""
    write_report([place], tmp_path / "again")
    for name in ("README.md", "rows.csv", "tables.csv"):
        committed = (place / name).read_text(encoding="utf-8")
        sample = "![Sample observations](figures/observations.png)\n\n"
        assert (tmp_path / "again" / name).read_text(encoding="utf-8") == committed.replace(sample, ""), name

"""Means with intervals or standard errors quoted in sentences on the pages match committed rows."""

import functools
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

from vd4rl_pomdp.agents import SHIPPED, shipped
from vd4rl_pomdp.report.gates import episodes_of
from vd4rl_pomdp.report.load import Run, load_runs
from vd4rl_pomdp.report.stats import difference_interval, mean_interval, with_interval
from vd4rl_pomdp.runs.files import groups, read_json
from vd4rl_pomdp.runs.results import read_certificates
from vd4rl_pomdp.studies.navigation.report import write_report
from vd4rl_pomdp.studies.navigation.runs import online_error, refitted_error

ROOT = Path(__file__).parents[3]
QUOTED = re.compile(r"[-+]?\d+(?:\.\d+)? ± \d+(?:\.\d+)?|[-+]?\d+(?: more| less| above it)? \[-?\d+, -?\d+\]")
PAIR = re.compile(r"(`[^`]+`(?: with a GRU)?) minus (`[^`]+`(?: with a GRU)?)")
"""The two methods of quoted differences, which follow in the sentence."""
SENTENCE = re.compile(r"\.\s|\n\n")
"""The end of a sentence."""
GENERATED = re.compile(r"<!-- table: .* -->\n(?:\|.*\n)*")
"""Tables that scripts write; tests/tools/test_scripts.py compares them with the rows."""
MAIN = ("earlier/control", "earlier/offline")
"""Folders whose rows are pooled."""
ASIDE = ("earlier/control/budget", "earlier/control/histories", "earlier/control/expert", "protocol")
REPORTS = sorted(found.parent for found in (ROOT / "results" / "navigation").rglob("tables.csv"))
MEASURES = (
    *(online_error(component).raw() for component in ("state", "position", "velocity")),
    *(refitted_error(component) for component in ("state", "position", "velocity")),
    *(refitted_error(component).raw() for component in ("state", "position", "velocity")),
)
"""Navigation: the paper's online probe in its units, and the refitted probe in both units."""
Estimate = tuple[float, float]
"""A mean and its standard error."""


def estimate(numbers: Iterable[float]) -> Estimate | None:
    found = np.array(list(numbers))
    return (found.mean(), found.std(ddof=1) / math.sqrt(len(found))) if len(found) > 1 else None


def quoted(one: Estimate, digits: int) -> str:
    return f"{one[0]:.{digits}f} ± {one[1]:.{digits}f}"


def with_differences(estimates: Iterable[Estimate | None], digits: int) -> Iterator[str]:
    """Estimates that can be compared, and every difference of two."""
    known = [one for one in estimates if one]
    yield from (quoted(one, digits) for one in known)
    for one, other in itertools.permutations(known, 2):
        yield quoted((one[0] - other[0], math.hypot(one[1], other[1])), digits)


@functools.cache
def on_sets(folders: tuple[str, ...]) -> list[list[list[Run]]]:
    """Seeds of each method, corruption and variant on each set."""
    runs = [run for run in load_runs([ROOT / "results" / name for name in folders]) if run.rows and run.finished]
    by_set = groups(runs, lambda run: run.set_name).values()
    names = ("corruption", "algorithm", "method", "variant")
    return [list(groups(mine, lambda run: run.of(names)).values()) for mine in by_set]


def of_returns(folders: tuple[str, ...]) -> Iterator[str]:
    """Quotable returns of methods on one set, under all corruptions and clean, and of single runs."""
    for everyone in on_sets(folders):
        yield from (quoted(estimate(row["return"] for row in run.last), 0) for mine in everyone for run in mine)
        yield from intervals([episodes_of(mine) for mine in everyone])
        yield from intervals([episodes_of(mine, True) for mine in everyone if all(run.last_clean for run in mine)])


def of_pairs(folders: tuple[str, ...]) -> Iterator[tuple[str, str, str]]:
    """Quotable differences on one set, each after the names of its two methods."""
    for everyone in on_sets(folders):
        for left, right in itertools.permutations(everyone, 2):
            names = [
                f"`{side[0].method}`" + " with a GRU" * ("history gru" in side[0].variant) for side in (left, right)
            ]
            for clean in [False, True][: 1 + all(run.last_clean for run in (*left, *right))]:
                one, other = episodes_of(left, clean), episodes_of(right, clean)
                ends = difference_interval(one, other) or (None, None)
                yield names[0], names[1], with_interval(one.mean() - other.mean(), *ends, 0)


def of_shifts() -> Iterator[str]:
    """Quotable returns of `acro` with its authors' random shift, compared with `acro` as the grids train it."""
    runs = load_runs([ROOT / "results" / "earlier" / name for name in ("control", "control/budget")])
    groups = defaultdict(list)
    for run in runs:
        if run.set_name == "walker_walk expert_noisy" and run.method in ("acro", "acro_shifted"):
            groups[run.labels["corruption"], run.method, run.variant].append(run)
    return intervals([episodes_of(mine) for mine in groups.values()])


def intervals(returns: list[np.ndarray]) -> Iterator[str]:
    """Means with intervals of (seeds, episodes) returns, and every difference of two."""
    for mine in returns:
        yield with_interval(mine.mean(), *(mean_interval(mine) or (None, None)), 0)
    for one, other in itertools.permutations(returns, 2):
        yield with_interval(one.mean() - other.mean(), *(difference_interval(one, other) or (None, None)), 0)


def of_agents() -> Iterator[str]:
    """Quotable returns of shipped agents under their training corruption."""
    for name in shipped():
        card = read_json(SHIPPED / name / "card.json")
        rows = [row for row in card["episodes"] if row["evaluated_under"] == card["corruption"]["corruption"]]
        yield from intervals([np.array([[row["return"]] for row in rows])])


def of_mazes(script: ModuleType) -> Iterator[str]:
    """Quotable errors in every maze; differences only between settings of one method in one maze."""
    numbers = script.numbers_in()
    conditions = defaultdict(set)
    for run in script.main_runs():
        conditions[run.condition.maze, run.condition.method].add(run.condition)
    for mine, measure in itertools.product(conditions.values(), MEASURES):
        found = [script.values(numbers, condition, measure) for condition in sorted(mine)]
        for digits in (1, 2):
            yield from with_differences(map(estimate, found), digits)


PLACES = [MAIN, *((name,) for name in (*MAIN, *ASIDE))]


@pytest.fixture(scope="module")
def known_pairs() -> set[tuple[str, str, str]]:
    return {found for folders in PLACES for found in of_pairs(folders)}


@pytest.fixture(scope="module")
def known() -> set[str]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "tools")
        script = importlib.import_module("navigation_table")
    return {word for folders in PLACES for word in of_returns(folders)} | {
        *of_shifts(),
        *of_agents(),
        *of_mazes(script),
    }


def unknown(text: str, known: set[str]) -> list[str]:
    """Quoted numbers that no row supports; words may separate a difference from its interval."""
    return [found for found in QUOTED.findall(text) if number_in(found) not in known]


def number_in(found: str) -> str:
    return re.sub(r" (more|less|above it)", "", found).lstrip("+")


def unknown_pairs(text: str, known: set[tuple[str, str, str]]) -> list[tuple[str, str, str]]:
    """Quotes of "`X` minus `Y`", up to the next pair or the end of the sentence, that are not of X and Y."""
    _, *parts = PAIR.split(text)  # left, right, the text that follows, left, ...
    pairs = zip(parts[::3], parts[1::3], parts[2::3], strict=True)
    quotes = [(*pair, number_in(found)) for *pair, rest in pairs for found in QUOTED.findall(SENTENCE.split(rest)[0])]
    return [quote for quote in quotes if quote not in known]


@pytest.mark.parametrize(
    ("page", "least"),
    [
        ("README.md", 2),
        ("docs/methods/acro.md", 6),
        ("docs/methods/ah.md", 1),
        ("docs/methods/supervised.md", 2),
        ("results/README.md", 3),
        ("results/earlier/README.md", 9),
        ("results/protocol/README.md", 4),
        ("results/gpu/README.md", 4),
        ("results/navigation/README.md", 7),
    ],
)
def test_quoted_intervals_match_committed_rows(page, least, known, known_pairs):
    text = GENERATED.sub("", (ROOT / page).read_text(encoding="utf-8"))
    assert len(QUOTED.findall(text)) >= least
    assert unknown(text, known) == []
    assert unknown_pairs(text, known_pairs) == []


def test_quotes_of_other_methods_are_found(known_pairs):
    right = "`mik+a` minus `acro` is 108 [49, 167] (p = 0.008). 101 [29, 172]\n\n`mik` minus `acro`: 7 [-57, 71]"
    assert unknown_pairs(right, known_pairs) == []
    found = unknown_pairs("`mik` minus `acro`, 7 [-57, 71], and `mik` minus `mik+a`, 101 [29, 172]", known_pairs)
    assert found == [("`mik`", "`mik+a`", "101 [29, 172]")]


@pytest.mark.parametrize(
    "text", ["`mik+a` returns 521 [321, 720]", "`mik` less `acro` +180 [106, 253]", "by 5.15 ± 0.11"]
)
def test_unsupported_quotes_are_found(text, known):
    assert unknown(text, known) == QUOTED.findall(text)


def test_protocol_page_quotes_its_certificates():
    text = (ROOT / "results" / "protocol" / "README.md").read_text(encoding="utf-8")
    for certificate in read_certificates([ROOT / "results" / "protocol"]).values():
        found = certificate["measured"]["R2"]
        assert certificate["verdict"] in text
        assert with_interval(*found["methods"]["supervised+a"], 2) in text
        assert all(with_interval(*values, 2) in text for values in found["above"].values())


@pytest.mark.parametrize("place", REPORTS, ids=lambda place: place.name)
def test_navigation_reports_are_reproducible(place, tmp_path):
    write_report([place], tmp_path / "again")
    for name in ("rows.csv", "tables.csv"):
        assert (tmp_path / "again" / name).read_text() == (place / name).read_text(), name

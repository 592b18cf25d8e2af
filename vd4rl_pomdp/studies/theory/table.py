"""The paper's Table 1 and the equations of its section 3.1, computed on the gallery's worlds beside what is printed."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass

from vd4rl_pomdp.runs.files import Row
from vd4rl_pomdp.studies.theory.classifiers import Memory, compare
from vd4rl_pomdp.studies.theory.decodability import future_memory, past_memory
from vd4rl_pomdp.studies.theory.gallery import WORLDS, variants
from vd4rl_pomdp.studies.theory.partition import discards_noise, forced_shares, relation
from vd4rl_pomdp.studies.theory.views import VIEWS
from vd4rl_pomdp.studies.theory.world import World, diameter, period

Properties = dict[str, bool]
"""Which of COLUMNS hold for a method."""
COLUMNS = ("correct", "complete", "discards")
"""Correct Bayes-optimal classifier, complete agent-centric state, discards exogenous noise."""
PRINTED: dict[str, Properties] = {
    "ah": {"correct": False, "complete": False, "discards": True},
    "ah+a": {"correct": False, "complete": False, "discards": True},
    "fj": {"correct": True, "complete": False, "discards": True},
    "fj+a": {"correct": True, "complete": False, "discards": True},
    "mik": {"correct": True, "complete": False, "discards": True},
    "mik+a": {"correct": True, "complete": True, "discards": True},
}
"""Table 1 as printed."""
METHODS = tuple(name for name in VIEWS if name != "no_history")


def printed(method: str) -> Properties:
    """The printed row of a method; a literal reading is compared with the same row."""
    return PRINTED[method.removesuffix(" literal")]


@dataclass(frozen=True)
class Case:
    """One world with its variants, and the lengths its classifiers are computed with."""

    name: str
    worlds: dict[tuple[bool, bool], World]
    """By (noise, state-dependent policy)."""
    memory: Memory
    diameter: int
    max_k: int
    """Largest k: the diameter, or m + 2 if that is more."""


def make_case(name: str) -> Case:
    """A world of the gallery as a case: its memory lengths and diameter are computed."""
    world = WORLDS[name]()
    m, reach = past_memory(world, actions=True), diameter(world)
    n = future_memory(world, actions=True)
    n = future_memory(world, actions=True, literal=True) if n is None else n
    assert m is not None
    assert n is not None
    assert reach is not None
    return Case(name, variants(world), Memory(m, n), reach, max(reach, m + 2))


def describe(case: Case) -> Row:
    """A world's sizes, decodability with and without actions, diameter and period."""
    world = case.worlds[False, False]
    return {
        "states": len(world.states),
        "actions": len(world.actions),
        "diameter": case.diameter,
        "period": period(world),
        "max_k": case.max_k,
        "m": case.memory.m,
        "m_without_actions": past_memory(world, actions=False),
        "n": future_memory(world, actions=True),
        "n_literal": future_memory(world, actions=True, literal=True),
        "n_without_actions": future_memory(world, actions=False),
    }


def comparisons(case: Case) -> list[Row]:
    """One row for every variant, method and k. With noise, k goes to the diameter only: sequences are many more."""
    rows = []
    for (noise, biased), world in case.worlds.items():
        for method in METHODS:
            for k in range(1, (case.diameter if noise else case.max_k) + 1):
                row = compare(world, VIEWS[method], case.memory, k)
                label = {"world": case.name, "noise": noise, "state_dependent": biased, "method": method}
                rows.append(label | asdict(row))
    return rows


def representations(case: Case) -> list[Row]:
    """One row for every policy and method: which pairs of states are forced apart, and whether noise can be dropped.

    k goes up to the diameter; methods that do not see the whole history have a second row where `max_k` is more.
    """
    rows = []
    for biased in (False, True):
        world = case.worlds[False, biased]
        pairs = len(world.states) * (len(world.states) - 1) // 2
        for method in METHODS:
            whole = VIEWS[method].past == "all"
            noisy = relation(case.worlds[True, biased], VIEWS[method], case.memory, range(1, case.diameter + 1))
            for max_k in sorted({case.diameter, case.diameter if whole else case.max_k}):
                found = relation(world, VIEWS[method], case.memory, range(1, max_k + 1))
                shares = forced_shares(found).values()
                forced = sum(share == 1 for share in shares)
                label = {"world": case.name, "state_dependent": biased, "method": method, "max_k": max_k}
                rows.append(
                    label
                    | {"forced": forced, "sometimes_forced": sum(share > 0 for share in shares), "pairs": pairs}
                    | {"complete": forced == pairs}
                    | {"discards": discards_noise(found) and discards_noise(noisy)}
                )
    return rows


def method_row(rows: list[Row], needs: list[Row], method: str) -> Row:
    """Table 1's row of one method on one world: a property is true if it holds in every variant and at every k."""
    mine = [row for row in rows if row["method"] == method]
    kept = [row for row in needs if row["method"] == method]
    largest = max(row["max_k"] for row in kept)
    return {
        "method": method,
        "decodes_past": all(row["decodes_past"] for row in mine),
        "decodes_end": all(row["decodes_end"] for row in mine),
        "correct": all(row["multi_step"] for row in mine),
        "wrong_k": sorted({row["k"] for row in mine if not row["multi_step"]}),
        "complete": all(row["complete"] for row in kept if row["max_k"] == largest),
        "forced": min(row["forced"] for row in kept if row["max_k"] == largest),
        "pairs": kept[0]["pairs"],
        "discards": all(row["discards"] for row in kept if row["max_k"] == largest),
    }


@dataclass(frozen=True)
class Equation:
    """A closed form that section 3.1 states for a classifier."""

    method: str
    where: str
    applies: Callable[[int, int], bool]
    """(k, m) -> whether it is stated for this k."""
    form: str
    """multi_step, one_step or certain: a field of `Comparison`."""


def _every(k: int, m: int) -> bool:
    return True


def _later(k: int, m: int) -> bool:
    return k > m


def _early(k: int, m: int) -> bool:
    return k <= m


EQUATIONS = (
    Equation("ah", "every k", _every, "one_step"),
    Equation("ah+a", "every k", _every, "certain"),
    Equation("fj", "k > m", _later, "multi_step"),
    Equation("fj", "k <= m", _early, "one_step"),
    Equation("fj+a", "k > m", _later, "multi_step"),
    Equation("fj+a", "k <= m", _early, "certain"),
    Equation("fj+a literal", "k > m", _later, "multi_step"),
    Equation("fj+a literal", "k <= m", _early, "certain"),
    Equation("mik", "every k", _every, "multi_step"),
    Equation("mik+a", "every k", _every, "multi_step"),
    Equation("mik+a literal", "every k", _every, "multi_step"),
)
FORMS = {"multi_step": "P(a_t | s_t, s_{t+k})", "one_step": "P(a_t | s_t, s_{t+1})", "certain": "1"}


def compare_equations(rows: list[Row], memories: dict[str, Memory]) -> list[Row]:
    """For every equation and world: at which of its k it holds or fails, and whether its assumptions are met."""
    found = []
    for equation in EQUATIONS:
        for world, memory in memories.items():
            mine = [
                row
                for row in rows
                if (row["world"], row["method"]) == (world, equation.method) and equation.applies(row["k"], memory.m)
            ]
            fails = {row["k"] for row in mine if not row[equation.form]}
            label = {"method": equation.method, "where": equation.where, "form": equation.form, "world": world}
            found.append(
                label
                | {"decodes": all(row["decodes_past"] and row["decodes_end"] for row in mine)}
                | {"holds_k": sorted({row["k"] for row in mine} - fails), "fails_k": sorted(fails), "m": memory.m}
            )
    return found


def disagreements(tables: dict[str, list[Row]], equations: list[Row], worlds: dict[str, Row]) -> list[Row]:
    """Every printed yes and every equation that some world contradicts which meets the method's assumptions.

    A printed no says that a property is not guaranteed, so a world that has the property does not contradict it.
    """
    found = []
    for world, table in tables.items():
        for row in table:
            if row["decodes_past"] and row["decodes_end"]:
                failed = [column for column in COLUMNS if printed(row["method"])[column] and not row[column]]
                found += [_difference(worlds, world, row["method"], column, _detail(row, column)) for column in failed]
    for entry in equations:
        if entry["fails_k"] and entry["decodes"]:
            text = f"{FORMS[entry['form']]} for {entry['where']} fails at k = {_list(entry['fails_k'])}"
            found.append(_difference(worlds, entry["world"], entry["method"], "equation", text))
    return found


def _detail(row: Row, column: str) -> str:
    return {
        "correct": f"wrong at k = {_list(row['wrong_k'])}",
        "complete": f"{row['forced']} of {row['pairs']} pairs of states are always told apart",
        "discards": "the past's code must carry part of the exogenous state",
    }[column]


def _difference(worlds: dict[str, Row], world: str, method: str, claim: str, detail: str) -> Row:
    return {"world": world, "method": method, "claim": claim, "detail": detail, "period": worlds[world]["period"]}


def _list(ks: Iterable[int]) -> str:
    return ", ".join(map(str, ks))

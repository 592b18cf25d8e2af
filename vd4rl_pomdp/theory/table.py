"""The paper's Table 1 and the equations of its section 3.1, computed on the gallery's worlds beside what is printed."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from typing import Any

from vd4rl_pomdp.theory.classifiers import Memory, compare
from vd4rl_pomdp.theory.decodability import future_memory, past_memory
from vd4rl_pomdp.theory.gallery import WORLDS, variants
from vd4rl_pomdp.theory.partition import discards_noise, forced_shares, relation
from vd4rl_pomdp.theory.views import VIEWS
from vd4rl_pomdp.theory.world import World, diameter, period

Cells = dict[str, bool]
COLUMNS = ("correct", "complete", "discards")
TITLES = {
    "correct": "correct Bayes-optimal classifier",
    "complete": "complete agent-centric state",
    "discards": "discards exogenous noise",
}
PRINTED: dict[str, Cells] = {
    "ah": {"correct": False, "complete": False, "discards": True},
    "ah+a": {"correct": False, "complete": False, "discards": True},
    "fj": {"correct": True, "complete": False, "discards": True},
    "fj+a": {"correct": True, "complete": False, "discards": True},
    "mik": {"correct": True, "complete": False, "discards": True},
    "mik+a": {"correct": True, "complete": True, "discards": True},
}
"""Table 1 as printed."""
METHODS = tuple(name for name in VIEWS if name != "no_history")


def printed(method: str) -> Cells:
    """The printed row of a method; a literal reading is judged by the same row."""
    return PRINTED[method.removesuffix(" literal")]


@dataclass(frozen=True)
class Setting:
    """One world with its variants, and the lengths its classifiers are computed with."""

    name: str
    worlds: dict[tuple[bool, bool], World]
    """By (noise, state-dependent policy)."""
    memory: Memory
    diameter: int
    max_k: int
    """Largest k: the diameter, or m + 2 if that is more."""


def setting(name: str) -> Setting:
    """Measure one world of the gallery."""
    world = WORLDS[name]()
    m, reach = past_memory(world, actions=True), diameter(world)
    n = future_memory(world, actions=True)
    n = future_memory(world, actions=True, literal=True) if n is None else n
    assert m is not None
    assert n is not None
    assert reach is not None
    return Setting(name, variants(world), Memory(m, n), reach, max(reach, m + 2))


def describe(place: Setting) -> dict[str, Any]:
    """A world's sizes, decodability with and without actions, diameter and period."""
    world = place.worlds[False, False]
    return {
        "states": len(world.states),
        "actions": len(world.actions),
        "diameter": place.diameter,
        "period": period(world),
        "max_k": place.max_k,
        "m": place.memory.m,
        "m_without_actions": past_memory(world, actions=False),
        "n": future_memory(world, actions=True),
        "n_literal": future_memory(world, actions=True, literal=True),
        "n_without_actions": future_memory(world, actions=False),
    }


def comparisons(place: Setting) -> list[dict[str, Any]]:
    """One row for every variant, method and k. With noise, k goes to the diameter only: sequences are many more."""
    rows = []
    for (noise, biased), world in place.worlds.items():
        for method in METHODS:
            for k in range(1, (place.diameter if noise else place.max_k) + 1):
                row = compare(world, VIEWS[method], place.memory, k)
                label = {"world": place.name, "noise": noise, "state_dependent": biased, "method": method}
                rows.append(label | asdict(row))
    return rows


def representations(place: Setting) -> list[dict[str, Any]]:
    """One row for every policy and method: which pairs of states are forced apart, and whether noise can be dropped.

    For methods that see the whole history k goes to the diameter, for the others to the largest k as well.
    """
    rows = []
    for biased in (False, True):
        world = place.worlds[False, biased]
        pairs = len(world.states) * (len(world.states) - 1) // 2
        for method in METHODS:
            whole = VIEWS[method].past == "all"
            noisy = relation(place.worlds[True, biased], VIEWS[method], place.memory, range(1, place.diameter + 1))
            for max_k in sorted({place.diameter, place.diameter if whole else place.max_k}):
                found = relation(world, VIEWS[method], place.memory, range(1, max_k + 1))
                shares = forced_shares(found).values()
                forced = sum(share == 1 for share in shares)
                label = {"world": place.name, "state_dependent": biased, "method": method, "max_k": max_k}
                rows.append(
                    label
                    | {"forced": forced, "sometimes_forced": sum(share > 0 for share in shares), "pairs": pairs}
                    | {"complete": forced == pairs}
                    | {"discards": discards_noise(found) and discards_noise(noisy)}
                )
    return rows


def cells(rows: list[dict[str, Any]], needs: list[dict[str, Any]], method: str) -> dict[str, Any]:
    """Table 1's row of one method on one world: true if it holds in every variant and at every k."""
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


def check_equations(rows: list[dict[str, Any]], memories: dict[str, Memory]) -> list[dict[str, Any]]:
    """For every equation and world: at which stated k it holds, at which not, and whether its assumptions do."""
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


def disagreements(tables: dict[str, list[dict[str, Any]]], equations: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Every printed yes and every equation that some world contradicts, and whether the assumptions hold there.

    A printed no says that a property is not guaranteed, which a world that has it does not contradict.
    """
    found = []
    for world, table in tables.items():
        for row in table:
            for column in COLUMNS:
                if printed(row["method"])[column] and not row[column]:
                    found.append(_cell_difference(world, row, column))
    for entry in equations:
        if entry["fails_k"]:
            text = f"the equation {FORMS[entry['form']]} for {entry['where']} fails at k = {_list(entry['fails_k'])}"
            found.append(_difference(entry["world"], entry["method"], text, entry["decodes"], f"m = {entry['m']}"))
    return found


def _cell_difference(world: str, row: dict[str, Any], column: str) -> dict[str, Any]:
    text = f"'{TITLES[column]}' is printed yes, computed no"
    detail = {
        "correct": f"wrong at k = {_list(row['wrong_k'])}",
        "complete": f"{row['forced']} of {row['pairs']} pairs of states are always told apart",
        "discards": "the past's code must carry part of the exogenous state",
    }[column]
    return _difference(world, row["method"], text, row["decodes_past"] and row["decodes_end"], detail)


def _difference(world: str, method: str, text: str, decodes: bool, detail: str) -> dict[str, Any]:
    return {"world": world, "method": method, "difference": text, "detail": detail, "assumptions_hold": decodes}


def _list(ks: Iterable[int]) -> str:
    return ", ".join(map(str, ks))

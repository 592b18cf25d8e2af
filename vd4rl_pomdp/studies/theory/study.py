"""What `vd4rl-pomdp theory` computes: the paper's Table 1 and equations beside enumeration on the gallery's worlds."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from itertools import product
from typing import Any

from vd4rl_pomdp.runs.files import Row
from vd4rl_pomdp.studies.theory.classifiers import MemoryLengths, compare
from vd4rl_pomdp.studies.theory.decodability import future_memory, past_memory
from vd4rl_pomdp.studies.theory.facts import INVERSE, always_apart, enumerated, facts, least_memory
from vd4rl_pomdp.studies.theory.gallery import WORLDS, counterexample, variants
from vd4rl_pomdp.studies.theory.partition import (
    Relation,
    discards_noise,
    forced_shares,
    relation,
    state_classes,
    state_relation,
)
from vd4rl_pomdp.studies.theory.views import VIEWS
from vd4rl_pomdp.studies.theory.world import World, diameter, period

COLUMNS = ("correct", "complete", "discards")
"""Correct Bayes-optimal classifier, complete agent-centric state, discards exogenous noise."""
PRINTED: dict[str, dict[str, bool]] = {
    "ah": {"correct": False, "complete": False, "discards": True},
    "ah+a": {"correct": False, "complete": False, "discards": True},
    "fj": {"correct": True, "complete": False, "discards": True},
    "fj+a": {"correct": True, "complete": False, "discards": True},
    "mik": {"correct": True, "complete": False, "discards": True},
    "mik+a": {"correct": True, "complete": True, "discards": True},
}
"""Table 1 as printed."""
METHODS = tuple(name for name in VIEWS if name != "no_history")
DIAGRAMS = (("fj", 3), ("fj+a", 3), ("fj+a", 5), ("mik+a", 3), ("mik+a literal", 3))
"""Method and largest k of each diagram of merged states; the counterexample's diameter and m are 3."""


def printed(method: str) -> dict[str, bool]:
    """The printed row of a method; a literal reading is compared with the same row."""
    return PRINTED[method.removesuffix(" literal")]


def theory_study() -> dict[str, Any]:
    """Compute the counterexample's numbers, Table 1, the equations, the facts and the merged states, JSON-ready."""
    cases = {name: make_case(name) for name in WORLDS}
    rows = [row for case in cases.values() for row in comparisons(case)]
    needs = [row for case in cases.values() for row in representations(case)]
    tables = {
        name: [
            method_row(
                *([row for row in one if (row["world"], row["method"]) == (name, method)] for one in (rows, needs))
            )
            for method in METHODS
        ]
        for name in cases
    }
    equations = compare_equations(rows, {name: case.memory for name, case in cases.items()})
    world = cases["counterexample"].worlds[False, False]
    return {
        "facts": [asdict(fact) for fact in facts()],
        "differences": [asdict(difference) for difference in differences(tables, equations)],
        "counterexample": {"appendix": enumerated(world), "main_text": enumerated(counterexample((0, 1)))},
        "worlds": {name: describe(case) for name, case in cases.items()},
        "printed": PRINTED,
        "tables": tables,
        "equations": equations,
        "comparisons": rows,
        "representations": needs,
        "states": [list(s) for s in world.states],  # type: ignore[call-overload]
        "transitions": [[world.states.index(s), a, world.states.index(end)] for (s, a), end in world.step.items()],
        "diagrams": diagrams(cases["counterexample"]),
    }


@dataclass(frozen=True)
class Case:
    """One world with its variants, and the lengths its classifiers are computed with."""

    name: str
    worlds: dict[tuple[bool, bool], World]
    """By (noise, state-dependent policy)."""
    memory: MemoryLengths
    diameter: int
    max_k: int
    """Largest k: the diameter, or m + 2 if that is more."""


def make_case(name: str) -> Case:
    """A world of the gallery as a case: its memory lengths and diameter are computed."""
    world = WORLDS[name]()
    memory, reach = least_memory(world), diameter(world)
    assert reach is not None
    return Case(name, variants(world), memory, reach, max(reach, memory.m + 2))


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
    return [
        {"world": case.name, "noise": noise, "state_dependent": biased, "method": method}
        | asdict(compare(world, VIEWS[method], case.memory, k))
        for (noise, biased), world in case.worlds.items()
        for method in METHODS
        for k in range(1, (case.diameter if noise else case.max_k) + 1)
    ]


def representations(case: Case) -> list[Row]:
    """One row for every policy and method: which pairs of states are forced apart, and whether noise can be dropped.

    k goes up to the diameter; methods that do not see the whole history have a second row where `max_k` is more.
    """
    rows = []
    for biased in (False, True):
        for method in METHODS:
            whole = VIEWS[method].past == "all"
            noisy = relation(case.worlds[True, biased], VIEWS[method], case.memory, range(1, case.diameter + 1))
            for max_k in sorted({case.diameter, case.diameter if whole else case.max_k}):
                found = relation(case.worlds[False, biased], VIEWS[method], case.memory, range(1, max_k + 1))
                forced, pairs = always_apart(found)
                rows.append(
                    {"world": case.name, "state_dependent": biased, "method": method, "max_k": max_k}
                    | {"forced": forced, "sometimes_forced": sum(share > 0 for share in forced_shares(found).values())}
                    | {"pairs": pairs, "complete": forced == pairs}
                    | {"discards": discards_noise(found) and discards_noise(noisy)}
                )
    return rows


def method_row(rows: list[Row], needs: list[Row]) -> Row:
    """Table 1's row of one method on one world, from its comparisons and its representations.

    A property is true if it holds in every variant and at every k; for representations, up to the largest k.
    """
    largest = [row for row in needs if row["max_k"] == max(row["max_k"] for row in needs)]
    return {
        "method": rows[0]["method"],
        "decodes_past": all(row["decodes_past"] for row in rows),
        "decodes_end": all(row["decodes_end"] for row in rows),
        "correct": all(row["multi_step"] for row in rows),
        "wrong_k": sorted({row["k"] for row in rows if not row["multi_step"]}),
        "complete": all(row["complete"] for row in largest),
        "forced": min(row["forced"] for row in largest),
        "pairs": largest[0]["pairs"],
        "discards": all(row["discards"] for row in largest),
    }


RANGES: dict[str, Callable[[int, int], bool]] = {
    "every k": lambda k, m: True,
    "k > m": lambda k, m: k > m,
    "k <= m": lambda k, m: k <= m,
}
FORMS = {"multi_step": INVERSE, "one_step": "P(a_t | s_t, s_{t+1})", "certain": "1"}
EQUATIONS = (
    ("ah", "every k", "one_step"),
    ("ah+a", "every k", "certain"),
    ("fj", "k > m", "multi_step"),
    ("fj", "k <= m", "one_step"),
    ("fj+a", "k > m", "multi_step"),
    ("fj+a", "k <= m", "certain"),
    ("fj+a literal", "k > m", "multi_step"),
    ("fj+a literal", "k <= m", "certain"),
    ("mik", "every k", "multi_step"),
    ("mik+a", "every k", "multi_step"),
    ("mik+a literal", "every k", "multi_step"),
)
"""Closed forms that section 3.1 states for classifiers: a method, one of RANGES, and one of FORMS, which are fields of
`Comparison`."""


def compare_equations(rows: list[Row], memories: dict[str, MemoryLengths]) -> list[Row]:
    """For every equation and world: at which of its k it holds or fails, and whether its assumptions are met."""
    found = []
    for (method, where, form), (world, memory) in product(EQUATIONS, memories.items()):
        mine = [
            row
            for row in rows
            if (row["world"], row["method"]) == (world, method) and RANGES[where](row["k"], memory.m)
        ]
        fails = {row["k"] for row in mine if not row[form]}
        label = {"method": method, "where": where, "form": form, "world": world, "m": memory.m}
        decodes = all(row["decodes_past"] and row["decodes_end"] for row in mine)
        ks = {"holds_k": sorted({row["k"] for row in mine} - fails), "fails_k": sorted(fails)}
        found.append(label | {"decodes": decodes} | ks)
    return found


@dataclass(frozen=True)
class Difference:
    """An entry of Table 1, or an equation, that a world contradicts which meets the method's assumptions."""

    world: str
    method: str
    printed: str
    computed: str


def differences(tables: dict[str, list[Row]], equations: list[Row]) -> list[Difference]:
    """What is printed beside what is computed, wherever the two differ and the method decodes the states.

    A printed no says that a property is not guaranteed, so a world that has the property does not contradict it.
    """
    found = []
    for world, table in tables.items():
        for row in (row for row in table if row["decodes_past"] and row["decodes_end"]):
            computed = {
                "correct": f"wrong at k = {_list(row['wrong_k'])}",
                "complete": f"{row['forced']} of {row['pairs']} pairs of states are always told apart",
                "discards": "the past's code must carry part of the exogenous state",
            }
            failed = [column for column in COLUMNS if printed(row["method"])[column] and not row[column]]
            found += [Difference(world, row["method"], column, computed[column]) for column in failed]
    for row in (row for row in equations if row["fails_k"] and row["decodes"]):
        text = f"{FORMS[row['form']]} for {row['where']}"
        found.append(Difference(row["world"], row["method"], text, f"fails at k = {_list(row['fails_k'])}"))
    return found


def diagrams(case: Case) -> list[Row]:
    """For some objectives, the counterexample's states in classes that a coarsest partition cannot tell apart."""
    world = case.worlds[False, False]
    found = [
        _diagram(f"{method}, k <= {max_k}", relation(world, VIEWS[method], case.memory, range(1, max_k + 1)))
        for method, max_k in DIAGRAMS
    ]
    states = state_relation(world, range(1, case.max_k + 1))
    return [*found, _diagram(f"one encoder on true states, k <= {case.max_k}", states)]


def _diagram(title: str, found: Relation) -> Row:
    blocks = found.coarsest()
    return {
        "title": title,
        "blocks": len(set(blocks.tolist())),
        "histories": len(blocks),
        "classes": state_classes(found, blocks),
    }


def _list(ks: Iterable[int]) -> str:
    return ", ".join(map(str, ks))

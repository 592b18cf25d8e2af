"""Everything that `vd4rl-pomdp theory` computes, as one JSON-ready dict."""

from __future__ import annotations

from typing import Any

from vd4rl_pomdp.studies.theory import counterexample, table
from vd4rl_pomdp.studies.theory.facts import FACTS, main_text, told
from vd4rl_pomdp.studies.theory.gallery import WORLDS
from vd4rl_pomdp.studies.theory.partition import Relation, forced_shares, relation, state_classes, state_relation
from vd4rl_pomdp.studies.theory.small import FAMILY
from vd4rl_pomdp.studies.theory.views import VIEWS

DIAGRAMS = (
    ("fj", 3),
    ("fj+a", 3),
    ("fj+a", 5),
    ("mik+a", 3),
    ("mik+a literal", 3),
)
"""Method and largest k of each diagram of merged states; the counterexample's diameter and m are 3."""


def theory_study() -> dict[str, Any]:
    """Compute the counterexample's numbers, Table 1, the equations, the facts and the merged states."""
    cases = {name: table.make_case(name) for name in WORLDS}
    rows = [row for case in cases.values() for row in table.comparisons(case)]
    needs = [row for case in cases.values() for row in table.representations(case)]
    tables = {
        name: [table.method_row(_of(rows, name), _of(needs, name), method) for method in table.METHODS]
        for name in cases
    }
    equations = table.compare_equations(rows, {name: case.memory for name, case in cases.items()})
    worlds = {name: table.describe(case) for name, case in cases.items()}
    differences = table.disagreements(tables, equations, worlds)
    world = cases["counterexample"].worlds[False, False]
    return {
        "facts": [told(fact, differences) for fact in FACTS],
        "family": FAMILY,
        "counterexample": {"appendix": counterexample.study(world), "main_text": counterexample.study(main_text())},
        "worlds": worlds,
        "printed": table.PRINTED,
        "tables": tables,
        "equations": equations,
        "comparisons": rows,
        "representations": needs,
        "states": [list(s) for s in world.states],  # type: ignore[call-overload]
        "transitions": [[world.states.index(s), a, world.states.index(end)] for (s, a), end in world.step.items()],
        "diagrams": diagrams(cases["counterexample"]),
    }


def _of(rows: list[dict[str, Any]], world: str) -> list[dict[str, Any]]:
    return [row for row in rows if row["world"] == world]


def diagrams(case: table.Case) -> list[dict[str, Any]]:
    """For some objectives, the counterexample's states in classes that a coarsest partition cannot tell apart."""
    world = case.worlds[False, False]
    found = [
        _diagram(f"{method}, k <= {max_k}", relation(world, VIEWS[method], case.memory, range(1, max_k + 1)))
        for method, max_k in DIAGRAMS
    ]
    states = state_relation(world, range(1, case.max_k + 1))
    return [*found, _diagram(f"one encoder on true states, k <= {case.max_k}", states)]


def _diagram(title: str, found: Relation) -> dict[str, Any]:
    blocks = found.coarsest()
    index = {state: i for i, state in enumerate(found.world.states)}
    shares = ((sorted(index[s] for s in pair), share) for pair, share in forced_shares(found).items())
    return {
        "title": title,
        "blocks": len(set(blocks.tolist())),
        "histories": len(blocks),
        "classes": state_classes(found, blocks),
        "forced": sorted([*pair, float(share)] for pair, share in shares if share),
    }

"""Computations of `vd4rl-pomdp theory`: the paper's Table 1 and equations, compared with enumeration on small
worlds."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from fractions import Fraction
from itertools import product
from typing import Any

from vd4rl_pomdp.runs.files import Row
from vd4rl_pomdp.studies.theory.classifiers import VIEWS, MemoryLengths, clash, compare
from vd4rl_pomdp.studies.theory.partition import (
    Relation,
    discards_noise,
    forced_shares,
    relation,
    state_classes,
    state_relation,
)
from vd4rl_pomdp.studies.theory.world import (
    WORLDS,
    Action,
    AgentState,
    World,
    counterexample,
    diameter,
    echo,
    flicker,
    future_memory,
    momentum,
    past_memory,
    period,
    tiny,
    variants,
)

MAX_K = 10
GAPS = 4
"""Number of k to try, from the first one to which a statement applies."""


def inverse_examples(world: World, k: int) -> list[tuple[AgentState, tuple[Action, ...], AgentState]]:
    """All (s_t, (a_t..a_{t+k-1}), s_{t+k}).

    As in the paper's counterexample (section 3.2 and appendix), which generates them for k = 1..10 and considers the
    distribution of the first action for each pair of states.
    """
    found = []
    for start in world.states:
        for actions in product(world.actions, repeat=k):
            state = start
            for action in actions:
                state = world.step[state, action]
            found.append((start, actions, state))
    return found


def enumerated(world: World) -> dict[str, Any]:
    """Enumeration of the counterexample with one of the paper's two action sets.

    `by_k` has one row per k: number of examples and state pairs, and of pairs with a certain or uniform first action.
    """
    rows = []
    for k in range(1, MAX_K + 1):
        first: dict[tuple[AgentState, AgentState], Counter[Action]] = {}
        for start, actions, end in inverse_examples(world, k):
            first.setdefault((start, end), Counter())[actions[0]] += 1
        certain = sum(len(counts) == 1 for counts in first.values())
        uniform = sum(len({counts[a] for a in world.actions}) == 1 for counts in first.values())
        examples = sum(counts.total() for counts in first.values())
        rows.append({"k": k, "examples": examples, "pairs": len(first), "certain": certain, "uniform": uniform})
    return {
        "actions": list(world.actions),
        "by_k": rows,
        "examples": sum(row["examples"] for row in rows),
        "uniform_k": [row["k"] for row in rows if row["uniform"] == row["pairs"]],
        "informative_k": [row["k"] for row in rows if row["uniform"] < row["pairs"]],
        "diameter": diameter(world),
        "period": period(world),
        "m_with_actions": past_memory(world, actions=True),
    }


def least_memory(world: World) -> MemoryLengths:
    """Smallest decoding m and n with actions; if no n decodes, the literal reading's, or 0 if it has none."""
    m = past_memory(world, actions=True)
    ns = [future_memory(world, actions=True, literal=literal) for literal in (False, True)]
    assert m is not None, f"{world.name}: no past decodes"
    return MemoryLengths(m, next((n for n in ns if n is not None), 0))


INVERSE = "P(a_t | s_t, s_{t+k})"


def facts() -> list[Row]:
    """Differences between text and enumeration: one row per world that shows one.

    Every world but those of fact 3 meets the assumptions of the statement that it contradicts. Window lengths m and n
    are the least that decode.

    Returns:
        rows of `title` (the true statement), `printed` (the paper's, and where), `world`, `quantity`, `claimed` and
        `computed`, all text.
    """
    theirs, main = counterexample(), counterexample((0, 1))
    third, even = enumerated(theirs)["by_k"][2], ", ".join(map(str, enumerated(main)["uniform_k"]))
    informative = f"{third['pairs'] - third['uniform']} of {third['pairs']}"
    found: list[tuple[str, str, list[tuple[str, str, str, str]]]] = [
        (
            "The window of a forward jump reaches m rows back",
            f"P(a_t | rows t-m..t and t+k-m..t+k) is {INVERSE} for every k > m (section 3.1)",
            [_prediction(world, "fj+a", least_memory(world).m + 1) for world in (tiny("ladder"), theirs)],
        ),
        (
            "FJ+A can learn from jumps beyond m",
            "on the counterexample k > m = 3 gives no signal, so that FJ and FJ+A fail (section 3.2)",
            [_jumps(theirs)],
        ),
        (
            "Without the leak, the counterexample breaks an assumption of MIK+A",
            "the counterexample separates MIK+A from FJ and FJ+A (section 3.2); MIK+A assumes that the future decodes "
            "(Table 1)",
            [_prediction(world, "mik+a", 1) for world in (tiny("hidden switch"), theirs)],
        ),
        (
            "On the counterexample k = 3 is uninformative",
            "k = 2 and k = 3 are needed to separate the states, and k > 3 is uniform (section 3.2)",
            [(theirs.name, "pairs at which k = 3 is informative", "some", informative)],
        ),
        (
            "With the main text's actions 0 and 1 every k is informative",
            "a_t is 0 or 1, the diameter is 3, and k > 3 is uniform (section 3.2); the appendix has -1 and +1",
            [
                (main.name, "k above 3 that are uniform", "4 to 10", even or "none"),
                (main.name, "diameter", "3", str(diameter(main))),
            ],
        ),
        (
            "Read literally, the later view contains the action to be predicted",
            f"row t is (o_t, a_{{t-1}}) (section 2), the later view begins with row t+k (appendix), MIK+A is {INVERSE} "
            "from k = 1 on (section 3.1)",
            [_prediction(tiny("idle"), "mik+a literal", 1)],
        ),
        (
            "Read literally, MIK+A sees one of the masked actions at every k",
            f"row t is (o_t, a_{{t-1}}), and MIK+A is {INVERSE} at every k (section 3.1)",
            [_prediction(world, "mik+a literal", 2) for world in (tiny("toggle"), momentum())],
        ),
        (
            "MIK+A's past encoder may merge states with the same successors",
            "MIK+A finds the complete agent-centric state (Table 1, section 3.2)",
            [_merged(world) for world in (tiny("switch"), echo())],
        ),
        (
            "In periodic worlds no inverse model distinguishes the phases",
            "all k up to the diameter recover the state of a deterministic world (appendix), and k = 1 to 3 that of "
            "the counterexample (section 3.2)",
            [_codes(world) for world in (tiny("alternator"), theirs)],
        ),
        (
            "FJ+A's jumps beyond m may need the exogenous part",
            "FJ+A discards exogenous noise (Table 1)",
            [_noise(world) for world in (flicker(), theirs)],
        ),
    ]
    names = ("title", "printed", "world", "quantity", "claimed", "computed")
    return [dict(zip(names, (title, printed, *row), strict=True)) for title, printed, rows in found for row in rows]


def _prediction(world: World, method: str, first_k: int) -> tuple[str, str, str, str]:
    """The first k, of GAPS, at which a method differs from the multi-step inverse: where, and both probabilities."""
    memory = least_memory(world)
    for k in range(first_k, first_k + GAPS):
        if found := clash(world, VIEWS[method], memory, k):
            where = f"m = {memory.m}, k = {k}, s_t = {found.states[0]}, s_{{t+k}} = {found.states[1]}"
            quantity = f"{method}'s P(a_t = {found.action}), {where}"
            return world.name, quantity, str(found.multi_step), str(found.exact)
    raise AssertionError(f"{method} is the multi-step inverse of {world.name}")


def _jumps(world: World) -> tuple[str, str, str, str]:
    """State pairs that FJ+A separates with jumps beyond m, compared with shorter ones and with the literal MIK+A."""
    m = least_memory(world).m
    near, far = (always_apart(relation(world, VIEWS["fj+a"], MemoryLengths(m, m), range(1, k + 1))) for k in (m, m + 2))
    masked = always_apart(relation(world, VIEWS["mik+a literal"], MemoryLengths(m, m), range(1, m + 1)))
    quantity = (
        f"pairs of states separated by fj+a, k up to {m + 2} (k up to {m}: {near[0]}; mik+a literal: {masked[0]})"
    )
    return world.name, quantity, str(near[0]), f"{far[0]} of {far[1]}"


def _merged(world: World) -> tuple[str, str, str, str]:
    """State pairs that MIK+A's past encoder must separate, with both actions equally likely."""
    reach = _reach(world)
    apart, pairs = always_apart(relation(world, VIEWS["mik+a"], least_memory(world), range(1, reach + 1)))
    return (
        world.name,
        f"pairs of states separated by mik+a, k up to {reach}",
        f"{pairs} of {pairs}",
        f"{apart} of {pairs}",
    )


def _codes(world: World) -> tuple[str, str, str, str]:
    """Codes that a shared encoder on true states needs for every k up to twice the diameter."""
    codes = len(set(state_relation(world, range(1, 2 * _reach(world) + 1)).coarsest().tolist()))
    return world.name, f"codes on true states, k up to {2 * _reach(world)}", str(len(world.states)), str(codes)


def _noise(world: World) -> tuple[str, str, str, str]:
    """The first of two maximum k beyond m at which FJ+A's prediction depends on the exogenous part of its past."""
    memory = least_memory(world)
    for k in (memory.m + 1, memory.m + 2):
        if not discards_noise(relation(world, VIEWS["fj+a"], memory, range(1, k + 1))):
            return world.name, f"fj+a needs the past's exogenous part, m = {memory.m}", "at no k", f"at k up to {k}"
    raise AssertionError(f"fj+a needs no exogenous part on {world.name}")


def always_apart(found: Relation) -> tuple[int, int]:
    """Number of state pairs that every optimal representation separates for all histories, and of all pairs."""
    shares = forced_shares(found).values()
    return sum(share == 1 for share in shares), len(shares)


def _reach(world: World) -> int:
    return max(1, diameter(world) or 0)


PRINTED: dict[str, dict[str, bool]] = {
    "ah": {"correct": False, "complete": False, "discards": True},
    "ah+a": {"correct": False, "complete": False, "discards": True},
    "fj": {"correct": True, "complete": False, "discards": True},
    "fj+a": {"correct": True, "complete": False, "discards": True},
    "mik": {"correct": True, "complete": False, "discards": True},
    "mik+a": {"correct": True, "complete": True, "discards": True},
}
"""Table 1 as printed: correct Bayes-optimal classifier, complete agent-centric state, discards exogenous noise."""
METHODS = tuple(name for name in VIEWS if name != "no_history")
DIAGRAMS = (("fj", 3), ("fj+a", 3), ("fj+a", 5), ("mik+a", 3), ("mik+a literal", 3))
"""Method and largest k of each diagram of merged states; the counterexample's diameter and m are 3."""


def theory_study() -> dict[str, Any]:
    """Compute counterexample, Table 1, equations, facts and merged states, JSON-serialisable."""
    described, rows, needs = dict[str, Row](), list[Row](), list[Row]()
    for name, make in WORLDS.items():
        described[name], compared, needed = _of_world(name, make())
        rows += compared
        needs += needed
    tables = {name: [method_row(name, method, rows, needs) for method in METHODS] for name in WORLDS}
    equations = compare_equations(rows, {name: row["m"] for name, row in described.items()})
    world = counterexample()
    return {
        "facts": facts(),
        "differences": differences(tables, equations),
        "counterexample": {"appendix": enumerated(world), "main_text": enumerated(counterexample((0, 1)))},
        "worlds": described,
        "printed": PRINTED,
        "tables": tables,
        "equations": equations,
        "comparisons": rows,
        "representations": needs,
        "states": [list(s) for s in world.states],  # type: ignore[call-overload]
        "transitions": [[world.states.index(s), a, world.states.index(end)] for (s, a), end in world.step.items()],
        "diagrams": diagrams(world, described["counterexample"]["max_k"]),
    }


def _of_world(name: str, world: World) -> tuple[Row, list[Row], list[Row]]:
    """Results on a world and its variants.

    Returns:
        sizes, decodability with and without actions, diameter, period, and the maximum k, max(diameter, m + 2).
        Comparisons: one row per variant, method and k. With noise, k stops at the diameter, since there are many more
        sequences.
        Representations: one row per policy and method: state pairs that must be separated, and whether noise can be
        discarded. k goes up to the diameter; methods without the whole history have a second row up to the maximum k.
    """
    memory, reach = least_memory(world), diameter(world)
    assert reach is not None
    most, variant = max(reach, memory.m + 2), variants(world)
    described = {
        "states": len(world.states),
        "actions": len(world.actions),
        "diameter": reach,
        "period": period(world),
        "max_k": most,
        "m": memory.m,
        "m_without_actions": past_memory(world, actions=False),
        "n": future_memory(world, actions=True),
        "n_literal": future_memory(world, actions=True, literal=True),
        "n_without_actions": future_memory(world, actions=False),
    }
    rows = [
        {"world": name, "noise": noise, "state_dependent": biased, "method": method}
        | asdict(compare(changed, VIEWS[method], memory, k))
        for (noise, biased), changed in variant.items()
        for method in METHODS
        for k in range(1, (reach if noise else most) + 1)
    ]
    needs = []
    for biased, method in product((False, True), METHODS):
        noisy = relation(variant[True, biased], VIEWS[method], memory, range(1, reach + 1))
        for max_k in sorted({reach, reach if VIEWS[method].past == "all" else most}):
            found = relation(variant[False, biased], VIEWS[method], memory, range(1, max_k + 1))
            shares = list(forced_shares(found).values())
            forced, pairs = shares.count(Fraction(1)), len(shares)
            needs.append(
                {"world": name, "state_dependent": biased, "method": method, "max_k": max_k}
                | {"forced": forced, "sometimes_forced": sum(share > 0 for share in shares)}
                | {"pairs": pairs, "complete": forced == pairs}
                | {"discards": discards_noise(found) and discards_noise(noisy)}
            )
    return described, rows, needs


def method_row(world: str, method: str, rows: list[Row], needs: list[Row]) -> Row:
    """A method's row of Table 1 on one world, from all comparisons and representations.

    A property is true if it holds in every variant and at every k; for representations, up to the largest k.
    """
    rows, needs = ([row for row in some if (row["world"], row["method"]) == (world, method)] for some in (rows, needs))
    largest = [row for row in needs if row["max_k"] == max(row["max_k"] for row in needs)]
    return {
        "method": method,
        "decodes_past": all(row["decodes_past"] for row in rows),
        "decodes_end": all(row["decodes_end"] for row in rows),
        "correct": all(row["multi_step"] for row in rows),
        "wrong_k": sorted({row["k"] for row in rows if not row["multi_step"]}),
        "complete": all(row["complete"] for row in largest),
        "forced": min(row["forced"] for row in largest),
        "pairs": largest[0]["pairs"],
        "discards": all(row["discards"] for row in largest),
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
"""Closed forms of classifiers in section 3.1: a method, a range of k, and one of FORMS (fields of `Comparison`)."""


def compare_equations(rows: list[Row], memories: dict[str, int]) -> list[Row]:
    """For every equation and world: the k at which it holds or fails, and whether its assumptions are met."""
    found = []
    for (method, where, form), (world, m) in product(EQUATIONS, memories.items()):
        mine = [row for row in rows if (row["world"], row["method"]) == (world, method)]
        if where != "every k":
            mine = [row for row in mine if (row["k"] > m) == (where == "k > m")]
        fails = {row["k"] for row in mine if not row[form]}
        label = {"method": method, "where": where, "form": form, "world": world, "m": m}
        decodes = all(row["decodes_past"] and row["decodes_end"] for row in mine)
        ks = {"holds_k": sorted({row["k"] for row in mine} - fails), "fails_k": sorted(fails)}
        found.append(label | {"decodes": decodes} | ks)
    return found


def differences(tables: dict[str, list[Row]], equations: list[Row]) -> list[Row]:
    """Entries of Table 1 and equations that are contradicted by a world that meets the method's assumptions.

    A printed no means that a property is not guaranteed, so a world with the property does not contradict it.
    """
    found = []
    for world, table in tables.items():
        for row in (row for row in table if row["decodes_past"] and row["decodes_end"]):
            computed = {
                "correct": f"wrong at k = {', '.join(map(str, row['wrong_k']))}",
                "complete": f"{row['forced']} of {row['pairs']} pairs of states are always separated",
                "discards": "the past's code must carry part of the exogenous state",
            }
            printed = PRINTED[row["method"].removesuffix(" literal")]  # literal readings share it
            failed = [column for column in computed if printed[column] and not row[column]]
            found += [(world, row["method"], column, computed[column]) for column in failed]
    for row in (row for row in equations if row["fails_k"] and row["decodes"]):
        text = f"{FORMS[row['form']]} for {row['where']}"
        found.append((row["world"], row["method"], text, f"fails at k = {', '.join(map(str, row['fails_k']))}"))
    return [dict(zip(("world", "method", "printed", "computed"), row, strict=True)) for row in found]


def diagrams(world: World, most: int) -> list[Row]:
    """For some objectives, the classes of a world's states that a coarsest partition cannot distinguish."""
    memory, rows = least_memory(world), []
    relations = {
        f"{method}, k <= {max_k}": relation(world, VIEWS[method], memory, range(1, max_k + 1))
        for method, max_k in DIAGRAMS
    } | {f"one encoder on true states, k <= {most}": state_relation(world, range(1, most + 1))}
    for title, found in relations.items():
        blocks = found.coarsest()
        count = len(set(blocks.tolist()))
        rows.append(
            {"title": title, "blocks": count, "histories": len(blocks), "classes": state_classes(found, blocks)}
        )
    return rows

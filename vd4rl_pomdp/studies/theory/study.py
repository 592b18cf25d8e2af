"""Computations of `vd4rl-pomdp theory`: the paper's Table 1 and equations, compared with enumeration on small
worlds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from itertools import product
from typing import Any

from vd4rl_pomdp.runs.files import Row
from vd4rl_pomdp.studies.theory.classifiers import MemoryLengths, clash, compare
from vd4rl_pomdp.studies.theory.partition import (
    Relation,
    discards_noise,
    forced_shares,
    relation,
    state_classes,
    state_relation,
)
from vd4rl_pomdp.studies.theory.views import VIEWS
from vd4rl_pomdp.studies.theory.world import (
    WORLDS,
    Action,
    AgentState,
    World,
    alternator,
    counterexample,
    diameter,
    echo,
    flicker,
    future_memory,
    hidden_switch,
    idle,
    ladder,
    momentum,
    past_memory,
    period,
    switch,
    toggle,
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


def examples_by_k(world: World) -> list[dict[str, int]]:
    """One row per k: number of examples and state pairs, and of pairs with a certain or uniform first action."""
    rows = []
    for k in range(1, MAX_K + 1):
        first: dict[tuple[AgentState, AgentState], Counter[Action]] = {}
        for start, actions, end in inverse_examples(world, k):
            first.setdefault((start, end), Counter())[actions[0]] += 1
        certain = sum(len(counts) == 1 for counts in first.values())
        uniform = sum(len({counts[a] for a in world.actions}) == 1 for counts in first.values())
        examples = sum(counts.total() for counts in first.values())
        rows.append({"k": k, "examples": examples, "pairs": len(first), "certain": certain, "uniform": uniform})
    return rows


def enumerated(world: World) -> dict[str, Any]:
    """Enumeration of the counterexample with one of the paper's two action sets."""
    rows = examples_by_k(world)
    return {
        "actions": list(world.actions),
        "by_k": rows,
        "examples": sum(row["examples"] for row in rows),
        "uniform_k": [row["k"] for row in rows if row["uniform"] == row["pairs"]],
        "informative_k": [row["k"] for row in rows if row["uniform"] < row["pairs"]],
        "certain_k": [row["k"] for row in rows if row["certain"] == row["pairs"]],
        "diameter": diameter(world),
        "period": period(world),
        "m_with_actions": past_memory(world, actions=True),
        "m_without_actions": past_memory(world, actions=False),
        "n_with_actions": future_memory(world, actions=True),
        "n_with_actions_literal": future_memory(world, actions=True, literal=True),
    }


def least_memory(world: World) -> MemoryLengths:
    """Smallest decoding m and n with actions; if no n decodes, the literal reading's, or 0 if it has none."""
    m = past_memory(world, actions=True)
    ns = [future_memory(world, actions=True, literal=literal) for literal in (False, True)]
    assert m is not None, f"{world.name}: no past decodes"
    return MemoryLengths(m, next((n for n in ns if n is not None), 0))


@dataclass(frozen=True)
class Fact:
    """A number that the paper claims of a world, and its computed value."""

    title: str
    """The true statement, in one line."""
    printed: str
    """The paper's statement, and where."""
    world: str
    quantity: str
    claimed: str
    computed: str


INVERSE = "P(a_t | s_t, s_{t+k})"
CLAIMED = {
    "A forward jump looks back behind m": (
        f"P(a_t | rows t-m..t and t+k-m..t+k) is {INVERSE} for every k > m (section 3.1)"
    ),
    "Jumps beyond m are not useless to FJ+A": (
        "on the counterexample k > m = 3 gives no signal, so that FJ and FJ+A fail (section 3.2)"
    ),
    "Without the leak, the counterexample breaks an assumption of MIK+A": (
        "the counterexample sets MIK+A apart from FJ and FJ+A (section 3.2); MIK+A assumes that the future decodes "
        "(Table 1)"
    ),
    "On the counterexample k = 3 tells nothing": (
        "k = 2 and k = 3 are needed to tell the states apart, and k > 3 is uniform (section 3.2)"
    ),
    "With the main text's actions 0 and 1 every k tells something": (
        "a_t is 0 or 1, the diameter is 3, and k > 3 is uniform (section 3.2); the appendix has -1 and +1"
    ),
    "Read literally, the later view holds the action that is asked for": (
        f"row t is (o_t, a_{{t-1}}) (section 2), the later view begins with row t+k (appendix), MIK+A is {INVERSE} "
        "from k = 1 on (section 3.1)"
    ),
    "Read literally, MIK+A sees one of the masked actions at every k": (
        f"row t is (o_t, a_{{t-1}}), and MIK+A is {INVERSE} at every k (section 3.1)"
    ),
    "MIK+A's past encoder may merge states that act alike": (
        "MIK+A finds the complete agent-centric state (Table 1, section 3.2)"
    ),
    "Where states take turns, no inverse model tells the turns apart": (
        "all k up to the diameter recover the state of a deterministic world (appendix), and k = 1 to 3 that of the "
        "counterexample (section 3.2)"
    ),
    "FJ+A's jumps beyond m may need the exogenous part": "FJ+A discards exogenous noise (Table 1)",
}
"""The paper's statement, and where, by the true statement."""


def facts() -> list[Fact]:
    """Differences between text and enumeration, in the order of `CLAIMED`: one row per world that shows one.

    Every world meets the assumptions of the statement that it contradicts. Window lengths m and n are the smallest that
    decode.
    """
    theirs, main = counterexample(), counterexample((0, 1))
    third, uniform = examples_by_k(theirs)[2], enumerated(main)["uniform_k"]
    numbers = [
        [_prediction(world, "fj+a", least_memory(world).m + 1) for world in (ladder(), theirs)],
        [_jumps(theirs)],
        [_prediction(world, "mik+a", 1) for world in (hidden_switch(), theirs)],
        [
            (
                theirs.name,
                "pairs at which k = 3 tells something",
                "some",
                f"{third['pairs'] - third['uniform']} of {third['pairs']}",
            )
        ],
        [
            (main.name, "k above 3 that are uniform", "4 to 10", ", ".join(map(str, uniform)) or "none"),
            (main.name, "diameter", "3", str(diameter(main))),
        ],
        [_prediction(idle(), "mik+a literal", 1)],
        [_prediction(world, "mik+a literal", 2) for world in (toggle(), momentum())],
        [_merged(world) for world in (switch(), echo())],
        [_codes(world) for world in (alternator(), theirs)],
        [_noise(world) for world in (flicker(), theirs)],
    ]
    return [
        Fact(title, printed, *row)
        for (title, printed), rows in zip(CLAIMED.items(), numbers, strict=True)
        for row in rows
    ]


_Row = tuple[str, str, str, str]
"""World, quantity, claimed and computed value."""


def _prediction(world: World, method: str, first_k: int) -> _Row:
    """The first k, of GAPS, at which a method differs from the multi-step inverse: where, and both probabilities."""
    memory = least_memory(world)
    for k in range(first_k, first_k + GAPS):
        if found := clash(world, VIEWS[method], memory, k):
            where = f"m = {memory.m}, k = {k}, s_t = {found.states[0]}, s_{{t+k}} = {found.states[1]}"
            return (
                world.name, f"{method}'s P(a_t = {found.action}), {where}", str(found.multi_step), str(found.exact),
            )  # fmt: skip
    raise AssertionError(f"{method} is the multi-step inverse of {world.name}")


def _jumps(world: World) -> _Row:
    """State pairs that FJ+A separates with jumps beyond m, compared with shorter ones and with the literal MIK+A."""
    m = least_memory(world).m
    near, far = (always_apart(relation(world, VIEWS["fj+a"], MemoryLengths(m, m), range(1, k + 1))) for k in (m, m + 2))
    masked = always_apart(relation(world, VIEWS["mik+a literal"], MemoryLengths(m, m), range(1, m + 1)))
    aside = f"k up to {m}: {near[0]}; mik+a literal: {masked[0]}"
    return (
        world.name,
        f"pairs of states apart by fj+a, k up to {m + 2} ({aside})",
        str(near[0]),
        "{} of {}".format(*far),
    )


def _merged(world: World) -> _Row:
    """State pairs that MIK+A's past encoder must separate, with both actions equally likely."""
    reach = _reach(world)
    apart, pairs = always_apart(relation(world, VIEWS["mik+a"], least_memory(world), range(1, reach + 1)))
    return world.name, f"pairs of states apart by mik+a, k up to {reach}", f"{pairs} of {pairs}", f"{apart} of {pairs}"


def _codes(world: World) -> _Row:
    """Codes that a shared encoder on true states needs for every k up to twice the diameter."""
    codes = len(set(state_relation(world, range(1, 2 * _reach(world) + 1)).coarsest().tolist()))
    return world.name, f"codes on true states, k up to {2 * _reach(world)}", str(len(world.states)), str(codes)


def _noise(world: World) -> _Row:
    """The first of two maximum k beyond m at which FJ+A's prediction depends on the exogenous part of its past."""
    memory = least_memory(world)
    needed = (
        k
        for k in (memory.m + 1, memory.m + 2)
        if not discards_noise(relation(world, VIEWS["fj+a"], memory, range(1, k + 1)))
    )
    return world.name, f"fj+a needs the past's exogenous part, m = {memory.m}", "at no k", f"at k up to {next(needed)}"


def always_apart(found: Relation) -> tuple[int, int]:
    """Number of state pairs that every optimal representation separates for all histories, and of all pairs."""
    shares = forced_shares(found).values()
    return sum(share == 1 for share in shares), len(shares)


def _reach(world: World) -> int:
    return max(1, diameter(world) or 0)


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
    """The printed row of a method; literal readings share it."""
    return PRINTED[method.removesuffix(" literal")]


def theory_study() -> dict[str, Any]:
    """Compute counterexample, Table 1, equations, facts and merged states, JSON-serialisable."""
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
    """One world with its variants, and its window lengths and maximum k."""

    name: str
    worlds: dict[tuple[bool, bool], World]
    """Variants by (noise, state-dependent policy)."""
    memory: MemoryLengths
    diameter: int
    max_k: int
    """Largest k: max(diameter, m + 2)."""


def make_case(name: str) -> Case:
    """A world as a case, with computed memory lengths and diameter."""
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
    """One row per variant, method and k. With noise, k stops at the diameter, since there are many more sequences."""
    return [
        {"world": case.name, "noise": noise, "state_dependent": biased, "method": method}
        | asdict(compare(world, VIEWS[method], case.memory, k))
        for (noise, biased), world in case.worlds.items()
        for method in METHODS
        for k in range(1, (case.diameter if noise else case.max_k) + 1)
    ]


def representations(case: Case) -> list[Row]:
    """One row per policy and method: state pairs that must be separated, and whether noise can be discarded.

    k goes up to the diameter; methods without the whole history have a second row if `max_k` is larger.
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
    """A method's row of Table 1 on one world, from its comparisons and its representations.

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
"""Closed forms of classifiers in section 3.1: a method, one of RANGES, and one of FORMS (fields of `Comparison`)."""


def compare_equations(rows: list[Row], memories: dict[str, MemoryLengths]) -> list[Row]:
    """For every equation and world: the k at which it holds or fails, and whether its assumptions are met."""
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
    """An entry of Table 1 or an equation, contradicted by a world that meets the method's assumptions."""

    world: str
    method: str
    printed: str
    computed: str


def differences(tables: dict[str, list[Row]], equations: list[Row]) -> list[Difference]:
    """Differences between printed and computed entries, for methods that decode the states.

    A printed no means that a property is not guaranteed, so a world with the property does not contradict it.
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
    """For some objectives, the classes of the counterexample's states that a coarsest partition cannot distinguish."""
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

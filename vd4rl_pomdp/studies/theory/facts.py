"""Where the paper's text and exact enumeration differ: its counterexample, counted, and ten statements held to worlds.

The counterexample (section 3.2 and appendix) is about inverse examples: a start state, k actions and the state they
lead to. The paper generates all of them for k = 1..10 and asks, for each pair of states, how the first action is
distributed.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import product
from typing import Any

from vd4rl_pomdp.studies.theory.classifiers import MemoryLengths, clash
from vd4rl_pomdp.studies.theory.decodability import future_memory, past_memory
from vd4rl_pomdp.studies.theory.gallery import (
    alternator,
    counterexample,
    echo,
    flicker,
    hidden_switch,
    idle,
    ladder,
    momentum,
    switch,
    toggle,
)
from vd4rl_pomdp.studies.theory.partition import Relation, discards_noise, forced_shares, relation, state_relation
from vd4rl_pomdp.studies.theory.views import VIEWS
from vd4rl_pomdp.studies.theory.world import Action, AgentState, World, diameter, period

MAX_K = 10
GAPS = 4
"""How many k are tried, from the first one that a statement is about."""


def inverse_examples(world: World, k: int) -> list[tuple[AgentState, tuple[Action, ...], AgentState]]:
    """Every (s_t, (a_t..a_{t+k-1}), s_{t+k})."""
    found = []
    for start in world.states:
        for actions in product(world.actions, repeat=k):
            state = start
            for action in actions:
                state = world.step[state, action]
            found.append((start, actions, state))
    return found


def examples_by_k(world: World) -> list[dict[str, int]]:
    """One row for every k: examples, pairs of states, and at how many of them the first action is known or uniform."""
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
    """What enumeration says of the counterexample, with one of the paper's two action sets."""
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
    """The least m and n with actions; where no n decodes, that of the literal reading, or 0 if none does either."""
    m = past_memory(world, actions=True)
    ns = [future_memory(world, actions=True, literal=literal) for literal in (False, True)]
    assert m is not None, f"{world.name}: no past decodes"
    return MemoryLengths(m, next((n for n in ns if n is not None), 0))


@dataclass(frozen=True)
class Fact:
    """A number of a world, as a statement of the paper has it and as it is."""

    title: str
    """What is true, in a line."""
    printed: str
    """What the paper prints, and where."""
    world: str
    quantity: str
    claimed: str
    computed: str


INVERSE = "P(a_t | s_t, s_{t+k})"
PRINTED = {
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
"""What the paper prints, and where, by what is true instead."""


def facts() -> list[Fact]:
    """Where text and enumeration differ, in the order of `PRINTED`: one row for each world that shows it.

    Every world meets the assumptions of the statement that it contradicts. Window lengths m and n are the least that
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
        for (title, printed), rows in zip(PRINTED.items(), numbers, strict=True)
        for row in rows
    ]


_Row = tuple[str, str, str, str]
"""World, quantity, claimed and computed number."""


def _prediction(world: World, method: str, first_k: int) -> _Row:
    """The first k, of GAPS, at which a method is not the multi-step inverse: where, and both probabilities."""
    memory = least_memory(world)
    for k in range(first_k, first_k + GAPS):
        if found := clash(world, VIEWS[method], memory, k):
            where = f"m = {memory.m}, k = {k}, s_t = {found.states[0]}, s_{{t+k}} = {found.states[1]}"
            return (
                world.name, f"{method}'s P(a_t = {found.action}), {where}", str(found.multi_step), str(found.exact),
            )  # fmt: skip
    raise AssertionError(f"{method} is the multi-step inverse of {world.name}")


def _jumps(world: World) -> _Row:
    """States that FJ+A tells apart by jumps beyond m, beside those by shorter ones and by the literal MIK+A."""
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
    """States that MIK+A's past encoder has to tell apart, with both actions equally likely."""
    reach = _reach(world)
    apart, pairs = always_apart(relation(world, VIEWS["mik+a"], least_memory(world), range(1, reach + 1)))
    return world.name, f"pairs of states apart by mik+a, k up to {reach}", f"{pairs} of {pairs}", f"{apart} of {pairs}"


def _codes(world: World) -> _Row:
    """Codes that one encoder on true states needs at both ends, at every k up to twice the diameter."""
    codes = len(set(state_relation(world, range(1, 2 * _reach(world) + 1)).coarsest().tolist()))
    return world.name, f"codes on true states, k up to {2 * _reach(world)}", str(len(world.states)), str(codes)


def _noise(world: World) -> _Row:
    """The first of two k beyond m up to which FJ+A's prediction depends on the exogenous part of its past."""
    memory = least_memory(world)
    needed = (
        k
        for k in (memory.m + 1, memory.m + 2)
        if not discards_noise(relation(world, VIEWS["fj+a"], memory, range(1, k + 1)))
    )
    return world.name, f"fj+a needs the past's exogenous part, m = {memory.m}", "at no k", f"at k up to {next(needed)}"


def always_apart(found: Relation) -> tuple[int, int]:
    """Pairs of states all of whose histories every optimal representation separates, and all pairs."""
    shares = forced_shares(found).values()
    return sum(share == 1 for share in shares), len(shares)


def _reach(world: World) -> int:
    return max(1, diameter(world) or 0)

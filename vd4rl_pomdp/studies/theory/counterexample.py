"""The paper's Forward-Jump counterexample (section 3.2 and appendix): its inverse examples, listed and counted.

An inverse example is a start state, k actions and the state they lead to. The paper generates all of them for
k = 1..10 and asks, for each pair of states, how the first action is distributed.
"""

from __future__ import annotations

from collections import Counter
from itertools import product
from typing import Any

from vd4rl_pomdp.studies.theory.decodability import future_memory, past_memory
from vd4rl_pomdp.studies.theory.world import Action, AgentState, World, diameter, period

MAX_K = 10
CLAIMED_EXAMPLES = 16368
CLAIMED_NEEDED = (2, 3)
"""The k without which, as the paper has it, states cannot be told apart."""
CLAIMED_UNIFORM = range(4, MAX_K + 1)
"""The k at which, as the paper has it, both first actions are equally likely."""


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


def first_actions(world: World, k: int) -> dict[tuple[AgentState, AgentState], Counter]:
    """How often each action comes first, for every pair of states that k actions connect."""
    counts: dict[tuple[AgentState, AgentState], Counter] = {}
    for start, actions, end in inverse_examples(world, k):
        counts.setdefault((start, end), Counter())[actions[0]] += 1
    return counts


def by_k(world: World) -> list[dict[str, Any]]:
    """One row for every k: examples, pairs of states, and at how many of them the first action is known or uniform."""
    rows = []
    for k in range(1, MAX_K + 1):
        pairs = first_actions(world, k)
        even = sum(len(set(c[a] for a in world.actions)) == 1 for c in pairs.values())
        row = {"k": k, "examples": sum(c.total() for c in pairs.values()), "pairs": len(pairs)}
        rows.append(row | {"certain": sum(len(c) == 1 for c in pairs.values()), "uniform": even})
    return rows


def study(world: World) -> dict[str, Any]:
    """What enumeration says of the counterexample, with one of the paper's two action sets."""
    rows = by_k(world)
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

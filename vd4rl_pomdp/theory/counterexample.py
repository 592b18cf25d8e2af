"""The paper's Forward-Jump counterexample (section 3.2 and appendix): its inverse examples, listed and counted.

An inverse example is a start state, k actions and the state they lead to. The paper generates all of them for
k = 1..10 and asks, for each pair of states, how the first action is distributed.
"""

from __future__ import annotations

from collections import Counter
from itertools import product
from typing import Any

from vd4rl_pomdp.theory.decodability import future_memory, past_memory
from vd4rl_pomdp.theory.gallery import counterexample
from vd4rl_pomdp.theory.world import Action, AgentState, World, diameter, period

MAX_K = 10
CLAIMED_EXAMPLES = 16368
CLAIMED_UNIFORM = range(4, 11)
CLAIMED_DIAMETER = 3
CLAIMED_M = 3


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


def study(actions: tuple[int, int] = (-1, 1)) -> dict[str, Any]:
    """What enumeration says of the counterexample with one of the paper's two action sets."""
    world = counterexample(actions)
    rows = by_k(world)
    return {
        "actions": list(actions),
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


def differences(appendix: dict[str, Any], main_text: dict[str, Any]) -> list[str]:
    """Where the paper's statements on its counterexample differ from the enumeration; sentences with numbers."""
    found = []
    early = [k for k in appendix["uniform_k"] if k not in CLAIMED_UNIFORM]
    if early:
        found.append(
            "The text needs k = 2 and k = 3 to tell states apart; the first action is uniform at "
            f"k = {_list(early)} as well, so only k = {_list(appendix['informative_k'])} say anything."
        )
    for name, claimed in (
        ("examples", CLAIMED_EXAMPLES),
        ("diameter", CLAIMED_DIAMETER),
        ("m_with_actions", CLAIMED_M),
    ):
        if appendix[name] != claimed:
            found.append(f"The paper has {name} = {claimed}; enumeration gives {appendix[name]}.")
    late = [k for k in CLAIMED_UNIFORM if k not in main_text["uniform_k"]]
    if late:
        found.append(
            f"With the main text's actions {{0, 1}} the number of examples is {main_text['examples']}, too, but the "
            f"first action is not uniform at k = {_list(late)}, and the diameter is {main_text['diameter']}: the "
            "claims are about the appendix's {-1, +1}."
        )
    if appendix["n_with_actions"] is None:
        found.append(
            "Future decodability, which MIK+A assumes, fails: no later observation or action shows s^B, the last "
            f"action. It holds (n = {appendix['n_with_actions_literal']}) only if the future's first item carries "
            "a_{t+k-1}, the formula read literally, which at k = 1 is the action to be predicted."
        )
    if appendix["period"] > 1:
        found.append(
            f"The states have period {appendix['period']}: states of different parity never compete for the same "
            "(k, s_{t+k}), so that no inverse model, not even one on true states, has to tell them apart."
        )
    return found


def _list(ks: list[int]) -> str:
    return ", ".join(map(str, ks))

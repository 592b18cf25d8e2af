"""Bayes-optimal classifiers by enumeration: P(a_t | what an objective sees) against P(a_t | states)."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from fractions import Fraction

from vd4rl_pomdp.studies.theory.law import in_order, joint_law
from vd4rl_pomdp.studies.theory.views import ObjectiveView
from vd4rl_pomdp.studies.theory.world import Action, AgentState, World


@dataclass(frozen=True)
class MemoryLengths:
    """Lengths of the windows that stand for past and future."""

    m: int
    n: int


@dataclass(frozen=True)
class Comparison:
    """What the Bayes-optimal classifier of one objective is, at one k."""

    k: int
    multi_step: bool
    """Whether it equals P(a_t | s_t, s_{t+k}) on every sequence."""
    one_step: bool
    """Whether it equals P(a_t | s_t, s_{t+1}) on every sequence."""
    certain: bool
    """Whether it is 1 for the action taken, always."""
    uniform: bool
    """Whether it is the same for all actions, always."""
    sees_action: bool
    """Whether a_t is among what the objective is given."""
    decodes_past: bool
    """Whether what it sees of the past tells s_t."""
    decodes_end: bool
    """Whether what the later representation is computed from tells s_{t+k}."""
    entropy: float
    """H(a_t | what it sees), in nats."""
    multi_step_entropy: float
    """H(a_t | s_t, s_{t+k}), in nats."""


def first_row(view: ObjectiveView, memory: MemoryLengths) -> int:
    """The t of a pair that has a whole past window: literal windows reach one action further back."""
    return memory.m + (1 if view.literal and not view.masked else 0)


@dataclass(frozen=True)
class Clash:
    """One sequence on which an objective's classifier is not the multi-step inverse, and the action it is about."""

    k: int
    seen: dict[str, Hashable]
    """What the objective is given: "o_t", "a_t-1", "o_t+2" and so on."""
    states: tuple[AgentState, AgentState]
    """s_t and s_{t+k}."""
    action: Action
    exact: Fraction
    """Probability of the action given what is seen."""
    multi_step: Fraction
    """P(a_t | s_t, s_{t+k}) of it."""


def clash(world: World, view: ObjectiveView, memory: MemoryLengths, k: int) -> Clash | None:
    """The sequence on which one objective's classifier is farthest from the multi-step inverse; None if it is that."""
    t = first_row(view, memory)
    visible = view.visible(t, k, memory.m, memory.n, t + k + memory.n + 1)
    ends = [("s", t), ("s", t + k)]
    law = joint_law(world, visible | {("a", t), *ends})
    exact, multi = (law.given(group, ("a", t)).by_row() for group in (visible, ends))
    gaps = [[abs(p - q) for p, q in zip(*both, strict=True)] for both in zip(exact, multi, strict=True)]
    row = max(range(len(gaps)), key=lambda i: max(gaps[i]))
    place = gaps[row].index(max(gaps[row]))
    if not gaps[row][place]:
        return None
    (values,), (states,) = law.values(visible, [row]), law.values(ends, [row])
    seen = {
        f"{kind}_t{j - t:+d}".removesuffix("+0"): value
        for (kind, j), value in zip(in_order(visible), values, strict=True)
    }
    return Clash(k, seen, states, world.actions[place], exact[row][place], multi[row][place])


def compare(world: World, view: ObjectiveView, memory: MemoryLengths, k: int) -> Comparison:
    """Compare one objective's classifier at one k with those of the states, on every sequence of the world."""
    t = first_row(view, memory)
    rows = t + k + memory.n + 1
    start, end = view.start(t, memory.m), view.end(t, k, memory.m, memory.n, rows)
    law = joint_law(world, start | end | {("a", t), ("s", t), ("s", t + 1), ("s", t + k)})
    seen = law.given(start | end, ("a", t))
    multi = law.given([("s", t), ("s", t + k)], ("a", t))
    return Comparison(
        k,
        multi_step=seen.agrees(multi),
        one_step=seen.agrees(law.given([("s", t), ("s", t + 1)], ("a", t))),
        certain=seen.certain(),
        uniform=seen.uniform(),
        sees_action=("a", t) in start | end,
        decodes_past=law.tells(start, [("s", t)]),
        decodes_end=law.tells(end, [("s", t + k)]),
        entropy=seen.entropy(),
        multi_step_entropy=multi.entropy(),
    )

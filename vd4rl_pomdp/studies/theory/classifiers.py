"""Bayes-optimal classifiers by enumeration: P(a_t | an objective's inputs) compared with P(a_t | states)."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from fractions import Fraction

from vd4rl_pomdp.studies.theory.law import in_order, joint_law
from vd4rl_pomdp.studies.theory.views import ObjectiveView
from vd4rl_pomdp.studies.theory.world import Action, AgentState, World


@dataclass(frozen=True)
class MemoryLengths:
    """Window lengths: m for the past, n for the future."""

    m: int
    n: int


@dataclass(frozen=True)
class Comparison:
    """Properties of one objective's Bayes-optimal classifier at one k."""

    k: int
    multi_step: bool
    """Whether it equals P(a_t | s_t, s_{t+k}) on every sequence."""
    one_step: bool
    """Whether it equals P(a_t | s_t, s_{t+1}) on every sequence."""
    certain: bool
    """Whether it always assigns probability 1 to the action taken."""
    uniform: bool
    """Whether it is always uniform over actions."""
    sees_action: bool
    """Whether a_t is among the objective's inputs."""
    decodes_past: bool
    """Whether its past inputs determine s_t."""
    decodes_end: bool
    """Whether the inputs of its later representation determine s_{t+k}."""
    entropy: float
    """H(a_t | inputs), in nats."""
    multi_step_entropy: float
    """H(a_t | s_t, s_{t+k}), in nats."""


def first_row(view: ObjectiveView, memory: MemoryLengths) -> int:
    """First t with a whole past window; literal windows contain one more action."""
    return memory.m + (1 if view.literal and not view.masked else 0)


@dataclass(frozen=True)
class Clash:
    """A sequence and an action on which an objective's classifier differs from the multi-step inverse."""

    k: int
    seen: dict[str, Hashable]
    """The objective's inputs by name: "o_t", "a_t-1", "o_t+2" and so on."""
    states: tuple[AgentState, AgentState]
    """s_t and s_{t+k}."""
    action: Action
    exact: Fraction
    """Probability of the action given the inputs."""
    multi_step: Fraction
    """P(a_t | s_t, s_{t+k}) of the action."""


def clash(world: World, view: ObjectiveView, memory: MemoryLengths, k: int) -> Clash | None:
    """The sequence with the largest difference between an objective's classifier and the multi-step inverse; None if
    equal."""
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
    """Compare one objective's classifier at one k with the state-based ones, on every sequence of the world."""
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

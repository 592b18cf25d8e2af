"""Bayes-optimal classifiers by enumeration: P(a_t | an objective's inputs) compared with P(a_t | states).

`VIEWS` are the inputs of the inverse objectives of the paper's Table 1. The learned objectives declare the same in
`InverseObjective.visible`, and a test compares the two. Here a view has two parts, one for each representation.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Literal

from vd4rl_pomdp.studies.theory.law import Variable, joint_law
from vd4rl_pomdp.studies.theory.world import Action, AgentState, World


@dataclass(frozen=True)
class ObjectiveView:
    """The observations and actions of a sequence that one objective sees."""

    name: str
    past: Literal["none", "all", "window"]
    """Rows before t that are seen (and before t+k, if the later representation encodes a past): none, all, or m."""
    actions: bool = False
    """Whether actions are seen."""
    masked: bool = False
    """Whether the later representation encodes the future from t+k on, with its own encoder."""
    literal: bool = False
    """Whether a window's first row also contains the action before it, as the paper's formulas read."""

    def start(self, t: int, m: int) -> frozenset[Variable]:
        """Inputs of the representation at row t."""
        first = {"none": t, "all": 0, "window": max(0, t - m)}[self.past]
        earlier = first - 1 if self.literal and not self.masked else first
        return _variables(range(first, t + 1), range(max(0, earlier), t) if self.actions else ())

    def end(self, t: int, k: int, m: int, n: int, rows: int) -> frozenset[Variable]:
        """Inputs of the representation at row t+k, in a window of `rows` rows.

        A future of n rows beyond t+k contains n+1 actions, as in `MaskedInverse`.
        """
        if not self.masked:
            return self.start(t + k, m)
        last = min(rows, t + k + n + 1)
        shift = 1 if self.literal else 0
        actions = range(t + k - shift, last - shift) if self.actions else ()
        return _variables(range(t + k, last), actions)

    def visible(self, t: int, k: int, m: int, n: int, rows: int) -> frozenset[Variable]:
        """All inputs of a prediction."""
        return self.start(t, m) | self.end(t, k, m, n, rows)


def _variables(rows: range, actions: range | tuple) -> frozenset[Variable]:
    return frozenset([("o", j) for j in rows] + [("a", j) for j in actions])


VIEWS = {
    view.name: view
    for view in (
        ObjectiveView("no_history", "none"),
        ObjectiveView("ah", "all"),
        ObjectiveView("ah+a", "all", actions=True),
        ObjectiveView("fj", "window"),
        ObjectiveView("fj+a", "window", actions=True),
        ObjectiveView("fj+a literal", "window", actions=True, literal=True),
        ObjectiveView("mik", "window", masked=True),
        ObjectiveView("mik+a", "window", actions=True, masked=True),
        ObjectiveView("mik+a literal", "window", actions=True, masked=True, literal=True),
    )
}
"""Views by method. Literal rows are (o_t, a_{t-1}), as the paper defines them: rows of the future in `mik+a literal`,
of the past in `fj+a literal`.
"""


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
    (states,) = law.values(ends, [row])
    return Clash(states, world.actions[place], exact[row][place], multi[row][place])


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
        sees_action=("a", t) in start | end,
        decodes_past=law.tells(start, [("s", t)]),
        decodes_end=law.tells(end, [("s", t + k)]),
        entropy=seen.entropy(),
        multi_step_entropy=multi.entropy(),
    )

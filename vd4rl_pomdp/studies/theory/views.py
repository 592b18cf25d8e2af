"""Which variables each inverse objective of the paper's Table 1 sees when it predicts a_t for the pair (t, t+k).

The learned objectives declare the same in `InverseObjective.visible`, and a test compares the two. Here a view has two
parts, one for each of the two representations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vd4rl_pomdp.studies.theory.law import Variable


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

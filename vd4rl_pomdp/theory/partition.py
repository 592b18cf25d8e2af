"""What an objective needs of its representation: coarsest partitions of histories through which its classifier factors.

At its optimum an objective knows F_k(x, y) = P(a_t | x, y) for every history x and later view y that occur together. A
representation phi is enough if F_k is a function of phi(x) and phi(y) (of phi(x) and y, where the later view is one of
the future and has an encoder of its own). Every refinement of such a phi is enough, too, so:

- two histories *must differ* if putting just these two together contradicts F: no optimal representation merges them;
- a partition is *coarsest* if no two of its blocks can be put together. F is silent about pairs that never occur
  together, so there may be several; they are found by first fit, from more than one order, and the smallest is shown.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import combinations, product

import numpy as np

from vd4rl_pomdp.theory.classifiers import Memory, first_row
from vd4rl_pomdp.theory.law import Prediction, Variable, joint_law
from vd4rl_pomdp.theory.views import View
from vd4rl_pomdp.theory.world import World

History = tuple
"""Values of what a representation is computed from, oldest first."""


@dataclass(frozen=True)
class Facts:
    """What a history goes with."""

    states: frozenset
    """Agent-centric states it may end in; one, if it decodes."""
    noises: frozenset
    """Exogenous states it may end in."""
    contents: frozenset
    """Its agent-centric content: the states of the rows it shows and the actions it shows."""
    actions: tuple
    """The actions it shows, oldest first."""


class Relation:
    """F: which prediction goes with which pair of histories at which k."""

    def __init__(self, shared: bool) -> None:
        self.shared = shared
        self.facts: dict[Hashable, Facts] = {}
        self.rows: dict[Hashable, dict[tuple, int]] = {}
        """History -> {(role, k, other side) -> prediction}; role is start or end."""
        self.ks: set[int] = set()
        self._predictions: dict[Prediction, int] = {}

    def number(self, prediction: Prediction) -> int:
        """The number by which `rows` know a prediction."""
        return self._predictions.setdefault(prediction, len(self._predictions))

    def add(self, past: Hashable, later: Hashable, k: int, value: int) -> None:
        """Record one value of F, a prediction's number."""
        self.ks.add(k)
        self.rows.setdefault(past, {})["start", k, later if self.shared else ("future", later)] = value
        if self.shared:
            self.rows.setdefault(later, {})["end", k, past] = value

    def must_differ(self, one: Hashable, other: Hashable) -> bool:
        """Whether no representation that is enough can put two histories together."""
        return not _fits(self.rows[one], self.rows[other], one, other, self.ks)

    def conflicts(self) -> set[frozenset]:
        """Every pair of histories that must differ."""
        meeting: dict[tuple, list] = {}
        for history, row in self.rows.items():
            for key in row:
                meeting.setdefault(key, []).append(history)
        pairs = {frozenset(pair) for met in meeting.values() for pair in combinations(met, 2)}
        direct = [(h, other) for h, row in self.rows.items() for _, _, other in row if other in self.rows]
        loops = dict.fromkeys(h for h, other in direct if h == other)
        pairs |= {frozenset(pair) for pair in [*direct, *combinations(loops, 2)]}
        return {pair for pair in pairs if len(pair) == 2 and self.must_differ(*pair)}

    def factors(self, code: Callable[[Hashable], Hashable]) -> bool:
        """Whether F is a function of the codes of both sides."""
        told: dict[tuple, int] = {}
        for past, row in self.rows.items():
            for (role, k, later), value in row.items():
                if role == "start":
                    key = (k, code(past), code(later) if self.shared else later)
                    if told.setdefault(key, value) != value:
                        return False
        return True

    def coarsest(self) -> dict[Hashable, int]:
        """A coarsest partition, block by history: the smallest of those that the orders lead to."""
        groupings: tuple[Callable[[Hashable], tuple], ...] = (
            lambda h: (_text(self.facts[h].actions[::-1]),),
            lambda h: (_text(self.facts[h].states),),
        )
        found = [self._first_fit(group) for group in groupings]
        return min(found, key=lambda blocks: len(set(blocks.values())))

    def _first_fit(self, group: Callable[[Hashable], tuple]) -> dict[Hashable, int]:
        """Blocks by first fit: at first within groups (of equal states, or of equal actions), then across them."""
        blocks = _Blocks(self.rows, self.ks)
        order = sorted(self.rows, key=lambda h: (group(h), _text(self.facts[h].states), _text(h)))
        blocks.join(order, lambda a, b: group(a) == group(b))
        blocks.join([h for h in order if h in blocks.rows], lambda a, b: True)
        names = {name: i for i, name in enumerate(blocks.rows)}
        return {h: names[blocks.find(h)] for h in self.rows}


def _text(value: object) -> str:
    """A sort key for values of mixed types."""
    return repr(sorted(value, key=repr)) if isinstance(value, frozenset) else repr(value)


def _fits(mine: dict[tuple, int], theirs: dict[tuple, int], me: Hashable, them: Hashable, ks: set[int]) -> bool:
    """Whether two rows of F agree once the two sides have one name."""
    if any(mine[key] != theirs[key] for key in mine.keys() & theirs.keys()):
        return False
    for role, k in product(("start", "end"), ks):
        between = {row[role, k, name] for row in (mine, theirs) for name in (me, them) if (role, k, name) in row}
        if len(between) > 1:
            return False
    return True


class _Blocks:
    """Blocks of histories, each named by its first member, with the rows of F between blocks."""

    def __init__(self, rows: dict[Hashable, dict[tuple, int]], ks: set[int]) -> None:
        self.ks = ks
        self.rows = {name: dict(row) for name, row in rows.items()}
        self.parent: dict[Hashable, Hashable] = {name: name for name in rows}

    def find(self, name: Hashable) -> Hashable:
        """The block of a history."""
        while self.parent[name] != name:
            name = self.parent[name]
        return name

    def join(self, order: Sequence[Hashable], allowed: Callable[[Hashable, Hashable], bool]) -> None:
        """Put every block, in order, into the first earlier one that is allowed and contradicts nothing."""
        heads: list[Hashable] = []
        for name in order:
            fitting = (h for h in heads if allowed(h, name) and _fits(self.rows[h], self.rows[name], h, name, self.ks))
            head = next(fitting, None)
            if head is None:
                heads.append(name)
            else:
                self._merge(head, name)

    def _merge(self, head: Hashable, name: Hashable) -> None:
        mirror = {"start": "end", "end": "start"}
        self.parent[name] = head
        for (role, k, other), value in self.rows.pop(name).items():
            if other == name:
                other = head
            elif other in self.rows:
                self.rows[other].pop((mirror[role], k, name), None)
                self.rows[other][mirror[role], k, head] = value
            self.rows[head].pop((role, k, name), None)
            self.rows[head][role, k, other] = value


def relation(world: World, view: View, memory: Memory, ks: Iterable[int]) -> Relation:
    """F of one objective on a world, for some k.

    Where the past is a window, one t with a whole window stands for all. Where it is the whole history, every pair
    within the rows m..m+K is taken, because one late history must serve all earlier t.
    """
    ks, first = list(ks), first_row(view, memory)
    found, histories = Relation(shared=not view.masked), {}
    for t in range(first, first + (max(ks) if view.past == "all" else 1)):
        for k in (k for k in ks if view.past != "all" or t + k <= first + max(ks)):
            rows = t + k + memory.n + 1
            start, end = view.start(t, memory.m), view.end(t, k, memory.m, memory.n, rows)
            _add_predictions(found, world, start, end, t, k)
            histories[t] = start
            if found.shared:
                histories[t + k] = end
    for row, seen in histories.items():
        _add_facts(found, world, seen, row)
    return found


def _add_predictions(
    found: Relation, world: World, start: frozenset[Variable], end: frozenset[Variable], t: int, k: int
) -> None:
    law = joint_law(world, start | end | {("a", t)})
    seen = law.given(start | end, ("a", t))
    rows = np.unique(seen.ids, return_index=True)[1]
    kinds, distinct = seen.kinds
    numbers = [found.number(prediction) for prediction in distinct]
    for kind, past, later in zip(kinds, law.values(start, rows), law.values(end, rows), strict=True):
        found.add(past, later, k, numbers[kind])


def _add_facts(found: Relation, world: World, past: frozenset[Variable], row: int) -> None:
    shown = {("s", j) for kind, j in past if kind == "o"}
    actions = {v for v in past if v[0] == "a"}
    law = joint_law(world, past | shown | {("s", row), ("xi", row)})
    everything = np.arange(len(law.counts))
    columns = [law.values(g, everything) for g in (past, [("s", row)], [("xi", row)], shown | actions, actions)]
    for history, (state,), (noise,), content, acted in zip(*columns, strict=True):
        old = found.facts.get(history, Facts(frozenset(), frozenset(), frozenset(), acted))
        found.facts[history] = Facts(old.states | {state}, old.noises | {noise}, old.contents | {content}, acted)


def state_relation(world: World, ks: Iterable[int]) -> Relation:
    """F_k(s, s') = P(a_t | s_t = s, s_{t+k} = s') with one encoder for both ends: multi-step inverse on true states."""
    found = Relation(shared=True)
    for k in ks:
        _add_predictions(found, world, frozenset([("s", 0)]), frozenset([("s", k)]), 0, k)
    for state in world.states:
        found.facts[state,] = Facts(frozenset([state]), frozenset(world.exogenous), frozenset([state]), ())
    return found


def forced_shares(found: Relation, states: Sequence[Hashable]) -> dict[frozenset, Fraction]:
    """For every pair of states, the share of pairs of their histories that every optimal representation separates.

    Only histories whose exogenous parts can be the same are paired: else a code could lean on what the future shows of
    the exogenous part.
    """
    eligible: Counter = Counter()
    groups = Counter((facts.states, facts.noises) for facts in found.facts.values())
    for (mine, here), (theirs, there) in product(groups, repeat=2):
        if here & there:
            count = groups[mine, here] * groups[theirs, there]
            eligible.update({(s, other): count for s in mine for other in theirs})
    forced: Counter = Counter()
    for pair in found.conflicts():
        one, other = (found.facts[h] for h in pair)
        if one.noises & other.noises:
            forced.update(frozenset(ends) for ends in product(one.states, other.states))
    return {frozenset(pair): Fraction(forced[frozenset(pair)], eligible[pair]) for pair in combinations(states, 2)}


def discards_noise(found: Relation) -> bool:
    """Whether F factors through the agent-centric content of histories: what differs in noise alone is put together."""
    blocks = {h: h for h in found.facts}

    def find(h: Hashable) -> Hashable:
        while blocks[h] != h:
            h = blocks[h]
        return h

    first: dict[Hashable, Hashable] = {}
    for history, facts in found.facts.items():
        for content in facts.contents:
            blocks[find(history)] = find(first.setdefault(content, history))
    return found.factors(find)


def state_classes(found: Relation, blocks: dict[Hashable, int], states: Sequence[Hashable]) -> dict[Hashable, int]:
    """Classes of states that a partition of histories cannot tell: they share a block at an equal exogenous state,
    directly or through others."""
    label = {s: s for s in states}
    members: dict[tuple, set] = {}
    for history, block in blocks.items():
        for noise in found.facts[history].noises:
            members.setdefault((block, noise), set()).update(found.facts[history].states)
    for together in members.values():
        joined = {label[s] for s in together}
        target = min(joined, key=states.index)
        label = {s: target if name in joined else name for s, name in label.items()}
    numbers = {name: i for i, name in enumerate(dict.fromkeys(label[s] for s in states))}
    return {s: numbers[label[s]] for s in states}

"""The exact joint law of observations, actions and states of a finite world's sequences, as integer counts.

Every table of probabilities is brought to one denominator, so that all sequences of one length share one total, which
is never needed: a law is a list of distinct sequences and an integer for each. The recursion goes row by row over
arrays; what no one asked for is summed out as it passes, so masked steps cost nothing. Integers are 64 bits wide where
that suffices and unbounded where it does not.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from math import lcm, log
from typing import Any

import numpy as np

from vd4rl_pomdp.theory.world import Pair, World, uniform

Variable = tuple[str, int]
"""("o", j), ("a", j), ("s", j) or ("xi", j): observation, action, agent-centric or exogenous state of row j."""
Prediction = tuple[Fraction, ...]
"""Probability of every action, in the world's order."""
KINDS = ("s", "xi", "o", "a")
"""Order of the variables of one row."""
LARGEST = 2**62


@dataclass(frozen=True)
class Law:
    """The joint law of some variables: distinct joint values, as codes, and how often each occurs."""

    variables: tuple[Variable, ...]
    codes: np.ndarray
    """(N, V) int64: places in `names`."""
    counts: np.ndarray
    """(N,) integers."""
    names: dict[str, tuple[Hashable, ...]]
    """What the codes of a kind of variable stand for."""

    def values(self, group: Iterable[Variable], rows: np.ndarray) -> list[tuple]:
        """Joint values of a group of variables, by row and in the order of `KINDS`, at some of the N rows."""
        chosen = sorted(group, key=_place)
        columns = [[self.names[kind][c] for c in self._column((kind, j))[rows]] for kind, j in chosen]
        return list(zip(*columns, strict=True)) if columns else [()] * len(rows)

    def ids(self, group: Iterable[Variable]) -> np.ndarray:
        """(N,) int64: a number for each distinct joint value of a group."""
        return _number([self._column(v) for v in sorted(group, key=_place)], len(self.counts))

    def given(self, group: Iterable[Variable], action: Variable) -> Conditional:
        """The conditional law of an action given a group of variables."""
        ids = self.ids(group)
        counts = np.zeros((int(ids.max()) + 1, len(self.names["a"])), self.counts.dtype)
        np.add.at(counts, (ids, self._column(action)), self.counts)
        return Conditional(ids, counts)

    def tells(self, group: Iterable[Variable], value: Iterable[Variable]) -> bool:
        """Whether some variables are a function of a group."""
        ids, told = self.ids(group), self.ids(value)
        return len(np.unique(ids)) == len(np.unique(np.stack([ids, told]), axis=1).T)

    def _column(self, variable: Variable) -> np.ndarray:
        return self.codes[:, self.variables.index(variable)]


@dataclass(frozen=True)
class Conditional:
    """P(a | view): which view each row of a law has, and how often each action goes with each view."""

    ids: np.ndarray
    """(N,) int64."""
    counts: np.ndarray
    """(views, actions) integers."""

    @cached_property
    def kinds(self) -> tuple[np.ndarray, list[Prediction]]:
        """Which of the distinct predictions belongs to each view, and those predictions."""
        rows = [np.unique(column, return_inverse=True)[1] for column in self.counts.T]
        kinds = _number(rows, len(self.counts))
        first = np.unique(kinds, return_index=True)[1]
        distinct = [tuple(Fraction(n, sum(row)) for n in row) for row in self.counts[first].astype(object).tolist()]
        return kinds, distinct

    def agrees(self, other: Conditional) -> bool:
        """Whether two classifiers say the same wherever their views occur together."""
        (mine, one), (theirs, two) = self.kinds, other.kinds
        met = np.unique(np.stack([mine[self.ids], theirs[other.ids]]), axis=1)
        return all(one[i] == two[j] for i, j in met.T)

    def certain(self) -> bool:
        """Whether the action is known, whatever the view."""
        return all(max(p) == 1 for p in self.kinds[1])

    def uniform(self) -> bool:
        """Whether no action is more likely than another, whatever the view."""
        return all(len(set(p)) == 1 for p in self.kinds[1])

    def entropy(self) -> float:
        """H(a | view) in nats; the only number here that is rounded."""
        kinds, distinct = self.kinds
        weights = np.zeros(len(distinct), object)
        np.add.at(weights, kinds, self.counts.astype(object).sum(1))
        bits = [-sum(float(q) * log(q) for q in p if q) for p in distinct]
        return sum(float(Fraction(w, sum(weights))) * bit for w, bit in zip(weights, bits, strict=True))


def joint_law(world: World, variables: Iterable[Variable], initial: Mapping[Pair, Fraction] | None = None) -> Law:
    """Exact joint law of some variables of a sequence that starts in the world's initial law, or in another."""
    wanted = sorted(set(variables), key=_place)
    rows = 1 + max(row for _, row in wanted)
    walk = _Walk(world, initial or world.initial, rows)
    for row in range(rows):
        kinds = {kind for kind, j in wanted if j == row}
        walk.observe(kinds)
        walk.act("a" in kinds)
    walk.forget_pair()
    names = {"s": world.states, "xi": world.exogenous, "o": world.symbols, "a": world.actions}
    return Law(tuple(wanted), np.stack(walk.columns, 1), walk.counts, names)


class _Walk:
    """All sequences so far: kept columns, the present pair, and a count."""

    def __init__(self, world: World, initial: Mapping[Pair, Fraction], rows: int) -> None:
        states, noises, symbols = world.states, world.exogenous, world.symbols
        self.step = np.array([[states.index(world.step[s, a]) for a in world.actions] for s in states])
        self.policy = _matrix([world.policy[s] for s in states], world.actions)
        self.drift = _matrix([world.drift[xi] for xi in noises], noises)
        self.emission = _matrix([world.emission[s, xi] for s in states for xi in noises], symbols)
        pairs = [(s, xi) for s in states for xi in noises]
        start = _matrix([dict(initial)], pairs)[0]
        scales = [int(m[0].sum()) for m in (self.policy, self.drift, self.emission)]
        self.dtype = np.int64 if int(start.sum()) * (scales[0] * scales[1] * scales[2]) ** rows < LARGEST else object
        (pair,) = np.nonzero(start)
        self.s, self.xi = np.divmod(pair, len(noises))
        self.counts = start[pair].astype(self.dtype)
        self.columns: list[np.ndarray] = []

    def observe(self, kinds: set[str]) -> None:
        """Keep what is wanted of a row's s, xi and o."""
        self.columns += [self.s] * ("s" in kinds) + [self.xi] * ("xi" in kinds)
        if "o" in kinds:
            symbol = self._branch(self.emission[self.s * len(self.drift) + self.xi])
            self.columns.append(symbol)

    def act(self, wanted: bool) -> None:
        """Move on by one action, kept if it is wanted; sequences that have become alike are added up."""
        action = self._branch(self.policy[self.s])
        self.s = self.step[self.s, action]
        self.columns += [action] * wanted
        self.xi = self._branch(self.drift[self.xi])
        self._merge([*self.columns, self.s, self.xi])

    def forget_pair(self) -> None:
        """Sum out the last pair."""
        self._merge(self.columns)

    def _branch(self, weights: np.ndarray) -> np.ndarray:
        """Split every sequence by the nonzero entries of its row of (N, C) weights; returns each branch's entry."""
        parent, entry = np.nonzero(weights)
        self.columns = [column[parent] for column in self.columns]
        self.s, self.xi = self.s[parent], self.xi[parent]
        self.counts = self.counts[parent] * weights[parent, entry].astype(self.dtype)
        return entry

    def _merge(self, keys: list[np.ndarray]) -> None:
        ids = _number(keys, len(self.counts))
        first = np.unique(ids, return_index=True)[1]
        counts = np.zeros(len(first), self.dtype)
        np.add.at(counts, ids, self.counts)
        self.columns = [column[first] for column in self.columns]
        self.s, self.xi, self.counts = self.s[first], self.xi[first], counts


def _number(columns: list[np.ndarray], length: int) -> np.ndarray:
    """(N,) int64: 0, 1, ... for each distinct row of some columns of small integers."""
    ids, distinct = np.zeros(length, np.int64), 1
    for column in columns:
        width = int(column.max()) + 1
        if distinct * width >= LARGEST:
            values, ids = np.unique(ids, return_inverse=True)
            distinct = len(values)
        ids, distinct = ids * width + column, distinct * width
    return np.unique(ids, return_inverse=True)[1]


def _matrix(table: Sequence[Mapping[Any, Fraction]], columns: Sequence[Hashable]) -> np.ndarray:
    """A table of laws with one common denominator: (rows, columns) integers."""
    scale = lcm(*(p.denominator for row in table for p in row.values()))
    return np.array([[int(row.get(c, 0) * scale) for c in columns] for row in table], dtype=object)


def _place(variable: Variable) -> tuple[int, int]:
    kind, row = variable
    return row, KINDS.index(kind)


def past_memory(world: World, actions: bool, limit: int = 6) -> int | None:
    """Smallest m at which o_{t-m}..o_t (with a_{t-m}..a_{t-1}) always tells s_t; None if no m up to `limit` does."""
    for m in range(limit + 1):
        seen = [("o", j) for j in range(m + 1)] + [("a", j) for j in range(m if actions else 0)]
        if _decodes(world, seen, m):
            return m
    return None


def future_memory(world: World, actions: bool, literal: bool = False, limit: int = 6) -> int | None:
    """Smallest n at which the future from row t on always tells s_t; None if no n up to `limit` does.

    The future is o_t..o_{t+n}, with actions a_t..a_{t+n}; read literally, each row carries the action before it:
    a_{t-1}..a_{t+n-1}.
    """
    for n in range(limit + 1):
        first = 0 if literal else 1
        seen = [("o", j) for j in range(1, n + 2)] + [("a", j) for j in range(first, first + n + 1 if actions else 0)]
        if _decodes(world, seen, 1):
            return n
    return None


def _decodes(world: World, seen: list[Variable], row: int) -> bool:
    """Whether the seen variables determine s at a row of every sequence that starts anywhere in the world."""
    return joint_law(world, [*seen, ("s", row)], uniform(world.reachable())).tells(seen, [("s", row)])

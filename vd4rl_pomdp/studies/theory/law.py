"""The exact joint law of observations, actions and states of a finite world's sequences, as integer counts.

The probabilities of a table are written with one denominator. All sequences of one length then have one denominator,
too, and a law is a list of distinct sequences with an integer for each, its numerator. Sequences are extended row by
row, as arrays; variables that no one asked for are summed out at once, so masked steps cost nothing. Integers are 64
bits wide where that suffices and unbounded where it does not.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, lru_cache
from math import lcm, log
from typing import Any

import numpy as np

from vd4rl_pomdp.studies.theory.world import World

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
    """(N, V) int32: places in `names`."""
    counts: np.ndarray
    """(N,) integers."""
    names: dict[str, tuple[Hashable, ...]]
    """What the codes of a kind of variable stand for."""

    def values(self, group: Iterable[Variable], rows: np.ndarray | slice | list[int]) -> list[tuple]:
        """Joint values of a group of variables, `in_order`, at some of the N rows."""
        columns = [[self.names[kind][c] for c in self.column((kind, j))[rows]] for kind, j in in_order(group)]
        return list(zip(*columns, strict=True)) if columns else [()] * len(self.counts[rows])

    def numbered(self, group: Iterable[Variable]) -> tuple[np.ndarray, np.ndarray]:
        """The number of the joint value of a group at each row, (N,) int64, and the first row that has each."""
        return number_rows([self.column(v) for v in in_order(group)])

    def given(self, group: Iterable[Variable], action: Variable) -> Conditional:
        """The conditional law of an action given a group of variables."""
        ids, first = self.numbered(group)
        counts = np.zeros((len(first), len(self.names["a"])), self.counts.dtype)
        np.add.at(counts, (ids, self.column(action)), self.counts)
        return Conditional(ids, first, counts)

    def tells(self, group: Iterable[Variable], value: Iterable[Variable]) -> bool:
        """Whether some variables are a function of a group."""
        (ids, first), (told, _) = self.numbered(group), self.numbered(value)
        return bool((told == told[first][ids]).all())

    def column(self, variable: Variable) -> np.ndarray:
        """(N,) int32: codes of one variable."""
        return self.codes[:, self.variables.index(variable)]


@dataclass(frozen=True)
class Conditional:
    """P(a | view): which view each row of a law has, and how often each action goes with each view."""

    ids: np.ndarray
    """(N,) int64."""
    first: np.ndarray
    """(views,) int64: the first row of each view."""
    counts: np.ndarray
    """(views, actions) integers."""

    @cached_property
    def kinds(self) -> tuple[np.ndarray, list[Prediction]]:
        """Which of the distinct predictions belongs to each view, and those predictions."""
        rows = [np.unique(column, return_inverse=True)[1] for column in self.counts.T]
        kinds, first = number_rows(rows)
        distinct = [tuple(Fraction(n, sum(row)) for n in row) for row in self.counts[first].astype(object).tolist()]
        return kinds, distinct

    def by_row(self) -> list[Prediction]:
        """The prediction at each of the law's N rows."""
        kinds, distinct = self.kinds
        return [distinct[kind] for kind in kinds[self.ids]]

    def agrees(self, other: Conditional) -> bool:
        """Whether two classifiers say the same wherever their views occur together."""
        (mine, one), (theirs, two) = self.kinds, other.kinds
        mine, theirs = mine[self.ids], theirs[other.ids]
        first = number_rows([mine, theirs])[1]
        return all(one[i] == two[j] for i, j in zip(mine[first], theirs[first], strict=True))

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


def joint_law(world: World, variables: Iterable[Variable]) -> Law:
    """Exact joint law of some variables of a sequence that starts in the world's initial law."""
    wanted = in_order(set(variables))
    rows = 1 + max(row for _, row in wanted)
    step, initial, policy, drift, emission = _tables(world)
    total = initial.total * (policy.total * drift.total * emission.total) ** rows
    counts = initial.weights[0].astype(np.int64 if total < LARGEST else object)
    columns = list(np.divmod(initial.entries[0], len(world.exogenous)))  # the present pair, then what is kept

    def branch(table: _Table, row: np.ndarray) -> None:
        """Split every sequence by what may come next, by its row of a table; each branch's entry is another column."""
        nonlocal counts
        weights = table.weights.astype(counts.dtype)
        parent, nth = np.nonzero(weights[row])
        columns[:] = [*(column[parent] for column in columns), table.entries[row[parent], nth]]
        counts = counts[parent] * weights[row[parent], nth]

    def merge(keys: list[np.ndarray]) -> None:
        """Add up sequences that are alike in some columns."""
        nonlocal counts
        ids, first = number_rows(keys)
        before, counts = counts, np.zeros(len(first), counts.dtype)
        np.add.at(counts, ids, before)
        columns[:] = [column[first] for column in columns]

    for row in range(rows):
        kinds = {kind for kind, j in wanted if j == row}
        columns += [columns[i] for i, kind in enumerate(("s", "xi")) if kind in kinds]
        if "o" in kinds:
            branch(emission, columns[0] * len(world.exogenous) + columns[1])
        if row < rows - 1 or "a" in kinds:
            branch(policy, columns[0])
            action = columns[-1] if "a" in kinds else columns.pop()
            columns[0] = step[columns[0], action]
            branch(drift, columns[1])
            columns[1] = columns.pop()
            merge([*columns[2:], *columns[:2]])
    merge(columns[2:])  # sums out the last pair
    names = {"s": world.states, "xi": world.exogenous, "o": world.symbols, "a": world.actions}
    return Law(tuple(wanted), np.stack(columns[2:], 1), counts, names)


class _Table:
    """Laws of what comes next, with one common denominator: for each row, entries and their weights."""

    def __init__(self, laws: Sequence[Mapping[Any, Fraction]], names: Sequence[Hashable]) -> None:
        scale = lcm(*(p.denominator for law in laws for p in law.values()))
        place = {name: i for i, name in enumerate(names)}
        width = max(map(len, laws))
        self.entries = np.zeros((len(laws), width), np.int32)
        self.weights = np.zeros((len(laws), width), object)
        """Padded with zeros."""
        for row, law in enumerate(laws):
            self.entries[row, : len(law)] = [place[name] for name in law]
            self.weights[row, : len(law)] = [int(p * scale) for p in law.values()]
        self.total = int(self.weights[0].sum())


@lru_cache(maxsize=16)
def _tables(world: World) -> tuple[np.ndarray, _Table, _Table, _Table, _Table]:
    """A world as numbers: next states (S, A), and the laws of the first pair, the action, the drift and the symbol."""
    states, noises, actions = world.states, world.exogenous, world.actions
    pairs = [(s, xi) for s in states for xi in noises]
    return (
        np.array([[states.index(world.step[s, a]) for a in actions] for s in states], np.int32),
        _Table([world.initial], pairs),
        _Table([world.policy[s] for s in states], actions),
        _Table([world.drift[xi] for xi in noises], noises),
        _Table([world.emission[pair] for pair in pairs], world.symbols),
    )


def number_rows(columns: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Number the distinct rows of some (N,) columns of small integers.

    Returns:
        (N,) int64, the number 0, 1, ... of each row, and the first row that has each number.
    """
    ids, distinct = np.zeros(len(columns[0]), np.int64), 1
    for column in columns:
        width = int(column.max()) + 1
        if distinct * width >= LARGEST:
            values, ids = np.unique(ids, return_inverse=True)
            distinct = len(values)
        ids, distinct = ids * width + column, distinct * width
    _, first, ids = np.unique(ids, return_index=True, return_inverse=True)
    return ids, first


def in_order(group: Iterable[Variable]) -> list[Variable]:
    """Variables by row, and within a row in the order of `KINDS`."""
    return sorted(group, key=lambda variable: (variable[1], KINDS.index(variable[0])))

"""Exact joint distributions of the observations, actions and states of a finite world, as integer counts.

All probabilities of a table have a common denominator, so all sequences of one length have one, too. A law is a list of
distinct sequences with integer numerators. Sequences are extended row by row as arrays; variables that are not needed
are summed out at once, so masked steps cost nothing. Integers have 64 bits if that suffices, else Python's precision.
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
"""Order of the variables in a row."""
LARGEST = 2**62


@dataclass(frozen=True)
class Law:
    """Joint distribution of some variables: distinct joint values as codes, with counts."""

    variables: tuple[Variable, ...]
    codes: np.ndarray
    """(N, V) int32: indices into `names`."""
    counts: np.ndarray
    """(N,) integers."""
    names: dict[str, tuple[Hashable, ...]]
    """Values by kind of variable, indexed by code."""

    def values(self, group: Iterable[Variable], rows: np.ndarray | slice | list[int]) -> list[tuple]:
        """Joint values of some variables, `in_order`, at some of the N rows."""
        columns = [[self.names[kind][c] for c in self.column((kind, j))[rows]] for kind, j in in_order(group)]
        return list(zip(*columns, strict=True)) if columns else [()] * len(self.counts[rows])

    def numbered(self, group: Iterable[Variable]) -> tuple[np.ndarray, np.ndarray]:
        """Index of the joint value of some variables at each row, (N,) int64, and the first row of each."""
        return number_rows([self.column(v) for v in in_order(group)])

    def given(self, group: Iterable[Variable], action: Variable) -> Conditional:
        """Conditional distribution of an action given some variables."""
        ids, first = self.numbered(group)
        counts = np.zeros((len(first), len(self.names["a"])), self.counts.dtype)
        np.add.at(counts, (ids, self.column(action)), self.counts)
        return Conditional(ids, first, counts)

    def tells(self, group: Iterable[Variable], value: Iterable[Variable]) -> bool:
        """Whether a group of variables determines others."""
        (ids, first), (values, _) = self.numbered(group), self.numbered(value)
        return bool((values == values[first][ids]).all())

    def column(self, variable: Variable) -> np.ndarray:
        """(N,) int32: codes of one variable."""
        return self.codes[:, self.variables.index(variable)]


@dataclass(frozen=True)
class Conditional:
    """P(a | view): the view of each row of a law, and action counts by view."""

    ids: np.ndarray
    """(N,) int64."""
    first: np.ndarray
    """(views,) int64: first row of each view."""
    counts: np.ndarray
    """(views, actions) integers."""

    @cached_property
    def kinds(self) -> tuple[np.ndarray, list[Prediction]]:
        """(views,) index into the distinct predictions, and these predictions."""
        rows = [np.unique(column, return_inverse=True)[1] for column in self.counts.T]
        kinds, first = number_rows(rows)
        distinct = [tuple(Fraction(n, sum(row)) for n in row) for row in self.counts[first].astype(object).tolist()]
        return kinds, distinct

    def by_row(self) -> list[Prediction]:
        """The prediction at each of the N rows."""
        kinds, distinct = self.kinds
        return [distinct[kind] for kind in kinds[self.ids]]

    def agrees(self, other: Conditional) -> bool:
        """Whether two classifiers agree on every row."""
        (mine, one), (theirs, two) = self.kinds, other.kinds
        mine, theirs = mine[self.ids], theirs[other.ids]
        first = number_rows([mine, theirs])[1]
        return all(one[i] == two[j] for i, j in zip(mine[first], theirs[first], strict=True))

    def certain(self) -> bool:
        """Whether every view determines the action."""
        return all(max(p) == 1 for p in self.kinds[1])

    def entropy(self) -> float:
        """H(a | view) in nats; the only rounded number here."""
        kinds, distinct = self.kinds
        weights = np.zeros(len(distinct), object)
        np.add.at(weights, kinds, self.counts.astype(object).sum(1))
        bits = [-sum(float(q) * log(q) for q in p if q) for p in distinct]
        return sum(float(Fraction(w, sum(weights))) * bit for w, bit in zip(weights, bits, strict=True))


def joint_law(world: World, variables: Iterable[Variable]) -> Law:
    """Exact joint distribution of some variables of a sequence that starts in the world's initial distribution."""
    wanted = in_order(set(variables))
    rows = 1 + max(row for _, row in wanted)
    step, initial, policy, drift, emission = _tables(world)
    total = initial.total * (policy.total * drift.total * emission.total) ** rows
    counts = initial.weights[0].astype(np.int64 if total < LARGEST else object)
    columns = list(np.divmod(initial.entries[0], len(world.exogenous)))  # the current pair, then the recorded ones

    def branch(table: _Table, row: np.ndarray) -> None:
        """Branch every sequence over the outcomes of its table row, which become another column."""
        nonlocal counts
        weights = table.weights.astype(counts.dtype)
        parent, nth = np.nonzero(weights[row])
        columns[:] = [*(column[parent] for column in columns), table.entries[row[parent], nth]]
        counts = counts[parent] * weights[row[parent], nth]

    def merge(keys: list[np.ndarray]) -> None:
        """Merge sequences with equal keys by adding their counts."""
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
    """Distributions with a common denominator: for each row, outcomes and integer weights."""

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
    """A world as arrays: next states (S, A), and tables of the first pair, action, drift and symbol."""
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
        (N,) int64, the number 0, 1, ... of each row, and the first row with each number.
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
    """Sort variables by row, then by `KINDS`."""
    return sorted(group, key=lambda variable: (variable[1], KINDS.index(variable[0])))

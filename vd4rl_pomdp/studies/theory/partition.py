"""Requirements of an objective on its representation: coarsest partitions of histories that determine its predictions.

At its optimum, an objective knows F_k(x, y) = P(a_t | x, y) for every history x and later view y that occur together. A
representation phi is sufficient if F_k is a function of phi(x) and phi(y) (of phi(x) and y, if the later view is a
future with its own encoder). Every refinement of a sufficient phi is sufficient. So:

- two histories *must differ* if merging just these two contradicts F: no optimal representation merges them;
- a partition is *coarsest* if no two of its blocks can be merged. F is undefined for pairs that never occur together,
  so there may be several; first fit from more than one order finds some, and the smallest is used.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fractions import Fraction
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vd4rl_pomdp.studies.theory.classifiers import MemoryLengths, ObjectiveView, first_row
from vd4rl_pomdp.studies.theory.law import Law, Prediction, Variable, joint_law, number_rows
from vd4rl_pomdp.studies.theory.world import World

History = tuple
"""Inputs of a representation, oldest first."""


class Relation:
    """F: the prediction for each pair of histories at each k. Histories and predictions are numbered."""

    def __init__(self, world: World, shared: bool) -> None:
        self.world = world
        self.shared = shared
        """Whether one representation encodes both ends."""
        self.histories: dict[History, int] = {}
        self.acted: dict[int, tuple] = {}
        """Actions in a history, oldest first."""
        self._laters: dict[tuple, int] = self.histories if shared else {}
        self._contents: dict[tuple, int] = {}
        self._predictions: dict[Prediction, int] = {}
        self._entries: list[np.ndarray] = []
        self.facts: dict[str, list[np.ndarray]] = {"s": [], "xi": [], "content": []}
        """Parts of (P, 2): each history with each possible agent-centric state, exogenous state and content."""

    def add(self, law: Law, start: Iterable[Variable], end: Iterable[Variable], t: int, k: int) -> None:
        """Record F_k from a law of both views and a_t."""
        seen = law.given({*start, *end}, ("a", t))
        kinds, distinct = seen.kinds
        values = np.array([self._predictions.setdefault(p, len(self._predictions)) for p in distinct])[kinds]
        past, later = (_numbers(*side, law)[seen.first] for side in ((self.histories, start), (self._laters, end)))
        self._entries.append(np.stack([np.full_like(past, k), past, later, values]))

    def add_facts(self, law: Law, past: Iterable[Variable], content: Iterable[Variable], row: int) -> None:
        """Record the possible states, exogenous states and contents of histories that end at a row.

        `law` has the variables `past` of the histories, their agent-centric `content` (the states of their rows, and
        their actions), and the s and xi of `row`.
        """
        history = _numbers(self.histories, past, law)
        columns = {kind: law.column((kind, row)) for kind in ("s", "xi")}
        columns["content"] = _numbers(self._contents, content, law)
        for kind, values in columns.items():
            self.facts[kind].append(np.unique(np.stack([history, values], axis=1), axis=0))
        numbers, first = np.unique(history, return_index=True)
        acted = law.values([v for v in past if v[0] == "a"], first)
        self.acted.update(zip(numbers.tolist(), acted, strict=True))

    @cached_property
    def entries(self) -> np.ndarray:
        """(4, E): k, history, other side and prediction of every pair that occurs."""
        return np.concatenate(self._entries, axis=1)

    @cached_property
    def states(self) -> np.ndarray:
        """(H, S) bool: possible final agent-centric states of a history; exactly one if it decodes the state."""
        return self._incidence("s", len(self.world.states))

    @cached_property
    def noises(self) -> np.ndarray:
        """(H, X) bool: possible final exogenous states of a history."""
        return self._incidence("xi", len(self.world.exogenous))

    def _incidence(self, kind: str, width: int) -> np.ndarray:
        table = np.zeros((len(self.histories), width), bool)
        table[tuple(np.concatenate(self.facts[kind]).T)] = True
        return table

    def conflicts(self) -> np.ndarray:
        """(H, H) bool: pairs of histories that every sufficient representation separates."""
        k, past, later, value = self.entries
        found = np.zeros((len(self.histories),) * 2, bool)
        _mark_differing(found, past, number_rows([k, later])[0], value)
        if self.shared:
            _mark_differing(found, later, number_rows([k, past])[0], value)
            for each in np.unique(k):  # merged, two histories would need several predictions for one pair
                table = np.full(found.shape, -1, np.int32)
                table[past[k == each], later[k == each]] = value[k == each]
                loop = table.diagonal()
                low, high = np.full_like(table, len(self._predictions)), table
                for other in (table, table.T, loop[:, None], loop):
                    low, high = np.where(other < 0, low, np.minimum(low, other)), np.maximum(high, other)
                found |= low < high
        return found | found.T

    def factors(self, codes: np.ndarray) -> bool:
        """Whether F is a function of both sides' codes; codes (H,) integers."""
        k, past, later, value = self.entries
        key, first = number_rows([k, codes[past], codes[later] if self.shared else later])
        return bool((value == value[first][key]).all())

    def coarsest(self) -> np.ndarray:
        """(H,) integers: the smallest of the coarsest partitions found."""
        names = np.fromiter(self.world.states, object, len(self.world.states))
        ends = [repr(sorted(names[row], key=repr)) for row in self.states]
        recent = [repr(self.acted[h][::-1]) for h in range(len(ends))]
        found = [self._first_fit(groups, ends) for groups in (recent, ends)]
        return min(found, key=lambda blocks: len(set(blocks)))

    def _first_fit(self, groups: Sequence[str], ends: Sequence[str]) -> np.ndarray:
        """Blocks by first fit: first within groups (equal states, or equal actions), then across them.

        A block is named by its first member, which keeps its row of the tables of F, (K, H, L): prediction for every k,
        history and other side, -1 for pairs that never occur.
        """
        k, past, later, value = self.entries
        place = np.unique(k, return_inverse=True)[1]
        tables = np.full((int(place.max()) + 1, len(self.histories), len(self._laters)), -1)
        tables[place, past, later] = value
        parent = np.arange(len(self.histories))

        def fit(one: int, other: int) -> bool:
            both = [one, other]
            if _differ(tables[:, both], axis=1):
                return False
            if not self.shared:
                return True
            between = tables[:, both][:, :, both].reshape(len(tables), 4)
            return not (_differ(tables[:, :, both], axis=2) or _differ(between, axis=1))

        def join(order: Iterable[int], within: bool) -> list[int]:
            """Merge every block, in order, into the first earlier one that is allowed and fits; returns the others."""
            heads: list[int] = []
            for name in order:
                mates = (h for h in heads if (not within or groups[h] == groups[name]) and fit(h, name))
                if (head := next(mates, None)) is None:
                    heads.append(name)
                    continue
                parent[parent == name] = head
                for side in (tables, tables.swapaxes(1, 2)) if self.shared else (tables,):
                    side[:, head] = np.maximum(side[:, head], side[:, name])  # where both have an entry, they are equal
                    side[:, name] = -1
            return heads

        texts = [repr(history) for history in self.histories]
        join(join(sorted(range(len(texts)), key=lambda h: (groups[h], ends[h], texts[h])), within=True), within=False)
        return np.unique(parent, return_inverse=True)[1]


def _differ(values: np.ndarray, axis: int) -> bool:
    """Whether known values (not -1) differ anywhere along an axis."""
    low = np.where(values < 0, values.max(initial=0), values).min(axis)
    return bool((low < values.max(axis)).any())


def _numbers(known: dict[tuple, int], group: Iterable[Variable], law: Law) -> np.ndarray:
    """(N,) numbers of the joint values of a group; new values get the next numbers."""
    ids, first = law.numbered(group)
    return np.array([known.setdefault(name, len(known)) for name in law.values(group, first)])[ids]


def _mark_differing(found: np.ndarray, mine: np.ndarray, key: np.ndarray, value: np.ndarray) -> None:
    """Mark all pairs of (E,) entries with equal keys and different values."""
    order = np.argsort(key, kind="stable")
    mine, key, value = mine[order], key[order], value[order]
    for gap in range(1, int(np.bincount(key).max())):
        differ = (key[gap:] == key[:-gap]) & (value[gap:] != value[:-gap])
        found[mine[gap:][differ], mine[:-gap][differ]] = True


def relation(world: World, view: ObjectiveView, memory: MemoryLengths, ks: Iterable[int]) -> Relation:
    """F of one objective on a world, for some k.

    For windowed pasts, one t with a whole window represents all. For whole histories, every pair within rows m..m+K is
    used, since one late history must serve all earlier t.
    """
    ks, first = list(ks), first_row(view, memory)
    found, histories = Relation(world, shared=not view.masked), {}
    for t in range(first, first + (max(ks) if view.past == "all" else 1)):
        for k in (k for k in ks if view.past != "all" or t + k <= first + max(ks)):
            rows = t + k + memory.n + 1
            start, end = view.start(t, memory.m), view.end(t, k, memory.m, memory.n, rows)
            found.add(joint_law(world, start | end | {("a", t)}), start, end, t, k)
            histories[t] = start
            if found.shared:
                histories[t + k] = end
    for row, seen in histories.items():
        content = {("s", j) if kind == "o" else (kind, j) for kind, j in seen}
        found.add_facts(joint_law(world, seen | content | {("s", row), ("xi", row)}), seen, content, row)
    return found


def state_relation(world: World, ks: Iterable[int]) -> Relation:
    """F_k(s, s') = P(a_t | s_t = s, s_{t+k} = s') with one encoder for both ends: multi-step inverse on true states."""
    found = Relation(world, shared=True)
    for k in ks:
        start, end = [("s", 0)], [("s", k)]
        found.add(joint_law(world, [*start, *end, ("a", 0)]), start, end, 0, k)
    found.add_facts(joint_law(world, [("s", 0), ("xi", 0)]), [("s", 0)], [("s", 0)], 0)
    return found


def forced_shares(found: Relation) -> dict[frozenset, Fraction]:
    """For every pair of states, the fraction of pairs of their histories that every optimal representation separates.

    Only histories that may have the same exogenous state are paired: others may be distinguishable by the exogenous
    part of the future.
    """
    ends, noises = found.states.astype(float), found.noises.astype(float)  # integers far below 2^53: exact
    eligible = noises @ noises.T > 0
    possible, forced = (ends.T @ pairs.astype(float) @ ends for pairs in (eligible, found.conflicts() & eligible))
    names = found.world.states
    return {
        frozenset((names[i], names[j])): Fraction(int(forced[i, j]), max(1, int(possible[i, j])))
        for i, j in combinations(range(len(names)), 2)
    }


def discards_noise(found: Relation) -> bool:
    """Whether F depends only on the agent-centric content of histories, so that noise can be discarded."""
    return found.factors(_linked(np.concatenate(found.facts["content"])))


def state_classes(found: Relation, blocks: np.ndarray) -> list[int]:
    """Class of each state: states that a partition of histories cannot distinguish share one.

    These share a block at an equal exogenous state, directly or through others.
    """
    history, noise = np.nonzero(found.noises)
    table = np.zeros((found.states.shape[1], int(blocks.max()) + 1, found.noises.shape[1]), bool)
    for state, ends in enumerate(found.states.T):
        there = ends[history]
        table[state, blocks[history[there]], noise[there]] = True
    return _linked(np.argwhere(table.reshape(len(table), -1))).tolist()


def _linked(pairs: np.ndarray) -> np.ndarray:
    """Connected components of the left numbers of (P, 2) pairs, linked by equal right numbers."""
    left, right = pairs.T
    size, width = int(left.max()) + 1, int(right.max()) + 1
    links = coo_array((np.ones(len(left)), (left, size + right)), shape=(size + width, size + width))
    return connected_components(links, directed=False)[1][:size]

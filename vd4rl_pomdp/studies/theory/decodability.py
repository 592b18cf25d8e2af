"""How much past, or future, tells the agent-centric state of a finite world (Wu et al., arXiv 2404.14552, section 2).

Two pairs (s, xi) are a *couple* as long as what is seen does not tell them apart. Each further row can only remove
couples, and once a row removes none, no later one does. So the search needs no bound: None is proven.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product

from vd4rl_pomdp.studies.theory.world import JointState, World

Couple = tuple[JointState, JointState]


def past_memory(world: World, actions: bool) -> int | None:
    """Smallest m at which o_{t-m}..o_t (with a_{t-m}..a_{t-1}) always tells s_t; None if no m does."""
    alike = _alike(world)
    return _rows_needed(alike, lambda left: {after for c in left for after in _next(world, c, actions)} & alike)


def future_memory(world: World, actions: bool, literal: bool = False) -> int | None:
    """Smallest n at which the future from row t on always tells s_t; None if no n does.

    The future is o_t..o_{t+n}, with actions a_t..a_{t+n}; read literally, each row carries the action before it:
    a_{t-1}..a_{t+n-1}, at every t that has an action before it.
    """
    couples = _alike(world)
    if literal:
        pairs = world.reachable()
        led = {after for c in product(pairs, pairs) for after in _next(world, c, actions)}
        return _rows_needed(couples, lambda left: _that_go_on(world, left, actions), led)
    going = {c for c in couples if any(_next(world, c, actions))}
    return _rows_needed(going, lambda left: _that_go_on(world, left, actions))


def _rows_needed(
    couples: set[Couple], with_one_more: Callable[[set[Couple]], set[Couple]], judged: set[Couple] | None = None
) -> int | None:
    """How many further rows leave no couple of two states (among those judged, if not all are)."""
    rows = 0
    while any(one != other for (one, _), (other, _) in (couples if judged is None else couples & judged)):
        fewer = with_one_more(couples)
        if fewer == couples:
            return None
        couples, rows = fewer, rows + 1
    return rows


def _alike(world: World) -> set[Couple]:
    """Reachable couples that can show the same symbol."""
    pairs = world.reachable()
    return {(one, other) for one in pairs for other in pairs if world.emission[one].keys() & world.emission[other]}


def _that_go_on(world: World, couples: set[Couple], actions: bool) -> set[Couple]:
    """Couples of a set that some next step leads into the set again."""
    return {c for c in couples if any(after in couples for after in _next(world, c, actions))}


def _next(world: World, couple: Couple, actions: bool) -> Iterator[Couple]:
    """Couples that may follow a couple: after the same action where actions are seen."""
    (one, here), (other, there) = couple
    for a, b in product(world.policy[one], world.policy[other]):
        if a == b or not actions:
            for after in product(world.drift[here], world.drift[there]):
                yield (world.step[one, a], after[0]), (world.step[other, b], after[1])

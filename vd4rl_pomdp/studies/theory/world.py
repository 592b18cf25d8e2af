"""A small language for finite agent-centric FM-POMDPs (Wu et al., arXiv 2404.14552, section 2), in exact arithmetic.

A world has agent-centric states s with deterministic dynamics, an exogenous chain xi that no action touches, an
emission of the pair, and a policy that reads s alone:

    row      0                1                2
    pair     (s_0, xi_0) ---> (s_1, xi_1) ---> (s_2, xi_2)       s_{t+1} = step(s_t, a_t),  xi_{t+1} ~ drift(xi_t)
    seen     o_0              o_1              o_2               o_t ~ emit(s_t, xi_t)
    action          a_0              a_1              a_2        a_t ~ policy(s_t)

Probabilities are fractions; `law` turns a world into exact joint laws of sequences. Behind the language stand how much
past or future tells a state, and the worlds on which the paper's claims are computed: three with variants, and seven
very small ones.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import product
from math import gcd
from typing import Any

from vd4rl_pomdp.core.errors import UserError

AgentState = Hashable
Exogenous = Hashable
Action = Hashable
Symbol = Hashable
JointState = tuple[AgentState, Exogenous]
Distribution = dict[Any, Fraction]
"""Probabilities by outcome; they sum to 1."""


@dataclass(frozen=True, eq=False)
class World:
    """A checked finite world; build it with `finite_world`. Two worlds are equal if they are the same object."""

    name: str
    states: tuple[AgentState, ...]
    exogenous: tuple[Exogenous, ...]
    actions: tuple[Action, ...]
    initial: dict[JointState, Fraction]
    """Law of the pair at row 0 of a sequence."""
    step: dict[tuple[AgentState, Action], AgentState]
    drift: dict[Exogenous, Distribution]
    emission: dict[JointState, Distribution]
    policy: dict[AgentState, Distribution]

    def __post_init__(self) -> None:
        reached = self.reachable()
        for kind, names, found in (
            ("state", self.states, {s for s, _ in reached}),
            ("exogenous state", self.exogenous, {xi for _, xi in reached}),
        ):
            if lost := [name for name in names if name not in found]:
                raise UserError(
                    f"world {self.name!r}: {kind} {lost[0]} is unreachable: drop it, or lead to it from the initial law"
                )

    @property
    def symbols(self) -> tuple[Symbol, ...]:
        """Every observation that can be emitted, in a fixed order."""
        return tuple(dict.fromkeys(o for row in self.emission.values() for o in row))

    def reachable(self) -> set[JointState]:
        """Pairs that some sequence visits."""
        found, todo = set(self.initial), list(self.initial)
        while todo:
            state, noise = todo.pop()
            after = {(self.step[state, a], other) for a in self.policy[state] for other in self.drift[noise]}
            todo += after - found
            found |= after
        return found


def finite_world(
    name: str,
    states: Iterable[AgentState],
    exogenous: Iterable[Exogenous],
    actions: Iterable[Action],
    step: Callable[[Any, Any], AgentState],
    drift: Callable[[Any], Mapping[Exogenous, Any]],
    emit: Callable[[Any, Any], Mapping[Symbol, Any]],
    policy: Callable[[Any, Any], Mapping[Action, Any]] | None = None,
    initial: Mapping[JointState, Any] | None = None,
) -> World:
    """Tabulate and check a world; raises UserError if it is not a world as the module describes.

    Args:
        name: how messages and tables call it.
        states: agent-centric states.
        exogenous: exogenous states.
        actions: actions.
        step: next agent-centric state of (s, a).
        drift: law of the next exogenous state.
        emit: law of the observation of (s, xi).
        policy: law of the action at (s, xi), which must not depend on xi; uniform by default.
        initial: law of the first pair; uniform by default.
    """
    states, exogenous, actions = tuple(states), tuple(exogenous), tuple(actions)
    if not (states and exogenous and actions):
        raise UserError(f"world {name!r}: needs at least one state, one exogenous state and one action")
    pairs = [(s, xi) for s in states for xi in exogenous]
    choose = policy or (lambda s, xi: uniform(actions))
    rows = {s: [_law(name, f"policy({s}, {xi})", choose(s, xi), actions) for xi in exogenous] for s in states}
    for s, found in rows.items():
        if differ := [xi for xi, row in zip(exogenous, found, strict=True) if row != found[0]]:
            raise UserError(
                f"world {name!r}: the policy reads the exogenous part (at state {s} it differs between "
                f"{exogenous[0]} and {differ[0]}): make it depend on the agent-centric state alone"
            )
    return World(
        name,
        states,
        exogenous,
        actions,
        _law(name, "initial", uniform(pairs) if initial is None else initial, pairs),
        {(s, a): next(iter(_law(name, f"step({s}, {a})", {step(s, a): 1}, states))) for s in states for a in actions},
        {xi: _law(name, f"drift({xi})", drift(xi), exogenous) for xi in exogenous},
        {(s, xi): _law(name, f"emit({s}, {xi})", emit(s, xi)) for s, xi in pairs},
        {s: row[0] for s, row in rows.items()},
    )


def uniform(items: Iterable[Any]) -> Distribution:
    """The uniform law on some items."""
    items = tuple(items)
    return {item: Fraction(1, len(items)) for item in items}


def _law(name: str, where: str, row: Mapping[Any, Any], allowed: Iterable[Any] | None = None) -> Distribution:
    """A row of probabilities as fractions, without zeros."""
    law: Distribution = {}
    for key, value in row.items():
        try:
            law[key] = Fraction("" if isinstance(value, float) else value)
        except (TypeError, ValueError, ZeroDivisionError):
            raise UserError(
                f"world {name!r}: {where} holds {value!r}: write probabilities as Fraction, int or '1/3', not float"
            ) from None
    if any(p < 0 for p in law.values()):
        raise UserError(f"world {name!r}: {where} has a negative probability: every entry must be 0 or more")
    if sum(law.values()) != 1:
        raise UserError(f"world {name!r}: {where} sums to {sum(law.values())}, not to 1: correct that row")
    if allowed is not None and (wrong := [key for key in law if key not in set(allowed)]):
        raise UserError(
            f"world {name!r}: {where} gives {wrong[0]!r}, which is not declared: add it or correct the entry"
        )
    return {key: p for key, p in law.items() if p}


def distances(world: World, start: AgentState) -> dict[AgentState, int]:
    """Fewest actions from a state to every state that can be reached from it."""
    found, level = {start: 0}, [start]
    while level:
        depth = found[level[0]] + 1
        after = [world.step[s, a] for s in level for a in world.actions]
        level = list(dict.fromkeys(s for s in after if s not in found))
        found |= dict.fromkeys(level, depth)
    return found


def diameter(world: World) -> int | None:
    """Longest shortest path between two states; None if some state cannot be reached from another."""
    tables = [distances(world, s) for s in world.states]
    if any(len(table) < len(world.states) for table in tables):
        return None
    return max(max(table.values()) for table in tables)


def period(world: World) -> int:
    """Greatest common divisor of the lengths of all cycles through the first state: 1 if it is aperiodic."""
    depth = distances(world, world.states[0])
    back = [depth[s] + 1 - depth[world.step[s, a]] for s in depth for a in world.actions]
    return gcd(*back)


Couple = tuple[JointState, JointState]
"""Two pairs (s, xi) that what is seen does not tell apart. Each further row can only remove couples, and once a row
removes none, no later one does: so the search for a memory needs no bound, and None is proven."""


def past_memory(world: World, actions: bool) -> int | None:
    """Smallest m at which o_{t-m}..o_t (with a_{t-m}..a_{t-1}) always tells s_t; None if no m does."""
    alike = _alike(world)
    return _rows_needed(alike, alike, lambda left: {after for c in left for after in _next(world, c, actions)} & alike)


def future_memory(world: World, actions: bool, literal: bool = False) -> int | None:
    """Smallest n at which the future from row t on always tells s_t; None if no n does.

    The future is o_t..o_{t+n}, with actions a_t..a_{t+n}; read literally, each row carries the action before it:
    a_{t-1}..a_{t+n-1}, at every t that has an action before it.
    """
    couples = _alike(world)
    if literal:
        pairs = world.reachable()
        judged = {after for c in product(pairs, pairs) for after in _next(world, c, actions)}
    else:
        judged = couples = {c for c in couples if any(_next(world, c, actions))}
    return _rows_needed(
        couples, judged, lambda left: {c for c in left if any(after in left for after in _next(world, c, actions))}
    )


def _rows_needed(
    couples: set[Couple], judged: set[Couple], with_one_more: Callable[[set[Couple]], set[Couple]]
) -> int | None:
    """How many further rows leave no couple of two states among those judged."""
    rows = 0
    while any(one != other for (one, _), (other, _) in couples & judged):
        fewer = with_one_more(couples)
        if fewer == couples:
            return None
        couples, rows = fewer, rows + 1
    return rows


def _alike(world: World) -> set[Couple]:
    """Reachable couples that can show the same symbol."""
    pairs = world.reachable()
    return {(one, other) for one in pairs for other in pairs if world.emission[one].keys() & world.emission[other]}


def _next(world: World, couple: Couple, actions: bool) -> Iterator[Couple]:
    """Couples that may follow a couple: after the same action where actions are seen."""
    (one, here), (other, there) = couple
    for a, b in product(world.policy[one], world.policy[other]):
        if a == b or not actions:
            for after in product(world.drift[here], world.drift[there]):
                yield (world.step[one, a], after[0]), (world.step[other, b], after[1])


BLANK = "blank"
"""Observation that shows nothing."""
HALF = Fraction(1, 2)


def counterexample(actions: tuple[int, int] = (-1, 1), every: int = 4) -> World:
    """The paper's own, against forward jumps (section 3.2 and appendix).

    s = (s^A, s^B): s^A in Z_4 moves by the action, s^B is the last action. A counter c runs by itself and the state
    is shown when c = 0 alone.

    Args:
        actions: (-1, 1) as in the appendix, or (0, 1) as in the main text.
        every: the counter's period: the state is shown every so many rows.
    """
    return finite_world(
        "counterexample",
        states=[(x, b) for x in range(4) for b in actions],
        exogenous=range(every),
        actions=actions,
        step=lambda s, a: ((s[0] + a) % 4, a),
        drift=lambda c: {(c + 1) % every: 1},
        emit=lambda s, c: {s if c == 0 else BLANK: 1},
    )


def echo() -> World:
    """A world that observations alone decode, before and after: an action moves by one at once, by two a step later.

    s = (x, b): x in Z_4, b the last action in {0, 1}, x' = x + 2b + a, and o = x. Two observations in a row tell b and
    a, whether they are the last two (m = 1) or the next two (n = 1).
    """
    return finite_world(
        "echo",
        states=[(x, b) for x in range(4) for b in (0, 1)],
        exogenous=["-"],
        actions=(0, 1),
        step=lambda s, a: ((s[0] + 2 * s[1] + a) % 4, a),
        drift=lambda xi: {xi: 1},
        emit=lambda s, xi: {s[0]: 1},
    )


def momentum() -> World:
    """A position that is shown and a velocity that is not: the future decodes it only if actions are known.

    s = (x, v): x and v in Z_3; an action a in {0, 1} changes v' = v + a, then x' = x + v', and o = x. From the past,
    v = x_t - x_{t-1} (m = 1); from the future, v = x_{t+1} - x_t - a_t (n = 1, with actions).
    """
    return finite_world(
        "momentum",
        states=[(x, v) for x in range(3) for v in range(3)],
        exogenous=["-"],
        actions=(0, 1),
        step=lambda s, a: ((s[0] + s[1] + a) % 3, (s[1] + a) % 3),
        drift=lambda xi: {xi: 1},
        emit=lambda s, xi: {s[0]: 1},
    )


TINY: dict[str, list[tuple[int, int, Symbol]]] = {
    "idle": [(0, 0, BLANK)],  # actions do nothing, and nothing is seen
    "switch": [(0, 1, 0), (0, 1, 1)],  # the state is the last action, and is shown
    "hidden switch": [(0, 1, BLANK), (0, 1, BLANK)],  # the state is the last action; nothing is seen
    "toggle": [(0, 1, 0), (1, 0, 1)],  # action 1 changes sides, action 0 stays; the side is shown
    "alternator": [(1, 1, 0), (0, 0, 1)],  # both actions change sides; the side is shown
    # action 1 climbs a step, action 0 falls to the ground, and from the top one falls; only the ground is shown
    "ladder": [(0, 1, "ground"), (0, 2, BLANK), (0, 0, BLANK)],
}
"""Worlds without an exogenous part: for each state the ones after actions 0 and 1, and what it shows."""


def tiny(name: str) -> World:
    """A world of TINY."""
    rows = TINY[name]
    return finite_world(
        name,
        states=range(len(rows)),
        exogenous=["-"],
        actions=(0, 1),
        step=lambda s, a: rows[s][a],
        drift=lambda xi: {xi: 1},
        emit=lambda s, xi: {rows[s][2]: 1},
    )


def flicker() -> World:
    """The state is the last action; it is shown in every second row, when a light is on."""
    return finite_world(
        "flicker",
        states=[0, 1],
        exogenous=["dark", "light"],
        actions=(0, 1),
        step=lambda s, a: a,
        drift=lambda xi: {"light" if xi == "dark" else "dark": 1},
        emit=lambda s, xi: {s if xi == "light" else BLANK: 1},
    )


WORLDS = {"counterexample": counterexample, "echo": echo, "momentum": momentum}


def noisy(world: World) -> World:
    """The world with a lamp, shown beside every observation, that goes on at a random time."""
    lamp: dict[Exogenous, Distribution] = {"dark": {"dark": HALF, "light": HALF}, "light": {"light": Fraction(1)}}
    return replace(
        world,
        name=f"{world.name}, noise",
        exogenous=tuple((xi, e) for xi in world.exogenous for e in lamp),
        initial={(s, (xi, e)): p * HALF for (s, xi), p in world.initial.items() for e in lamp},
        drift={
            (xi, e): {(a, b): p * q for a, p in row.items() for b, q in lamp[e].items()}
            for xi, row in world.drift.items()
            for e in lamp
        },
        emission={
            (s, (xi, e)): {(o, e): p for o, p in row.items()} for (s, xi), row in world.emission.items() for e in lamp
        },
    )


def biased(world: World) -> World:
    """The world under a policy that depends on the state: state i takes action i (mod their number) more often."""
    count = len(world.actions)
    policy = {
        s: {a: Fraction(1 + (j == i % count), count + 1) for j, a in enumerate(world.actions)}
        for i, s in enumerate(world.states)
    }
    return replace(world, name=f"{world.name}, state-dependent policy", policy=policy)


def variants(world: World) -> dict[tuple[bool, bool], World]:
    """The world with (noise, state-dependent policy) off and on."""
    shown = noisy(world)
    return {(False, False): world, (True, False): shown, (False, True): biased(world), (True, True): biased(shown)}

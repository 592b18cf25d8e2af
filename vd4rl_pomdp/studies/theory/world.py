"""Finite agent-centric FM-POMDPs (Wu et al., arXiv 2404.14552, section 2) in exact arithmetic.

A world has agent-centric states s with deterministic dynamics, an exogenous chain xi independent of actions, an
emission of the pair, and a policy that depends on s only:

    row      0                1                2
    pair     (s_0, xi_0) ---> (s_1, xi_1) ---> (s_2, xi_2)       s_{t+1} = step(s_t, a_t),  xi_{t+1} ~ drift(xi_t)
    seen     o_0              o_1              o_2               o_t ~ emit(s_t, xi_t)
    action          a_0              a_1              a_2        a_t ~ policy(s_t)

Probabilities are fractions; `law` computes exact joint distributions of sequences. This module also computes how much
past or future determines a state, and defines the worlds on which the paper's claims are checked: three with variants,
and seven very small ones.
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
    """A validated finite world; build it with `finite_world`. Worlds compare by identity."""

    name: str
    states: tuple[AgentState, ...]
    exogenous: tuple[Exogenous, ...]
    actions: tuple[Action, ...]
    initial: dict[JointState, Fraction]
    """Distribution of the pair at row 0."""
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
                    f"world {self.name!r}: {kind} {lost[0]} is unreachable from the initial law: drop or connect it"
                )

    @property
    def symbols(self) -> tuple[Symbol, ...]:
        """All observations that can be emitted, in a fixed order."""
        return tuple(dict.fromkeys(o for row in self.emission.values() for o in row))

    def reachable(self) -> set[JointState]:
        """Pairs (s, xi) that occur in some sequence."""
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
    """Tabulate and validate a world (see the module); UserError if it is invalid.

    Args:
        name: name for messages and tables.
        states: agent-centric states.
        exogenous: exogenous states.
        actions: actions.
        step: next agent-centric state of (s, a).
        drift: distribution of the next exogenous state.
        emit: distribution of the observation of (s, xi).
        policy: distribution of the action at (s, xi), which must not depend on xi; uniform by default.
        initial: distribution of the first pair; uniform by default.
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
                f"{exogenous[0]} and {differ[0]}): make it depend only on the agent-centric state"
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
    """The uniform distribution over some items."""
    items = tuple(items)
    return {item: Fraction(1, len(items)) for item in items}


def _law(name: str, where: str, row: Mapping[Any, Any], allowed: Iterable[Any] | None = None) -> Distribution:
    """A distribution as fractions, without zeros."""
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
    """Shortest path lengths from a state to all reachable states."""
    found, level = {start: 0}, [start]
    while level:
        depth = found[level[0]] + 1
        after = [world.step[s, a] for s in level for a in world.actions]
        level = list(dict.fromkeys(s for s in after if s not in found))
        found |= dict.fromkeys(level, depth)
    return found


def diameter(world: World) -> int | None:
    """Longest shortest path between two states; None unless every state can be reached from every other."""
    tables = [distances(world, s) for s in world.states]
    if any(len(table) < len(world.states) for table in tables):
        return None
    return max(max(table.values()) for table in tables)


def period(world: World) -> int:
    """Greatest common divisor of the lengths of all cycles through the first state; 1 if the world is aperiodic."""
    depth = distances(world, world.states[0])
    back = [depth[s] + 1 - depth[world.step[s, a]] for s in depth for a in world.actions]
    return gcd(*back)


Couple = tuple[JointState, JointState]
"""Two pairs (s, xi) with the same observations so far. More rows can only remove couples, and once a row removes none,
no later one does. So the search for a memory length terminates without a bound, and None is proven.
"""


def past_memory(world: World, actions: bool) -> int | None:
    """Smallest m such that o_{t-m}..o_t (with a_{t-m}..a_{t-1}) determines s_t; None if there is none."""
    alike = _alike(world)
    return _rows_needed(alike, alike, lambda left: {after for c in left for after in _next(world, c, actions)} & alike)


def future_memory(world: World, actions: bool, literal: bool = False) -> int | None:
    """Smallest n such that the future from row t on determines s_t; None if there is none.

    The future is o_t..o_{t+n}, with actions a_t..a_{t+n}; read literally, each row contains the action before it:
    a_{t-1}..a_{t+n-1}, for every t that has one.
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
    """Number of further rows until no couple among those judged has two different states."""
    rows = 0
    while any(one != other for (one, _), (other, _) in couples & judged):
        fewer = with_one_more(couples)
        if fewer == couples:
            return None
        couples, rows = fewer, rows + 1
    return rows


def _alike(world: World) -> set[Couple]:
    """Couples of reachable pairs that can emit the same symbol."""
    pairs = world.reachable()
    return {(one, other) for one in pairs for other in pairs if world.emission[one].keys() & world.emission[other]}


def _next(world: World, couple: Couple, actions: bool) -> Iterator[Couple]:
    """Successors of a couple; if actions are observed, under equal actions."""
    (one, here), (other, there) = couple
    for a, b in product(world.policy[one], world.policy[other]):
        if a == b or not actions:
            for after in product(world.drift[here], world.drift[there]):
                yield (world.step[one, a], after[0]), (world.step[other, b], after[1])


BLANK = "blank"
"""Uninformative observation."""
HALF = Fraction(1, 2)


def counterexample(actions: tuple[int, int] = (-1, 1), every: int = 4) -> World:
    """The paper's counterexample to forward jumps (section 3.2 and appendix).

    s = (s^A, s^B): s^A in Z_4 moves by the action, s^B is the last action. The exogenous state is a counter c, and the
    state is observed only when c = 0.

    Args:
        actions: (-1, 1) as in the appendix, or (0, 1) as in the main text.
        every: period of the counter.
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
    """A world that past or future observations alone decode: an action moves by one now, and by two a step later.

    s = (x, b): x in Z_4, b the last action in {0, 1}, x' = x + 2b + a, and o = x. Two consecutive observations
    determine b and a, both the last two (m = 1) and the next two (n = 1).
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
    """Observed position and hidden velocity: the future decodes the velocity only with actions.

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
    "idle": [(0, 0, BLANK)],  # actions have no effect; observations are blank
    "switch": [(0, 1, 0), (0, 1, 1)],  # the state is the last action, and is observed
    "hidden switch": [(0, 1, BLANK), (0, 1, BLANK)],  # the state is the last action; observations are blank
    "toggle": [(0, 1, 0), (1, 0, 1)],  # action 1 switches sides, action 0 stays; the side is observed
    "alternator": [(1, 1, 0), (0, 0, 1)],  # both actions switch sides; the side is observed
    # action 1 climbs one step, action 0 and the top step lead to the ground; only the ground is observed
    "ladder": [(0, 1, "ground"), (0, 2, BLANK), (0, 0, BLANK)],
}
"""Worlds without exogenous states: for each state the next ones after actions 0 and 1, and its observation."""


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
    """The state is the last action, observed in every second row, when a light is on."""
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
    """The world with a lamp, appended to every observation, that turns on at a random time."""
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
    """The world with a state-dependent policy: state i takes action i (mod their number) more often."""
    count = len(world.actions)
    policy = {
        s: {a: Fraction(1 + (j == i % count), count + 1) for j, a in enumerate(world.actions)}
        for i, s in enumerate(world.states)
    }
    return replace(world, name=f"{world.name}, state-dependent policy", policy=policy)


def variants(world: World) -> dict[tuple[bool, bool], World]:
    """The world with (noise, state-dependent policy) off and on."""
    with_noise = noisy(world)
    return {
        (False, False): world,
        (True, False): with_noise,
        (False, True): biased(world),
        (True, True): biased(with_noise),
    }

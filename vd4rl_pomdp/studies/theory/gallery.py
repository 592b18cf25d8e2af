"""Finite worlds on which the paper's claims are computed: three with variants, and seven very small ones."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction

from vd4rl_pomdp.studies.theory.world import (
    AgentState,
    Distribution,
    Exogenous,
    Symbol,
    World,
    finite_world,
    with_noise,
    with_policy,
)

BLANK = "blank"
"""Observation that shows nothing."""
HALF = Fraction(1, 2)
NOISE: dict[Exogenous, Distribution] = {"dark": {"dark": HALF, "light": HALF}, "light": {"light": Fraction(1)}}
"""A lamp, shown beside the observation, that goes on at a random time."""


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


def idle() -> World:
    """Actions do nothing, and nothing is seen."""
    return _tiny("idle", {0: (0, 0)}, {0: BLANK})


def switch() -> World:
    """The state is the last action, and is shown."""
    return _tiny("switch", {0: (0, 1), 1: (0, 1)}, {0: 0, 1: 1})


def hidden_switch() -> World:
    """The state is the last action; nothing is seen."""
    return _tiny("hidden switch", {0: (0, 1), 1: (0, 1)}, {0: BLANK, 1: BLANK})


def toggle() -> World:
    """Action 1 changes sides, action 0 stays; the side is shown."""
    return _tiny("toggle", {0: (0, 1), 1: (1, 0)}, {0: 0, 1: 1})


def alternator() -> World:
    """Both actions change sides; the side is shown."""
    return _tiny("alternator", {0: (1, 1), 1: (0, 0)}, {0: 0, 1: 1})


def ladder() -> World:
    """Action 1 climbs a step, action 0 falls to the ground, and from the top one falls; only the ground is shown."""
    return _tiny("ladder", {0: (0, 1), 1: (0, 2), 2: (0, 0)}, {0: "ground", 1: BLANK, 2: BLANK})


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


def _tiny(name: str, after: Mapping[int, tuple[int, int]], shown: Mapping[int, Symbol]) -> World:
    """A world without an exogenous part: the states after actions 0 and 1, and what each state shows."""
    return finite_world(
        name,
        states=list(after),
        exogenous=["-"],
        actions=(0, 1),
        step=lambda s, a: after[s][a],
        drift=lambda xi: {xi: 1},
        emit=lambda s, xi: {shown[s]: 1},
    )


def biased(world: World) -> World:
    """The world under a policy that depends on the state: state i takes action i (mod their number) more often."""
    count = len(world.actions)

    def policy(state: AgentState) -> dict:
        liked = world.states.index(state) % count
        return {a: Fraction(2 if i == liked else 1, count + 1) for i, a in enumerate(world.actions)}

    return with_policy(world, "state-dependent policy", policy)


WORLDS = {"counterexample": counterexample, "echo": echo, "momentum": momentum}


def variants(world: World) -> dict[tuple[bool, bool], World]:
    """The world with (noise, state-dependent policy) off and on."""
    noisy = with_noise(world, "noise", NOISE)
    return {(False, False): world, (True, False): noisy, (False, True): biased(world), (True, True): biased(noisy)}

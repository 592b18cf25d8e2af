"""Very small worlds: a few with names, on which claims of the paper fail, and all there are, to find no smaller one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from typing import Any

from vd4rl_pomdp.studies.theory.gallery import BLANK
from vd4rl_pomdp.studies.theory.world import (
    AgentState,
    Exogenous,
    JointState,
    Symbol,
    World,
    diameter,
    finite_world,
    uniform,
)

ACTIONS = (0, 1)
Size = tuple[int, int]
"""Numbers of agent-centric and of exogenous states."""
SIZES: tuple[Size, ...] = ((1, 1), (2, 1), (1, 2), (3, 1), (1, 3), (2, 2))
"""Sizes that are searched, fewer pairs (s, xi) first, and of as many pairs those with fewer exogenous states."""
FAMILY = (
    "two actions, the policy uniform; every state can be reached from every other; the exogenous part runs in a circle "
    "or is drawn anew in every row; a pair (s, xi) always shows the same"
)
"""What the worlds of `small_worlds` have in common."""


def idle() -> World:
    """Actions do nothing, and nothing is seen."""
    return _world("idle", [0], {0: (0, 0)}, {0: BLANK})


def switch() -> World:
    """The state is the last action, and is shown."""
    return _world("switch", [0, 1], {0: (0, 1), 1: (0, 1)}, {0: 0, 1: 1})


def hidden_switch() -> World:
    """The state is the last action; nothing is seen."""
    return _world("hidden switch", [0, 1], {0: (0, 1), 1: (0, 1)}, {0: BLANK, 1: BLANK})


def toggle() -> World:
    """Action 1 changes sides, action 0 stays; the side is shown."""
    return _world("toggle", [0, 1], {0: (0, 1), 1: (1, 0)}, {0: 0, 1: 1})


def alternator() -> World:
    """Both actions change sides; the side is shown."""
    return _world("alternator", [0, 1], {0: (1, 1), 1: (0, 0)}, {0: 0, 1: 1})


def ladder() -> World:
    """Action 1 climbs a step, action 0 falls to the ground, and from the top one falls; only the ground is shown."""
    return _world("ladder", [0, 1, 2], {0: (0, 1), 1: (0, 2), 2: (0, 0)}, {0: "ground", 1: BLANK, 2: BLANK})


def flicker() -> World:
    """The state is the last action; it is shown in every second row, when a light is on."""
    return finite_world(
        "flicker",
        states=[0, 1],
        exogenous=["dark", "light"],
        actions=ACTIONS,
        step=lambda s, a: a,
        drift=lambda xi: {"light" if xi == "dark" else "dark": 1},
        emit=lambda s, xi: {s if xi == "light" else BLANK: 1},
    )


def _world(name: str, states: Sequence[int], after: Mapping[int, Sequence[int]], shown: Mapping[int, Symbol]) -> World:
    """A world without an exogenous part: the states after actions 0 and 1, and what each state shows."""
    return finite_world(
        name,
        states,
        ["-"],
        ACTIONS,
        step=lambda s, a: after[s][a],
        drift=lambda xi: {xi: 1},
        emit=lambda s, xi: {shown[s]: 1},
    )


def small_worlds(size: Size) -> Iterator[World]:
    """Every world of the family (`FAMILY`) of one size, up to the names of symbols."""
    states, noises = map(range, size)
    pairs = list(product(states, noises))
    for step, drift, shown in product(_dynamics(len(states)), _drifts(len(noises)), _partitions(len(pairs))):
        world = _tabulated(states, noises, step, drift, dict(zip(pairs, shown, strict=True)))
        if diameter(world) is not None:
            yield world


def smallest(contradicts: Callable[[World], Any]) -> World | None:
    """The first world of the family, size by size, on which a claim fails; None if there is none."""
    worlds = (world for size in SIZES for world in small_worlds(size))
    return next((world for world in worlds if contradicts(world) is not None), None)


def _tabulated(
    states: range,
    noises: range,
    step: dict[tuple[AgentState, int], AgentState],
    drift: dict[Exogenous, Sequence[Exogenous]],
    shown: dict[JointState, Symbol],
) -> World:
    return finite_world(
        "small",
        states,
        noises,
        ACTIONS,
        step=lambda s, a: step[s, a],
        drift=lambda xi: uniform(drift[xi]),
        emit=lambda s, xi: {shown[s, xi]: 1},
    )


def _dynamics(states: int) -> Iterator[dict[tuple[AgentState, int], AgentState]]:
    arrows = list(product(range(states), ACTIONS))
    for ends in product(range(states), repeat=len(arrows)):
        yield dict(zip(arrows, ends, strict=True))


def _drifts(noises: int) -> list[dict[Exogenous, Sequence[Exogenous]]]:
    circle: dict[Exogenous, Sequence[Exogenous]] = {xi: [(xi + 1) % noises] for xi in range(noises)}
    return [circle] if noises == 1 else [circle, dict.fromkeys(range(noises), range(noises))]


def _partitions(count: int) -> Iterator[tuple[int, ...]]:
    """All ways to group items: the group of each, groups numbered as they appear."""
    for groups in product(range(count), repeat=count):
        if list(dict.fromkeys(groups)) == list(range(max(groups) + 1)):
            yield groups

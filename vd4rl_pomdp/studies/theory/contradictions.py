"""What contradicts a claim of the paper: each function takes a world and returns numbers, or None if nothing does.

A world contradicts a claim only if it meets the assumptions under which the paper makes it. Window lengths m and n are
the least that decode.
"""

from __future__ import annotations

from itertools import combinations

from vd4rl_pomdp.runs.files import Row
from vd4rl_pomdp.studies.theory.classifiers import Clash, Memory, clash
from vd4rl_pomdp.studies.theory.counterexample import CLAIMED_NEEDED, CLAIMED_UNIFORM, first_actions, study
from vd4rl_pomdp.studies.theory.decodability import future_memory, past_memory
from vd4rl_pomdp.studies.theory.partition import Relation, discards_noise, forced_shares, relation, state_relation
from vd4rl_pomdp.studies.theory.views import VIEWS
from vd4rl_pomdp.studies.theory.world import AgentState, World, diameter

LONGEST = 3
"""Largest m and n that are computed; no world of `small.FAMILY` that decodes needs more."""
GAPS = 4
"""How many k are tried, from the first one that a claim is about."""


def forward_jump(world: World, method: str = "fj+a") -> Row | None:
    """A jump k > m at which FJ or FJ+A is not the multi-step inverse, although the past decodes."""
    m = past_memory(world, VIEWS[method].actions)
    if m is None or not 0 < m <= LONGEST:
        return None
    return _first_clash(world, method, Memory(m, 0), range(m + 1, m + 1 + GAPS))


def no_future(world: World) -> Row | None:
    """A world whose past decodes and whose future never does, unless its first item holds a_{t+k-1}."""
    memory = decoded(world, literal=True)
    if memory is None or future_memory(world, actions=True) is not None:
        return None
    return _first_clash(world, "mik+a", memory, range(1, 1 + GAPS))


def leaked_target(world: World) -> Row | None:
    """Decodable worlds where the literal MIK+A, at k = 1, is not the multi-step inverse."""
    return _literal(world, range(1, 2))


def leaked_mask(world: World) -> Row | None:
    """Decodable worlds where the literal MIK+A, at some k > 1, is not the multi-step inverse."""
    return _literal(world, range(2, 2 + GAPS))


def _literal(world: World, ks: range) -> Row | None:
    memory = decoded(world)
    return None if memory is None else _first_clash(world, "mik+a literal", memory, ks)


def merged_states(world: World) -> Row | None:
    """Decodable worlds where MIK+A's f need not separate two states that one encoder of both ends must separate."""
    memory = decoded(world)
    if memory is None or len(world.states) < 2 or confused(world):
        return None
    found = relation(world, VIEWS["mik+a"], memory, range(1, _reach(world) + 1))
    forced, pairs = always_apart(found)
    return None if forced == pairs else {"forced": forced, "pairs": pairs, "max_k": _reach(world)}


def merged_phases(world: World) -> Row | None:
    """Worlds where one encoder on true states may merge two, although it sees every k up to twice the diameter."""
    if not confused(world):
        return None
    codes = len(set(_on_states(world).coarsest().tolist()))
    return {"codes": codes, "states": len(world.states), "max_k": 2 * _reach(world)}


def needed_noise(world: World) -> Row | None:
    """Worlds whose past decodes, where what FJ+A predicts beyond m depends on the exogenous part of its past."""
    m = past_memory(world, actions=True)
    if len(world.exogenous) < 2 or m is None or not 0 < m <= LONGEST:
        return None
    for max_k in (m + 1, m + 2):
        if not discards_noise(relation(world, VIEWS["fj+a"], Memory(m, 0), range(1, max_k + 1))):
            return {"m": m, "k": max_k}
    return None


def useful_jumps(world: World) -> Row | None:
    """FJ+A on jumps k > m separates states that it may merge with k up to m."""
    m = past_memory(world, actions=True)
    assert m is not None
    near, far = (always_apart(relation(world, VIEWS["fj+a"], Memory(m, m), range(1, k + 1))) for k in (m, m + 2))
    if far[0] == near[0]:
        return None
    masked = always_apart(relation(world, VIEWS["mik+a literal"], Memory(m, m), range(1, m + 1)))
    return {"m": m, "max_k": m + 2, "near": near[0], "far": far[0], "masked": masked[0], "pairs": far[1]}


def idle_k(world: World) -> Row | None:
    """Some k that the paper counts as needed, at which the first action is as likely as the other for every pair."""
    found = study(world)
    idle = [k for k in CLAIMED_NEEDED if k in found["uniform_k"]]
    if not idle:
        return None
    return {"idle": idle, "pairs": len(first_actions(world, idle[0])), "informative": found["informative_k"]}


def never_idle(world: World) -> Row | None:
    """Some k that the paper calls useless, at which the first action is more likely than the other for some pair."""
    found = study(world)
    useful = [k for k in CLAIMED_UNIFORM if k not in found["uniform_k"]]
    return {"useful": useful, "diameter": found["diameter"], "examples": found["examples"]} if useful else None


def decoded(world: World, literal: bool = False) -> Memory | None:
    """The least m and n, with actions, if past and future decode."""
    m, n = past_memory(world, actions=True), future_memory(world, actions=True, literal=literal)
    return None if m is None or n is None or max(m, n) > LONGEST else Memory(m, n)


def confused(world: World) -> set[frozenset[AgentState]]:
    """Pairs of states that one encoder on true states may merge, at every k up to twice the diameter."""
    found = _on_states(world)
    apart = found.conflicts()
    return {
        frozenset((one, other))
        for one, other in combinations(world.states, 2)
        if not apart[found.histories[one,], found.histories[other,]]
    }


def _on_states(world: World) -> Relation:
    return state_relation(world, range(1, 2 * _reach(world) + 1))


def always_apart(found: Relation) -> tuple[int, int]:
    """Pairs of states all of whose histories every optimal representation separates, and all pairs."""
    shares = forced_shares(found).values()
    return sum(share == 1 for share in shares), len(shares)


def _reach(world: World) -> int:
    reach = diameter(world)
    assert reach is not None
    return max(1, reach)


def _first_clash(world: World, method: str, memory: Memory, ks: range) -> Row | None:
    for k in ks:
        found = clash(world, VIEWS[method], memory, k)
        if found is not None:
            return {"m": memory.m, "n": memory.n, "k": k} | _told(world, found)
    return None


def _told(world: World, found: Clash) -> Row:
    """A clash in JSON: the action whose two probabilities differ most, and what is seen, counted from row t."""
    gaps = [abs(p - q) for p, q in zip(found.exact, found.multi_step, strict=True)]
    place = gaps.index(max(gaps))
    return {
        "action": str(world.actions[place]),
        "exact": str(found.exact[place]),
        "printed": str(found.multi_step[place]),
        "s_t": str(found.states[0]),
        "s_t+k": str(found.states[1]),
        "seen": {f"{kind}_t{j - found.t:+d}".removesuffix("+0"): str(value) for (kind, j), value in found.seen.items()},
    }

"""What is left of the paper's claims on worlds that contradict them, checked on a world; see `facts`."""

from __future__ import annotations

from itertools import combinations

from vd4rl_pomdp.studies.theory.classifiers import Memory, clash, compare
from vd4rl_pomdp.studies.theory.contradictions import always_apart, confused, decoded
from vd4rl_pomdp.studies.theory.counterexample import CLAIMED_EXAMPLES, CLAIMED_UNIFORM, study
from vd4rl_pomdp.studies.theory.decodability import past_memory
from vd4rl_pomdp.studies.theory.law import joint_law
from vd4rl_pomdp.studies.theory.partition import discards_noise, relation
from vd4rl_pomdp.studies.theory.views import VIEWS
from vd4rl_pomdp.studies.theory.world import World, distances, period


def jumps_are_shorter(world: World) -> bool:
    """FJ+A is certain up to k = m, and never anything but the multi-step inverse of the gap k-m beyond."""
    m = _least_m(world)
    near = all(compare(world, VIEWS["fj+a"], Memory(m, 0), k).certain for k in range(1, m + 1))
    return near and all(is_shorter_gap(world, m, k) is not False for k in (m + 1, m + 2, m + 3))


def is_shorter_gap(world: World, m: int, k: int, actions: bool = True) -> bool | None:
    """Whether FJ+A (or FJ) at k > m is P(a_t | s_t, s_{t+k-m}); None where a view does not tell its state."""
    view, ends = VIEWS["fj+a" if actions else "fj"], [("s", m), ("s", k)]
    past, later = view.start(m, m), view.end(m, k, m, 0, m + k + 1)
    law = joint_law(world, {*past, *later, *ends, ("a", m)})
    if not (law.tells(past, ends[:1]) and law.tells(later, ends[1:])):
        return None
    return law.given(past | later, ("a", m)).agrees(law.given(ends, ("a", m)))


def near_jumps_merge(world: World) -> bool:
    """With k up to m, FJ+A tells no two states apart in all their histories."""
    m = _least_m(world)
    return always_apart(relation(world, VIEWS["fj+a"], Memory(m, m), range(1, m + 1)))[0] == 0


def near_jumps_discard(world: World) -> bool:
    """With k up to m, what FJ+A predicts does not depend on the exogenous part of its past."""
    m = _least_m(world)
    return discards_noise(relation(world, VIEWS["fj+a"], Memory(m, 0), range(1, m + 1)))


def masked_is_right(world: World) -> bool:
    """MIK+A, which never sees the masked actions, is the multi-step inverse."""
    return _is_right(world, "mik+a", decoded(world))


def literal_is_right(world: World) -> bool:
    """The literal MIK+A is the multi-step inverse."""
    return _is_right(world, "mik+a literal", decoded(world, literal=True))


def _is_right(world: World, method: str, memory: Memory | None) -> bool:
    return memory is not None and all(clash(world, VIEWS[method], memory, k) is None for k in (1, 2, 3))


def counts_are_right(world: World) -> bool:
    """The paper's numbers of the counterexample, but for its k = 3."""
    found = study(world)
    uniform = set(CLAIMED_UNIFORM) <= set(found["uniform_k"])
    return uniform and (found["examples"], found["diameter"], found["m_with_actions"]) == (CLAIMED_EXAMPLES, 3, 3)


def examples_are_as_many(world: World) -> bool:
    """The paper's number of examples."""
    return study(world)["examples"] == CLAIMED_EXAMPLES


def one_encoder_separates(world: World) -> bool:
    """One encoder on true states, at both ends, has to tell all of them apart."""
    return not confused(world)


def phases_are_whole(world: World) -> bool:
    """One encoder on true states has to tell apart those that can occur in the same row."""
    steps, turns = distances(world, world.states[0]), period(world)
    together = [frozenset(pair) for pair in combinations(world.states, 2) if not _apart(steps, pair) % turns]
    return confused(world).isdisjoint(together)


def _apart(steps: dict, pair: tuple) -> int:
    one, other = pair
    return steps[one] - steps[other]


def _least_m(world: World) -> int:
    m = past_memory(world, actions=True)
    assert m is not None
    return m

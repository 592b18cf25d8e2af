from dataclasses import replace

import pytest
from hypothesis import given, settings

from tests.studies.theory.random_worlds import worlds
from vd4rl_pomdp.studies.theory.law import joint_law
from vd4rl_pomdp.studies.theory.world import (
    biased,
    counterexample,
    diameter,
    echo,
    future_memory,
    momentum,
    noisy,
    past_memory,
    uniform,
)

LONGEST = 3


def tells(world, seen, row):
    """Whether `seen` determines the state at a row in all sequences from any initial state."""
    anywhere = replace(world, initial=uniform(world.reachable()))
    return joint_law(anywhere, [*seen, ("s", row)]).tells(seen, [("s", row)])


def past(length, actions):
    return [("o", j) for j in range(length + 1)] + [("a", j) for j in range(length if actions else 0)]


def future(length, actions):
    return [("o", j) for j in range(length + 1)] + [("a", j) for j in range(length + 1 if actions else 0)]


def literal(length):
    return [("o", j + 1) for j in range(length + 1)] + [("a", j) for j in range(length + 1)]


@settings(max_examples=12, deadline=None)
@given(worlds(most_states=3))
@pytest.mark.parametrize("actions", [True, False])
def test_memory_lengths_match_enumeration(actions, world):
    """Enumerating all sequences up to a length gives the same smallest memory, or none."""
    for memory, enough in (
        (past_memory(world, actions), lambda n: tells(world, past(n, actions), n)),
        (future_memory(world, actions), lambda n: tells(world, future(n, actions), 0)),
        (future_memory(world, actions=True, literal=True), lambda n: tells(world, literal(n), 1)),
    ):
        smallest = next((n for n in range(LONGEST) if enough(n)), None)
        assert smallest == (memory if memory is not None and memory < LONGEST else None)


def test_long_and_infinite_memories():
    assert past_memory(counterexample(every=12), actions=True) == 11
    assert past_memory(counterexample(every=12), actions=False) is None


def test_memory_lengths_of_the_gallery():
    assert [past_memory(w(), actions=True) for w in (counterexample, echo, momentum)] == [3, 1, 1]
    assert [past_memory(w(), actions=False) for w in (counterexample, echo, momentum)] == [None, 1, 1]
    assert [future_memory(w(), actions=True) for w in (counterexample, echo, momentum)] == [None, 1, 1]
    assert [future_memory(w(), actions=False) for w in (counterexample, echo, momentum)] == [None, 1, None]
    assert future_memory(counterexample(), actions=True, literal=True) == 3


def test_noise_and_policy_do_not_change_decodability():
    world = noisy(biased(momentum()))
    assert (past_memory(world, True), future_memory(world, True)) == (1, 1)
    assert diameter(world) == diameter(momentum()) == 4
    assert len(world.symbols) == 2 * len(momentum().symbols)

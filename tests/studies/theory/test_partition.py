from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings

from tests.studies.theory.random_worlds import worlds
from vd4rl_pomdp.studies.theory.classifiers import VIEWS, MemoryLengths
from vd4rl_pomdp.studies.theory.partition import forced_shares, relation, state_classes
from vd4rl_pomdp.studies.theory.world import biased, counterexample, echo

MEMORY = MemoryLengths(3, 3)


def classes(world, method, max_k):
    found = relation(world, VIEWS[method], MEMORY, range(1, max_k + 1))
    return state_classes(found, found.coarsest())


@settings(max_examples=20, deadline=None)
@given(worlds(most_states=3))
@pytest.mark.parametrize("method", ["fj", "fj+a", "mik+a"])
def test_coarsest_partition_factors_and_is_coarsest(method, world):
    found = relation(world, VIEWS[method], MemoryLengths(1, 1), (1, 2))
    blocks = found.coarsest()
    assert len(blocks) == len(found.histories)
    assert found.factors(blocks)
    for one, other in combinations(sorted(set(blocks.tolist())), 2):
        assert not found.factors(np.where(blocks == other, one, blocks))


@settings(max_examples=15, deadline=None)
@given(worlds(most_states=3))
@pytest.mark.parametrize("method", ["fj+a", "mik+a"])
def test_conflicts_are_pairs_that_cannot_merge(method, world):
    found = relation(world, VIEWS[method], MemoryLengths(1, 1), (1, 2))
    conflicts, apart = found.conflicts(), np.arange(len(found.histories))
    for one, other in list(combinations(apart, 2))[:60]:
        merged = found.factors(np.where(apart == other, one, apart))
        assert merged is not bool(conflicts[one, other])


def test_fj_merges_states_that_mik_a_separates():
    """Up to k = D = m = 3, FJ and FJ+A may discard s^A, but MIK+A must separate s^A = x from x+2.

    From k = m+1 on, FJ+A's later window begins after t, so that it cannot merge opposite states either.
    """
    world = counterexample()
    assert classes(world, "fj", 3) == [0] * 8
    assert classes(world, "fj+a", 3) == [0, 1] * 4
    assert classes(world, "fj+a", 5) == [0, 1, 0, 1, 2, 3, 2, 3]
    assert classes(world, "mik+a literal", 3) == [0, 0, 0, 0, 1, 1, 1, 1]
    opposite = {frozenset(((x, b), (x + 2, c))) for x in (0, 1) for b in (-1, 1) for c in (-1, 1)}
    shares = {
        name: forced_shares(relation(world, VIEWS[name], MEMORY, (1, 2, 3)))
        for name in ("fj+a", "mik+a", "mik+a literal")
    }
    assert {pair for pair, share in shares["mik+a literal"].items() if share == 1} == opposite
    assert {pair for pair, share in shares["mik+a"].items() if share > 0} == opposite
    assert max(shares["fj+a"].values()) < 1


def test_past_encoder_may_merge_equivalent_states():
    """echo: (0, 1) and (2, 0) have the same successors; f can merge them under a policy that treats them alike."""
    world, ks = echo(), range(1, 5)
    even = forced_shares(relation(world, VIEWS["mik+a"], MemoryLengths(1, 1), ks))
    assert {pair for pair, share in even.items() if share == 0} == {
        frozenset(((x, b), ((x + 2) % 4, 1 - b))) for x in range(4) for b in (0, 1)
    }
    partial = forced_shares(relation(biased(world), VIEWS["mik+a"], MemoryLengths(1, 1), ks))
    assert set(partial.values()) == {1}

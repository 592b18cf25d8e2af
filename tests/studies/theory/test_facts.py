"""Statements of the paper that enumeration contradicts, with numbers by hand, and the weaker claims that hold."""

from fractions import Fraction
from itertools import combinations, product

import pytest
from hypothesis import HealthCheck, assume, given, settings

from tests.studies.theory.random_worlds import worlds
from vd4rl_pomdp.studies.theory.classifiers import VIEWS, MemoryLengths, clash, compare
from vd4rl_pomdp.studies.theory.law import joint_law
from vd4rl_pomdp.studies.theory.partition import state_relation
from vd4rl_pomdp.studies.theory.study import facts
from vd4rl_pomdp.studies.theory.world import counterexample, distances, echo, momentum, past_memory, period, tiny


def test_facts_have_computed_values():
    found = [(fact["world"], fact["claimed"], fact["computed"]) for fact in facts()]
    assert found == [
        ("ladder", "1/3", "1"),
        ("counterexample", "1/2", "1"),
        ("counterexample", "0", "12 of 28"),
        ("hidden switch", "1", "1/2"),
        ("counterexample", "1", "1/2"),
        ("counterexample", "some", "0 of 32"),
        ("counterexample", "4 to 10", "none"),
        ("counterexample", "3", "4"),
        ("idle", "1/2", "1"),
        ("toggle", "1/2", "1"),
        ("momentum", "1/2", "1"),
        ("switch", "1 of 1", "0 of 1"),
        ("echo", "28 of 28", "24 of 28"),
        ("alternator", "2", "1"),
        ("counterexample", "8", "4"),
        ("flicker", "at no k", "at k up to 2"),
        ("counterexample", "at no k", "at k up to 5"),
    ]


def test_ladder_counterexample():
    """(0, 0), (1, 0) and (1, 1) lead from the first step to the ground; only (0, 0) reaches it immediately."""
    for method in ("fj", "fj+a"):
        found = clash(tiny("ladder"), VIEWS[method], MemoryLengths(1, 0), 2)
        assert (found.action, found.exact, found.multi_step, found.states) == (0, 1, Fraction(1, 3), (1, 0))
    assert compare(tiny("ladder"), VIEWS["fj"], MemoryLengths(1, 0), 1).one_step, "up to m, as printed"


@pytest.mark.parametrize(
    ("method", "world", "m", "n"),
    [
        *(("mik+a", world, m, m) for world, m in ((tiny("idle"), 0), (tiny("toggle"), 0), (momentum(), 1))),
        *(("mik+a literal", world, *mn) for world, mn in ((tiny("hidden switch"), (1, 0)), (counterexample(), (3, 3)))),
    ],
)
def test_mik_a_has_no_clash_if_states_are_decodable(method, world, m, n):
    assert all(clash(world, VIEWS[method], MemoryLengths(m, n), k) is None for k in (1, 2, 3))


def merged(world, max_k):
    """Pairs of states that an encoder of true states may merge."""
    found = state_relation(world, range(1, max_k + 1))
    apart, number = found.conflicts(), found.histories
    return {frozenset(pair) for pair in combinations(world.states, 2) if not apart[number[pair[:1]], number[pair[1:]]]}


def test_state_encoder_merges_only_states_of_different_rows():
    assert not merged(tiny("switch"), 2)
    assert not merged(echo(), 8)
    assert merged(tiny("alternator"), 2) == {frozenset((0, 1))}
    world = counterexample()
    steps, turns = distances(world, world.states[0]), period(world)
    together = {frozenset((a, b)) for a, b in combinations(world.states, 2) if (steps[a] - steps[b]) % turns == 0}
    assert merged(world, 6).isdisjoint(together)


def bounded(view):
    """MIK+A's view with the paper's count of the future: n+1 observations and n actions."""
    last = max(j for kind, j in view if kind == "o")
    return view - {("a", last)}


@pytest.mark.parametrize("m", [0, 1, 3])
def test_fj_beyond_m_equals_mik_at_a_shorter_gap(m):
    for extra, names in product((1, 2, 4), (("fj+a", "mik+a"), ("fj", "mik"))):
        jump, masked = (VIEWS[name] for name in names)
        t, rows = m + 2, 30
        assert jump.visible(t, m + extra, m, 0, rows) == bounded(masked.visible(t, extra, m, m, rows))


def is_shorter_gap(world, m, k, actions=True):
    """Whether FJ+A (or FJ) at k > m is P(a_t | s_t, s_{t+k-m}); None if a view does not determine its state."""
    view, ends = VIEWS["fj+a" if actions else "fj"], [("s", m), ("s", k)]
    past, later = view.start(m, m), view.end(m, k, m, 0, m + k + 1)
    law = joint_law(world, {*past, *later, *ends, ("a", m)})
    if not (law.tells(past, ends[:1]) and law.tells(later, ends[1:])):
        return None
    return law.given(past | later, ("a", m)).agrees(law.given(ends, ("a", m)))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.filter_too_much])
@given(worlds(most_states=3))
@pytest.mark.parametrize("actions", [True, False])
def test_fj_beyond_m_is_the_inverse_of_the_shorter_gap(actions, world):
    m = past_memory(world, actions)
    assume(m is not None and m <= 2)
    found = [is_shorter_gap(world, m, k, actions) for k in (m + 1, m + 2)]
    assume(found != [None, None])
    assert False not in found


def test_shorter_gap_differs_from_the_printed_one():
    """If the later window determines its first state and the gap matters."""
    assert is_shorter_gap(echo(), 1, 3) is True
    assert clash(echo(), VIEWS["fj+a"], MemoryLengths(1, 1), 3) is not None
    assert is_shorter_gap(tiny("hidden switch"), 1, 2) is None

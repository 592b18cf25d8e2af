"""Each fact about the paper: its numbers, by hand where worlds are small enough, and that no smaller world shows it."""

from fractions import Fraction
from itertools import product

import pytest
from hypothesis import HealthCheck, assume, given, settings

from tests.studies.theory.random_worlds import worlds
from vd4rl_pomdp.studies.theory import contradictions, remainders
from vd4rl_pomdp.studies.theory.classifiers import Memory, clash, compare
from vd4rl_pomdp.studies.theory.counterexample import inverse_examples
from vd4rl_pomdp.studies.theory.decodability import future_memory, past_memory
from vd4rl_pomdp.studies.theory.facts import FACTS, explanation
from vd4rl_pomdp.studies.theory.gallery import counterexample, echo, momentum
from vd4rl_pomdp.studies.theory.small import (
    SIZES,
    alternator,
    flicker,
    hidden_switch,
    idle,
    ladder,
    small_worlds,
    smallest,
    switch,
    toggle,
)
from vd4rl_pomdp.studies.theory.views import VIEWS
from vd4rl_pomdp.studies.theory.world import distances

BY_NAME = {fact.name: fact for fact in FACTS}
SEARCHED = [fact for fact in FACTS if fact.searched]


def test_the_facts_are_these():
    assert list(BY_NAME) == [
        "reaches_back",
        "useful_jumps",
        "no_future",
        "idle_k",
        "main_text_actions",
        "leaked_target",
        "leaked_mask",
        "merged_states",
        "merged_phases",
        "needed_noise",
    ]
    assert [fact.name for fact in FACTS if not fact.searched] == ["useful_jumps", "idle_k", "main_text_actions"]


@pytest.mark.parametrize("fact", FACTS, ids=lambda fact: fact.name)
def test_a_fact_is_shown_by_each_of_its_worlds_and_the_rest_holds_there(fact):
    for make in fact.worlds:
        assert fact.contradicts(make()) is not None
        assert fact.holds_on(make())


def pairs(world):
    return len(world.states) * len(world.exogenous)


@pytest.mark.parametrize("fact", SEARCHED, ids=lambda fact: fact.name)
def test_no_smaller_world_shows_it(fact):
    named, found = fact.worlds[0](), smallest(fact.contradicts)
    assert found is not None
    assert (len(found.states), len(found.exogenous)) == (len(named.states), len(named.exogenous))
    assert all(pairs(make()) >= pairs(named) for make in fact.worlds)


@pytest.mark.parametrize("fact", SEARCHED, ids=lambda fact: fact.name)
def test_its_smallest_world_is_one_of_the_family(fact):
    """By name or, up to the names of symbols, by what it does."""

    def table(world):
        symbols = {o: number for number, o in enumerate(world.symbols)}
        s, x = ({name: i for i, name in enumerate(names)} for names in (world.states, world.exogenous))
        step = sorted((s[a], action, s[b]) for (a, action), b in world.step.items())
        drift = sorted((x[a], x[b], p) for a, row in world.drift.items() for b, p in row.items())
        shown = sorted((s[a], x[b], symbols[o]) for (a, b), row in world.emission.items() for o in row)
        return step, drift, shown

    named = fact.worlds[0]()
    size = len(named.states), len(named.exogenous)
    assert size in SIZES
    assert table(named) in [table(world) for world in small_worlds(size)]


def test_the_family_is_all_there_is():
    """By hand: of 16 maps of two states, 9 connect them; they show one thing or two, under one drift or two."""
    counts = {size: sum(1 for _ in small_worlds(size)) for size in SIZES}
    assert counts[1, 1] == 1
    assert counts[2, 1] == 9 * 2
    assert counts[1, 2] == 2 * 2
    assert counts[2, 2] == 9 * 2 * 15
    assert counts[1, 3] == 2 * 5
    assert counts[3, 1] == 5 * sum(1 for step in product(range(3), repeat=6) if connects(step))
    assert list(SIZES) == sorted(SIZES, key=lambda size: (size[0] * size[1], size[1]))


def test_no_window_of_the_family_is_too_long_to_be_computed():
    worlds = [world for size in SIZES for world in small_worlds(size)]
    for memory in (past_memory, future_memory):
        for actions in (True, False):
            assert max(memory(world, actions) or 0 for world in worlds) <= contradictions.LONGEST


def connects(step):
    """Whether, of three states, each leads to both others; state s goes to step[2s] and step[2s+1]."""
    near = [{step[2 * s], step[2 * s + 1]} for s in range(3)]
    return all(set().union(near[s], *(near[after] for after in near[s])) | {s} == {0, 1, 2} for s in range(3))


def told(found):
    return {key: found[key] for key in ("m", "n", "k", "action", "exact", "printed", "s_t", "s_t+k")}


def test_the_ladder():
    """From its first step (0, 0), (1, 0) and (1, 1) lead to the ground; if it is reached at once, only the first."""
    for method in ("fj", "fj+a"):
        found = contradictions.forward_jump(ladder(), method)
        expected = {"m": 1, "n": 0, "k": 2, "action": "0", "exact": "1", "printed": "1/3", "s_t": "1", "s_t+k": "0"}
        assert told(found) == expected
        assert found["seen"]["o_t+1"] == "ground"
    assert compare(ladder(), VIEWS["fj"], Memory(1, 0), 1).one_step, "up to m, as printed"


@pytest.mark.parametrize("method", ["fj", "fj+a"])
def test_neither_forward_jump_fails_on_a_smaller_world(method):
    found = smallest(lambda world: contradictions.forward_jump(world, method))
    assert (len(found.states), len(found.exogenous)) == (3, 1)


def test_the_literal_readings_on_one_and_two_states():
    assert told(contradictions.leaked_target(idle())) == told(
        {"m": 0, "n": 0, "k": 1, "action": "0", "exact": "1", "printed": "1/2", "s_t": "0", "s_t+k": "0"}
    )
    jump = clash(idle(), VIEWS["fj+a literal"], Memory(0, 0), 1)
    assert (jump.exact, jump.multi_step) == ((1, 0), (Fraction(1, 2), Fraction(1, 2)))
    mask = contradictions.leaked_mask(toggle())
    assert (mask["k"], mask["exact"], mask["printed"]) == (2, "1", "1/2")
    assert set(mask["seen"]) == {"o_t", "a_t+1", "o_t+2"}, "a_t is the rest of the parity"


def test_the_hidden_switch_tells_its_state_by_the_last_action_alone():
    found = contradictions.no_future(hidden_switch())
    assert (found["m"], found["k"], found["exact"], found["printed"]) == (1, 1, "1/2", "1")
    assert contradictions.no_future(switch()) is None, "its future decodes"


def test_what_may_be_merged():
    assert contradictions.merged_states(switch()) == {"forced": 0, "pairs": 1, "max_k": 1}
    assert contradictions.merged_states(echo()) == {"forced": 24, "pairs": 28, "max_k": 4}
    assert contradictions.merged_states(momentum()) is None
    assert contradictions.merged_phases(alternator()) == {"codes": 1, "states": 2, "max_k": 2}
    assert contradictions.merged_phases(counterexample()) == {"codes": 4, "states": 8, "max_k": 6}
    assert contradictions.merged_phases(toggle()) is None
    assert contradictions.merged_states(alternator()) is None, "another fact"


def test_jumps_and_noise():
    assert contradictions.needed_noise(flicker()) == {"m": 1, "k": 2}
    assert contradictions.needed_noise(counterexample()) == {"m": 3, "k": 5}
    assert contradictions.useful_jumps(counterexample()) == {
        "m": 3,
        "max_k": 5,
        "near": 0,
        "far": 12,
        "masked": 8,
        "pairs": 28,
    }


def test_the_two_sets_of_actions():
    assert contradictions.idle_k(counterexample()) == {"idle": [3], "pairs": 32, "informative": [1, 2]}
    assert contradictions.idle_k(counterexample((0, 1))) is None
    assert contradictions.never_idle(counterexample()) is None
    found = contradictions.never_idle(counterexample((0, 1)))
    assert found == {"useful": [4, 5, 6, 7, 8, 9, 10], "diameter": 4, "examples": 16368}


def test_why_the_first_action_is_uniform_from_k_3_on():
    """The paper turns all actions about, which keeps s^A at even k only; two flips, not of the last, always do."""
    for k in range(1, 7):
        plans = {(start, actions): end for start, actions, end in inverse_examples(counterexample(), k)}
        turned = [plans[s, tuple(-a for a in acts)][0] == end[0] for (s, acts), end in plans.items()]
        assert turned == [k % 2 == 0] * len(turned)
        if k > 2:
            assert all(plans[s, (-acts[0], -acts[1], *acts[2:])] == end for (s, acts), end in plans.items())


def test_what_no_claim_forbids_contradicts_nothing():
    assert contradictions.forward_jump(toggle()) is None, "m = 0: both windows are rows"
    assert contradictions.leaked_target(switch()) is None, "its states tell the action"
    assert contradictions.leaked_mask(switch()) is None, "its states record the last action"
    assert contradictions.needed_noise(ladder()) is None, "no exogenous part"
    assert clash(switch(), VIEWS["mik+a"], Memory(0, 0), 1) is None


def test_remainders_can_fail():
    assert not remainders.masked_is_right(hidden_switch())
    assert not remainders.literal_is_right(toggle())
    assert not remainders.one_encoder_separates(alternator())
    assert not remainders.counts_are_right(counterexample((0, 1)))
    assert not remainders.examples_are_as_many(toggle())
    assert not remainders.near_jumps_merge(hidden_switch()), "a recorder of actions has its states"


@pytest.mark.parametrize(
    ("row", "name"),
    [
        ({"claim": "discards", "method": "fj+a", "period": 2}, "needed_noise"),
        ({"claim": "complete", "method": "mik+a", "period": 1}, "merged_states"),
        ({"claim": "complete", "method": "mik+a literal", "period": 2}, "merged_phases"),
        ({"claim": "equation", "method": "mik+a literal", "period": 1}, "leaked_mask"),
        ({"claim": "correct", "method": "fj", "period": 1}, "reaches_back"),
    ],
)
def test_every_kind_of_disagreement_has_its_fact(row, name):
    assert explanation(row) == name
    assert name in BY_NAME


def bounded(view):
    """MIK+A as the paper counts its future: n actions beside n+1 observations, so without the last row's."""
    last = max(j for kind, j in view if kind == "o")
    return view - {("a", last)}


@pytest.mark.parametrize("m", [0, 1, 3])
def test_beyond_m_a_forward_jump_is_the_masked_objective_at_a_shorter_gap(m):
    for extra, names in product((1, 2, 4), (("fj+a", "mik+a"), ("fj", "mik"))):
        jump, masked = (VIEWS[name] for name in names)
        t, rows = m + 2, 30
        assert jump.visible(t, m + extra, m, 0, rows) == bounded(masked.visible(t, extra, m, m, rows))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.filter_too_much])
@given(worlds(most_states=3))
@pytest.mark.parametrize("actions", [True, False])
def test_a_forward_jump_is_the_multi_step_inverse_of_the_shorter_gap(actions, world):
    m = past_memory(world, actions)
    assume(m is not None and m <= 2)
    found = [remainders.is_shorter_gap(world, m, k, actions) for k in (m + 1, m + 2)]
    assume(found != [None, None])
    assert False not in found


def test_the_shorter_gap_is_told_from_the_printed_one():
    """Where the later window tells its first state, and the gap makes a difference."""
    assert remainders.is_shorter_gap(echo(), 1, 3) is True
    assert clash(echo(), VIEWS["fj+a"], Memory(1, 1), 3) is not None
    assert remainders.is_shorter_gap(hidden_switch(), 1, 2) is None


def test_the_literal_reading_is_right_where_states_record_the_last_action():
    seen = 0
    for world in (world for size in ((2, 1), (3, 1)) for world in small_worlds(size)):
        into = {state: {a for (_, a), after in world.step.items() if after == state} for state in world.states}
        if all(len(actions) == 1 for actions in into.values()) and contradictions.decoded(world):
            assert contradictions.leaked_target(world) is None
            assert contradictions.leaked_mask(world) is None
            seen += 1
    assert seen > 10


def test_distances_within_a_phase():
    """The counterexample's phases are even and odd s^A: four states each, and four codes."""
    steps = distances(counterexample(), (0, 1))
    assert {s[0] % 2 for s, d in steps.items() if d % 2 == 0} == {0}
    assert remainders.phases_are_whole(counterexample())

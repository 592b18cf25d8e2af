from fractions import Fraction
from itertools import product

import pytest
from hypothesis import given, settings

from tests.studies.theory.random_worlds import worlds
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.studies.theory.law import joint_law
from vd4rl_pomdp.studies.theory.world import counterexample, diameter, distances, finite_world, period, uniform

HALF = Fraction(1, 2)


def small(**changes):
    parts = {
        "states": [0, 1],
        "exogenous": ["dark", "light"],
        "actions": [0, 1],
        "step": lambda s, a: a,
        "drift": lambda xi: {"dark": HALF, "light": HALF},
        "emit": lambda s, xi: {s: 1},
    }
    return finite_world("small", **parts | changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"drift": lambda xi: {"dark": HALF}}, r"drift\(dark\) sums to 1/2, not to 1"),
        ({"emit": lambda s, xi: {s: Fraction(3, 2), "x": -HALF}}, r"emit\(0, dark\) has a negative probability"),
        ({"policy": lambda s, xi: {0: 1} if xi == "dark" else {1: 1}}, "the policy reads the exogenous part"),
        ({"policy": lambda s, xi: {0: 0.5, 1: 0.5}}, "not float"),
        ({"emit": lambda s, xi: {s: "all"}}, r"emit\(0, dark\) holds 'all': write probabilities as Fraction"),
        ({"step": lambda s, a: s + a}, r"step\(1, 1\) gives 2, which is not declared"),
        ({"states": [0, 1, 2], "initial": {(0, "dark"): 1}}, "state 2 is unreachable"),
        ({"actions": []}, "at least one state"),
    ],
)
def test_invalid_worlds_are_rejected(changes, message):
    with pytest.raises(UserError, match=message) as error:
        small(**changes)
    assert "small" in str(error.value)


def brute_force(world, rows):
    """The joint law of all variables in fractions, by enumerating sequences."""
    law = {}

    def extend(sequence, pair, p, row):
        s, xi = pair
        for o, a in product(world.emission[pair], world.policy[s]):
            q = p * world.emission[pair][o] * world.policy[s][a]
            longer = (*sequence, s, xi, o, a)
            if row == rows - 1:
                law[longer] = law.get(longer, 0) + q
                continue
            for other, r in world.drift[xi].items():
                extend(longer, (world.step[s, a], other), q * r, row + 1)

    for pair, p in world.initial.items():
        extend((), pair, p, 0)
    return law


def as_fractions(law):
    total = sum(law.counts.tolist())
    rows = law.values(law.variables, slice(None))
    return {row: Fraction(int(n), total) for row, n in zip(rows, law.counts.tolist(), strict=True)}


ALL = [(kind, j) for j in range(3) for kind in ("s", "xi", "o", "a")]


@settings(max_examples=25, deadline=None)
@given(worlds())
def test_joint_law_matches_brute_force(world):
    exact = brute_force(world, 3)
    assert sum(exact.values()) == 1
    assert as_fractions(joint_law(world, ALL)) == exact
    some = [("o", 0), ("a", 1), ("s", 2)]
    marginal = {}
    for key, p in exact.items():
        kept = tuple(key[ALL.index(v)] for v in some)
        marginal[kept] = marginal.get(kept, 0) + p
    assert as_fractions(joint_law(world, some)) == marginal


def test_large_denominators_stay_exact():
    p = Fraction(1, 2**40 + 1)
    world = small(policy=lambda s, xi: {0: p, 1: 1 - p})
    law = joint_law(world, ALL)
    assert law.counts.dtype == object
    assert as_fractions(law) == brute_force(world, 3)


def test_distances_diameter_and_period():
    world = counterexample()
    assert distances(world, (0, 1))[1, -1] == 3
    assert (diameter(world), period(world)) == (3, 2)
    assert (diameter(counterexample((0, 1))), period(counterexample((0, 1)))) == (4, 1)
    assert diameter(small(step=lambda s, a: s)) is None
    assert sum(uniform(range(7)).values()) == 1

"""Random finite FM-POMDPs for property tests."""

from fractions import Fraction

from hypothesis import strategies as st

from vd4rl_pomdp.studies.theory.world import finite_world


def law(draw, items, sparse=True):
    weights = draw(st.lists(st.integers(0 if sparse else 1, 3), min_size=len(items), max_size=len(items)))
    weights = weights if any(weights) else [1] * len(items)
    return {item: Fraction(w, sum(weights)) for item, w in zip(items, weights, strict=True)}


@st.composite
def worlds(draw, most_states=4):
    """Deterministic random dynamics, an exogenous chain of one or two states that observations may show, any policy."""
    states, actions = range(draw(st.integers(2, most_states))), range(2)
    noises = range(draw(st.integers(1, 2)))
    step = {(s, a): draw(st.sampled_from(states)) for s in states for a in actions}
    colour = {s: draw(st.sampled_from(states)) for s in states}
    shows_noise = draw(st.booleans())
    drift = {xi: law(draw, noises, sparse=False) for xi in noises}
    coin = law(draw, ("heads", "tails"))
    policy = {s: law(draw, actions, sparse=False) for s in states}
    return finite_world(
        "random",
        states,
        noises,
        actions,
        step=lambda s, a: step[s, a],
        drift=lambda xi: drift[xi],
        emit=lambda s, xi: {(colour[s], xi if shows_noise else 0, side): p for side, p in coin.items()},
        policy=lambda s, xi: policy[s],
    )

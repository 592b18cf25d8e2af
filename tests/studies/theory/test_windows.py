"""Exact windows are the sequences of a world, each once, with its probability."""

from fractions import Fraction

import pytest

from vd4rl_pomdp.studies.theory.windows import exact_windows
from vd4rl_pomdp.studies.theory.world import finite_world


def test_a_sequence_is_as_likely_as_its_actions():
    """A coin that shows heads three times in four decides whether to stay or to change sides."""
    world = finite_world(
        "coin",
        states=[0, 1],
        exogenous=["-"],
        actions=["stay", "change"],
        step=lambda s, a: s if a == "stay" else 1 - s,
        drift=lambda xi: {"-": 1},
        emit=lambda s, xi: {s: 1},
        policy=lambda s, xi: {"stay": Fraction(3, 4), "change": Fraction(1, 4)},
        initial={(0, "-"): 1},
    )
    exact = exact_windows(world, 3)
    assert len(exact.probability) == 8, "three actions, of two kinds each"
    changes = exact.windows.action[..., 1]
    for window, probability in enumerate(exact.probability.tolist()):
        expected = 0.75 ** (3 - int(changes[window].sum())) * 0.25 ** int(changes[window].sum())
        assert probability == pytest.approx(expected)
        sides = changes[window, :2].cumsum(0) % 2
        assert exact.state[window].tolist() == [0, *sides.int().tolist()]
        assert exact.windows.obs[window, :, 1, 0, 0].tolist() == [0, *(255 * sides).int().tolist()]

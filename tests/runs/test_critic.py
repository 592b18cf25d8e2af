"""The critic's summary of a training run, on given curves."""

import numpy as np
import pytest

from vd4rl_pomdp.runs.critic import critic_of


def rows(values: list[float], every: int = 500) -> list[dict[str, float]]:
    """Rows of metrics with the given `q`, and an evaluation at their end."""
    logged = [{"step": every * (i + 1), "q": value, "bc_loss": 0.1} for i, value in enumerate(values)]
    return [*logged, {"step": every * len(values), "eval/return/patch": 59.0}]


def test_critic_movement_is_the_relative_change_over_the_last_fifth():
    climbing = critic_of(rows([i + 1.0 for i in range(40)]), 20_000, 1.886, 0.99)
    assert climbing == {"value": 36.5, "moved": pytest.approx(8 / 36.5, abs=1e-6), "data": 188.6}, (
        "climbs by 8 in the last fifth"
    )
    late = critic_of(rows([i + 1.0 for i in range(32)] + [188.0] * 8), 20_000, 1.886, 0.99)
    assert late == {"value": 188.0, "moved": 0.0, "data": 188.6}, "only the last fifth counts"
    falling = critic_of(rows([-(i + 1.0) for i in range(40)]), 20_000, -1.0, 0.9)
    assert falling == {"value": -36.5, "moved": pytest.approx(8 / 36.5, abs=1e-6), "data": -10.0}, (
        "movement away from 0 is positive"
    )


def test_critic_slope_is_a_least_squares_fit():
    q = np.random.default_rng(0).normal(100, 5, 101)
    steps = [30 * (i + 1) for i in range(100)] + [3010]  # the last interval is shorter
    summary = critic_of([{"step": s, "q": v} for s, v in zip(steps, q, strict=True)], 3010, 1.0, 0.99)
    late = np.array(steps) > 0.8 * 3010
    slope = np.polyfit(np.array(steps)[late], q[late], 1)[0]
    assert summary["value"] == pytest.approx(q[late].mean(), abs=1e-4)
    assert summary["moved"] == pytest.approx(slope * 602 / q[late].mean(), abs=1e-6)


def test_unknown_critic_values_are_none():
    assert critic_of([{"step": 500, "bc_loss": 0.1}], 500, 1.0, None) == {}, "no critic"
    assert critic_of([], 500, 1.0, 0.99) == {}
    few = critic_of(rows([1.0] * 10), 5000, 1.0, 0.99)
    assert few == {"value": 1.0, "moved": None, "data": 100.0}, "two rows are too few for a slope"
    assert critic_of(rows([0.0] * 40), 20_000, None, 1.0) == {"value": 0.0, "moved": None, "data": None}

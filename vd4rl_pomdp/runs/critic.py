"""Whether a critic has converged: its mean value over the data, at the end of a training."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vd4rl_pomdp.runs.metrics import Metrics

VALUE = "q"
"""What algorithms with a critic call its mean value over a batch in their logs."""
TOLD = {"value", "moved", "data"}
"""What critic.json tells of an algorithm with a critic; of others nothing."""
CONVERGED = 0.02
"""A critic has converged if it moved by less than this share of its value over the last fifth of the updates."""
FEWEST = 3
"""Rows that a line is fitted to, at least: two would lie on it."""


def critic_of(
    rows: Sequence[Metrics], updates: int, mean_reward: float | None, gamma: float | None
) -> dict[str, float | None]:
    """What a trained run tells of its critic; empty for an algorithm without one, which logs no VALUE.

    Args:
        rows: of its metrics, VALUE a mean over the updates since the row before.
        updates: of the whole training.
        mean_reward: of the data, a decision.
        gamma: the critic's discount of a decision; None if the algorithm has no such option.

    Returns:
        `value`: mean of VALUE over the rows of the last fifth of the updates.
        `moved`: how far it moved over that fifth, as a share of `value`: the slope of the line through these rows by
            least squares, times a fifth of the updates, over `value`. None for fewer than FEWEST rows, or a value of 0.
        `data`: the data's own discounted return, mean_reward / (1 - gamma), which the value of their policy comes to
            in a task that does not end, whatever `n_step` is. None if it is not known.
    """
    told = [(row["step"], row[VALUE]) for row in rows if VALUE in row and row["step"] > updates - updates / 5]
    if not told:
        return {}
    steps, values = np.array(told, dtype=float).T
    value, moved, data = values.mean(), None, None
    if len(told) >= FEWEST and value:
        apart = steps - steps.mean()
        moved = float(round(apart @ values / (apart @ apart) * updates / 5 / value, 6))
    if mean_reward is not None and gamma is not None and gamma < 1:
        data = float(round(mean_reward / (1 - gamma), 4))
    return {"value": float(round(value, 4)), "moved": moved, "data": data}

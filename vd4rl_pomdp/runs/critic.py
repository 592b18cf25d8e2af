"""Whether a critic has converged, judged by its mean Q-value over the data at the end of training."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vd4rl_pomdp.runs.metrics import Metrics

VALUE = "q"  # name under which algorithms log the critic's mean value over a batch
KEYS = {"value", "moved", "data"}
"""Keys of critic.json for an algorithm with a critic; for others it is empty."""
CONVERGED = 0.02
"""A critic has converged if its value moved by less than this fraction over the last fifth of the updates."""
FEWEST = 3  # minimum number of rows for the line fit: two points always fit


def critic_of(
    rows: Sequence[Metrics], updates: int, mean_reward: float | None, gamma: float | None
) -> dict[str, float | None]:
    """Convergence summary of a run's critic; empty for an algorithm without one, which does not log VALUE.

    Args:
        rows: rows of metrics; VALUE is a mean over the updates since the previous row.
        updates: total updates of the training.
        mean_reward: mean reward per decision in the data.
        gamma: discount per decision; None if the algorithm has none.

    Returns:
        `value`: mean of VALUE over the rows of the last fifth of the updates.
        `moved`: relative drift over that fifth: least-squares slope over these rows, times a fifth of the updates,
            divided by `value`. None with fewer than FEWEST rows or a value of 0.
        `data`: discounted return of the data, mean_reward / (1 - gamma): the value of the behaviour policy in a
            task that never ends, for any `n_step`. None if unknown.
    """
    last = [(row["step"], row[VALUE]) for row in rows if VALUE in row and row["step"] > updates - updates / 5]
    if not last:
        return {}
    steps, values = np.array(last, dtype=float).T
    value, moved, data = values.mean(), None, None
    if len(last) >= FEWEST and value:
        apart = steps - steps.mean()
        moved = float(round(apart @ values / (apart @ apart) * updates / 5 / value, 6))
    if mean_reward is not None and gamma is not None and gamma < 1:
        data = float(round(mean_reward / (1 - gamma), 4))
    return {"value": float(round(value, 4)), "moved": moved, "data": data}

"""How far a policy is from the actor that made the data, on the data's own path."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from vd4rl_pomdp.core.tasks import TASKS, DMCTask
from vd4rl_pomdp.data import Dataset
from vd4rl_pomdp.envs.dmc import observed_states
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.policies.actor import Actor

EPISODES = 20
"""Episodes that the error is measured on, evenly spaced among those of a set that hold a decision."""


class DataPath:
    """A set's own episodes, as a policy sees them from their first rows on, and its actor's mean actions there."""

    def __init__(self, dataset: Dataset, actor: Actor, encode: Callable[[int], Tensor]) -> None:
        """Nothing is computed yet.

        Args:
            dataset: a set with simulator states.
            actor: what made it.
            encode: representations (rows, D) of the episode of a number.
        """
        self._dataset, self._actor, self._encode = dataset, actor, encode

    def action_error(self, policy: Policy) -> float:
        """Mean squared difference from the actor's mean action, over all decisions of 20 episodes at most."""
        rows = (self._dataset.episode_end - self._dataset.episode_start).cpu().numpy()
        deciding = np.flatnonzero(rows > 1)
        last = len(deciding) - 1
        numbers = deciding[np.unique(np.linspace(0, last, min(last + 1, EPISODES)).astype(int))]
        return float(np.concatenate([self._errors(policy, int(number)) for number in numbers]).mean())

    @torch.no_grad()
    def _errors(self, policy: Policy, number: int) -> np.ndarray:
        """(decisions,) mean squared differences in one episode, whose last row decides nothing."""
        dataset = self._dataset
        assert dataset.task is not None
        assert dataset.physics is not None
        task = TASKS.named(dataset.task)
        assert isinstance(task, DMCTask), "other tasks store no states"
        physics = dataset.physics[dataset.rows_of(number)][:-1]
        shown = [self._actor.act(state) for state in observed_states(task, physics)]
        actions = policy(self._encode(number)[:-1]).cpu().numpy()
        return np.square(actions - np.array(shown).reshape(actions.shape)).mean(1)

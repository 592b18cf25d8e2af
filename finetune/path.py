"""How far a policy is from what the data do, on the data's own path."""

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
"""Episodes that an error is measured on, evenly spaced among those of a set that hold a decision."""


class DataPath:
    """A set's own episodes, as a policy sees them from their first rows on, and what was done and meant there."""

    def __init__(self, dataset: Dataset, actor: Actor | None, encode: Callable[[int], Tensor]) -> None:
        """Nothing is computed yet.

        Args:
            dataset: a set, with simulator states if there is an actor.
            actor: what made it, if that is known.
            encode: representations (rows, D) of the episode of a number.
        """
        self._dataset, self._actor, self._encode = dataset, actor, encode

    def action_error(self, policy: Policy) -> float:
        """Mean squared difference from the actor's mean action, over all decisions of 20 episodes at most."""
        return self._mean(policy, self._meant)

    def cloning_loss(self, policy: Policy) -> float:
        """The same from the data's own actions: what TD3+BC clones. An actor's noise is in it, which nobody knows."""
        return self._mean(policy, self._taken)

    def _mean(self, policy: Policy, actions: Callable[[int], np.ndarray]) -> float:
        rows = (self._dataset.episode_end - self._dataset.episode_start).cpu().numpy()
        deciding = np.flatnonzero(rows > 1)
        last = len(deciding) - 1
        numbers = deciding[np.unique(np.linspace(0, last, min(last + 1, EPISODES)).astype(int))].tolist()
        return float(np.concatenate([self._errors(policy, number, actions(number)) for number in numbers]).mean())

    @torch.no_grad()
    def _errors(self, policy: Policy, number: int, actions: np.ndarray) -> np.ndarray:
        """(decisions,) mean squared differences in one episode, whose last row decides nothing."""
        return np.square(policy(self._encode(number)[:-1]).cpu().numpy() - actions).mean(1)

    def _meant(self, number: int) -> np.ndarray:
        """(decisions, A) mean actions of the actor in one episode."""
        dataset = self._dataset
        assert self._actor is not None
        assert dataset.task is not None
        assert dataset.physics is not None
        task = TASKS.named(dataset.task)
        assert isinstance(task, DMCTask), "other tasks store no states"
        physics = dataset.physics[dataset.rows_of(number)][:-1]
        return np.array([self._actor.act(state) for state in observed_states(task, physics)])

    def _taken(self, number: int) -> np.ndarray:
        """(decisions, A) actions of one episode, each of which is stored with the row behind it."""
        return self._dataset.action[self._dataset.rows_of(number)][1:].cpu().numpy()

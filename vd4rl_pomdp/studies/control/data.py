"""The sets of a control study: an expert's episodes without pixels, and what is seen of their states."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch import Tensor

from vd4rl_pomdp.core.tasks import TASKS, DMCTask
from vd4rl_pomdp.corruptions.keys import DRAWS, draw_integers
from vd4rl_pomdp.data import Dataset, View
from vd4rl_pomdp.data.collect import CollectConfig, play
from vd4rl_pomdp.data.shards import join_rollouts
from vd4rl_pomdp.data.store import PlayedStore
from vd4rl_pomdp.envs.dmc import observed_states
from vd4rl_pomdp.envs.make import layout_of
from vd4rl_pomdp.nn.policy import Standardise
from vd4rl_pomdp.policies.actor import Actor, load_actor


@dataclass(frozen=True)
class PlayedSet:
    """An expert's episodes, and what a run needs to know of them."""

    dataset: Dataset
    expert: Actor
    standardise: Standardise
    """Takes the mean from the poses and velocities, and divides by the standard deviation."""
    expert_actions: Tensor
    """(M, A) float32: the expert's mean action, without noise, at every row that has a successor."""

    @property
    def task(self) -> DMCTask:
        """What is played; only dm_control's tasks have states, and so experts."""
        assert self.dataset.task is not None
        return cast(DMCTask, TASKS.named(self.dataset.task))

    def visible(self, physics: np.ndarray) -> Tensor:
        """Poses and velocities (..., P) float32, standardised, of simulator states."""
        return self.standardise(torch.from_numpy(layout_of(self.task).visible_state(physics)))


@lru_cache(maxsize=1)
def played_set(task: str, action_noise: float, episodes: int, decisions: int) -> PlayedSet:
    """The set of `data collect --quality expert --action-noise S`, played by physics alone.

    Args:
        task: whose expert acts.
        action_noise: standard deviation of the noise on its actions.
        episodes: how many.
        decisions: most decisions of an episode.
    """
    config = CollectConfig(task, "expert", Path(), episodes, workers=1, action_noise=action_noise)
    played = list(play(config, decisions))
    rows = join_rollouts(played)
    dataset = Dataset(Path(task), PlayedStore(Path(task), {"attributes": [{"task": task, "set": "expert"}]}, rows))
    states, expert = dataset.states(), load_actor(task, "expert")
    standardise = Standardise(states.shape[1])
    standardise.fit(states)
    seen = observed_states(cast(DMCTask, TASKS.named(task)), rows["physics"][dataset.transition_rows.numpy()])
    actions = torch.from_numpy(np.stack([expert.act(state) for state in seen]))
    return PlayedSet(dataset, expert, standardise, actions)


def hide(states: Tensor, key: Tensor, share: float) -> Tensor:
    """Set coordinates of states to zero, each with the same probability.

    Args:
        states: (..., P) standardised states, whose means are zero.
        key: (...,) int64; equal keys hide the same coordinates.
        share: probability that a coordinate is hidden.
    """
    return states.masked_fill(draw_integers(key, DRAWS, states.shape[-1]) < share * DRAWS, 0.0)


class HiddenView(View):
    """A set of states of which some coordinates are hidden, others whenever a row enters a batch."""

    def __init__(self, played: PlayedSet, share: float, seed: int, *name: str | int) -> None:
        """See the class.

        Args:
            played: the set.
            share: of the coordinates that are hidden.
            seed: the run's seed.
            name: tells the views of a run apart.
        """
        super().__init__(played.dataset, None, 0, seed, *name)
        assert played.dataset.physics is not None
        self._states, self._share = played.visible(played.dataset.physics), share

    def observe(self, rows: Tensor, shift_key: Tensor | None = None) -> Tensor:
        """(N, ..., P, 1, 1) float32 states of (N, ...) int64 rows; nothing is shifted."""
        keys = self.corruption.keys(self.dataset.keys(rows))
        return hide(self._states[rows], keys, self._share)[..., None, None]

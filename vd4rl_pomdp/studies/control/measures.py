"""What a run is measured by: returns, how far its actions are from the expert's, and what a probe finds."""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import count

import numpy as np
import torch
from torch import Tensor

from finetune.evaluation import EVALUATION_SEED, Agent
from vd4rl_pomdp.core.types import row_key
from vd4rl_pomdp.corruptions.keys import derive_keys
from vd4rl_pomdp.data.reference import REACHED, action_error
from vd4rl_pomdp.envs.make import layout_of, make_env
from vd4rl_pomdp.envs.pixels import PixelEnv, TimeStep
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.nn.probes import probe_state
from vd4rl_pomdp.policies.actor import Actor
from vd4rl_pomdp.runs.files import Row
from vd4rl_pomdp.runs.provenance import git_commit
from vd4rl_pomdp.studies.control.config import LABELS, ControlRun
from vd4rl_pomdp.studies.control.data import PlayedSet, hide, played_set
from vd4rl_pomdp.studies.control.training import pretrained, trained_policy

EPISODE_COLUMNS = (*LABELS, "episode", "episode_seed", "return", "length", "action_error")


def measured(run: ControlRun) -> tuple[Row, list[Row]]:
    """Train a run and measure it: its row of runs.csv, and those of episodes.csv."""
    played = played_set(run.task, run.action_noise, run.episodes, run.decisions)
    started = time.perf_counter()
    encoder, logs = pretrained(run, played)
    policy, features = trained_policy(run, played, encoder)
    seen = features[0, played.dataset.transition_rows].float()
    agent = HiddenAgent(Agent(encoder, policy), played, run.hidden_share)
    env = make_env(played.task, size=None, length=run.decisions)
    episodes: list[Row] = [run.labels | agent.play(env, number) for number in range(run.eval_episodes)]
    returns, data = np.array([row["return"] for row in episodes]), float(played.dataset.returns.mean())
    row = {
        "return": returns.mean(),
        "return_min": returns.min(),
        "return_max": returns.max(),
        "data_return": data,
        "good_share": (returns > REACHED * data).mean(),
        "error_on_data": _error_on_data(policy, seen, played),
        "error_in_loop": sum(e["action_error"] * e["length"] for e in episodes) / sum(e["length"] for e in episodes),
        **_probes(seen, played),
        "action_loss": logs.get("action_loss", 0.0),
        "seconds": time.perf_counter() - started,
    }
    numbers = {name: round(float(value), 5) for name, value in row.items()}
    return run.labels | numbers | {"git_commit": git_commit()}, episodes


def play_episode(act: Callable[[TimeStep], np.ndarray], env: PixelEnv, expert: Actor, seed: int) -> Row:
    """Return, length and mean action error of an episode; the expert's mean action is asked at every visited state."""
    now, total, errors = env.reset(seed), 0.0, []
    while not now.last:
        action = act(now)
        errors.append(float(action_error(action, expert.act(now.state))))
        now = env.step(action)
        total += now.reward
    return {
        "episode_seed": seed,
        "return": round(total, 4),
        "length": len(errors),
        "action_error": round(float(np.mean(errors)), 6),
    }


class HiddenAgent:
    """An agent that sees standardised states, some coordinates hidden by keys of (episode, t) alone."""

    def __init__(self, agent: Agent, played: PlayedSet, share: float) -> None:
        self._agent, self._played, self._share = agent, played, share

    def play(self, env: PixelEnv, number: int) -> Row:
        """Evaluation episode `number`, its rows as in episodes.csv."""
        self._agent.reset()
        t = count()

        def act(now: TimeStep) -> np.ndarray:
            return self._agent.act(self.observe(now, number, next(t)))

        return {"episode": number} | play_episode(act, env, self._played.expert, EVALUATION_SEED + number)

    def observe(self, now: TimeStep, episode: int, t: int) -> Tensor:
        """(P, 1, 1) float32: what is seen of a state in row t of an episode."""
        key = derive_keys(EVALUATION_SEED, row_key(torch.tensor([episode]), torch.tensor([t])))
        return hide(self._played.visible(now.physics)[None], key, self._share)[0, :, None, None]


@torch.no_grad()
def _error_on_data(policy: Policy, features: Tensor, played: PlayedSet) -> float:
    """Action error on the path of the data, of (M, D) float32 representations of the rows that have a successor."""
    actions = torch.cat([policy(part) for part in features.split(4096)])
    return float(action_error(actions.numpy(), played.expert_actions.numpy()))


def _probes(features: Tensor, played: PlayedSet) -> dict[str, float]:
    dataset, rows = played.dataset, played.dataset.transition_rows
    assert dataset.physics is not None
    arrays = dataset.physics[rows.numpy()], dataset.episode[rows].numpy()
    return probe_state(features.numpy(), *arrays, layout_of(played.task))

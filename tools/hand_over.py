"""Where does a policy fail: on the data's path, or on the way there? The data's actor acts first, then hands over.

    python tools/hand_over.py RUN... --after 0 60 --episodes 5 --out hand_over.csv

For every fine-tuning run and hand-over time it plays evaluation episodes in which the actor that made the run's data
acts on the true state, without noise, for the first rows while the run's policy watches; then the policy acts. Columns:
`reward` is the mean reward of a decision after the hand-over (2 at most), `error_after` the mean squared difference
between the policy's action and the actor's from there on, `error_0_10`, `error_10_50` and `error_50_end` the same at
these rows, whoever acts.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from script import run_script

from finetune.evaluation import EVALUATION_SEED, Agent
from vd4rl_pomdp.core.errors import UserError, refuse_number, refuse_outside
from vd4rl_pomdp.core.tasks import MOST_EPISODES, TASKS, Task
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data.reference import Reference, action_error
from vd4rl_pomdp.envs.corrupted import CorruptedEnv
from vd4rl_pomdp.nn.encoder_folder import load_encoder
from vd4rl_pomdp.nn.policy import load_policy
from vd4rl_pomdp.policies.actor import Actor, read_actor
from vd4rl_pomdp.runs.files import read_json, write_csv
from vd4rl_pomdp.runs.outputs import refuse_inside

SPANS = ((0, 10), (10, 50), (50, None))


@dataclass(frozen=True)
class Config:
    """Settings of the comparison."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Fine-tuning run folders."""
    after: tuple[int, ...] = (0, 60)
    """Rows that the actor acts in before it hands over; fewer than an episode has."""
    episodes: int = 5
    """Episodes for each run and hand-over time."""
    out: Path = Path("hand_over.csv")
    """CSV file to write."""


def actor_of(run: Path) -> Actor:
    """The actor that made the run's data; raises UserError if it is not known."""
    file = Reference.read(run).actor_file
    if file is None:
        raise UserError(f"{run}: the one actor of its data is not known; name runs on sets of one shipped actor")
    return read_actor(file)


def play(agent: Agent, actor: Actor, env: CorruptedEnv, task: Task, after: int, episode: int) -> dict[str, float]:
    """Measurements of one episode."""
    agent.reset()
    now = env.reset(EVALUATION_SEED + episode, EVALUATION_SEED, episode)
    rewards, errors = [], []
    while not now.time_step.last:
        action, shown = agent.act(agent.encoder_input(now, task)), actor.act(now.time_step.state)
        errors.append(float(action_error(action, shown)))
        if len(errors) <= after:
            action = shown
            agent.set_last_action(action)
        now = env.step(action)
        rewards.append(now.time_step.reward)
    if not 0 <= after < len(rewards):
        raise UserError(
            f"--after is {after}, and an episode has {len(rewards)} decisions; take 0 to {len(rewards) - 1}"
        )
    spans = {f"error_{a}_{b or 'end'}": round(float(np.mean(errors[a:b])), 4) for a, b in SPANS}
    after_it = {"reward": rewards[after:], "error_after": errors[after:]}
    return {name: round(float(np.mean(values)), 4) for name, values in after_it.items()} | spans


def main(config: Config) -> None:
    """Play all episodes and write the table."""
    if not config.runs:
        raise UserError("no runs given; name fine-tuning run folders")
    refuse_outside(config, episodes=(1, MOST_EPISODES))
    refuse_inside(config.out)
    rows: list[dict[str, Any]] = []
    for run in config.runs:
        labels = read_json(run / "labels.json")
        encoder, card = load_encoder(run / "encoder")
        agent, actor = Agent(encoder, load_policy(run / "policy")), actor_of(run)
        task = TASKS.named(card.task)
        for after in config.after:
            refuse_number("after", after, 0, task.decisions - 1)
        env = CorruptedEnv(task, CorruptionConfig.fill(card.corruption), size=agent.picture_size)
        for after in config.after:
            for episode in range(config.episodes):
                row = labels | {"after": after, "episode": episode}
                rows.append(row | play(agent, actor, env, task, after, episode))
                print(" ".join(f"{k} {v}" for k, v in rows[-1].items()), flush=True)
    write_csv(config.out, list(rows[0]), rows)


if __name__ == "__main__":
    run_script(main, Config)

"""Settings of the training of data-collecting policies, and what each task's defaults are."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from vd4rl_pomdp.core.tasks import TASKS


@dataclass(frozen=True)
class PolicyConfig:
    """Settings of one policy training run; `--task` chooses the defaults."""

    task: str
    """walker_walk, cheetah_run or humanoid_walk, or a task of dm_control that was added."""
    out: Path
    """Run folder; re-run the same command to resume."""
    decisions: int = 300_000
    """Environment decisions in all."""
    seed: int = 0
    """Seed of the networks, the replay draws and the training episodes."""
    learning_rate: float = 7e-4
    """Adam's learning rate, for actor and critics."""
    network: Literal["mlp", "simba"] = "mlp"
    """mlp: two hidden layers; simba: one residual block with layer norms (arXiv 2410.09754)."""
    hidden: int = 256
    """Units of a hidden layer, or width of the residual stream."""
    critic_norm: bool = False
    """Layer norm after each hidden layer of an mlp's critics."""
    normalise: bool = False
    """Standardise observations by running statistics."""
    n_step: int = 1
    """Steps of the critics' returns."""
    envs: int = 1
    """Environments that take turns with the updates."""
    updates_per_decision: float = 1.0
    """Gradient steps for each decision."""
    batch_size: int = 256
    """Transitions in a gradient step."""
    temperature: float = 1.0
    """Initial weight of the entropy."""
    temperature_rate: float = 7e-4
    """Adam's learning rate for that weight."""
    target_entropy: float = -1.0
    """Entropy per action dimension that the temperature aims at."""
    replay_size: int = 1_000_000
    """Transitions kept for the updates."""
    eval_every: int = 5_000
    """Decisions between two snapshots."""
    eval_episodes: int = 5
    """Episodes behind each point of the learning curve."""
    stop_at: float = 1000.0
    """End early once a snapshot's mean return reaches this."""
    start_from: Path | None = None
    """Begin a new run where another one stood: a folder with its config.json, curve.csv and networks.safetensors."""
    refill: int = 100_000
    """After --start-from: decisions of the old policy that fill the empty replay before the first update."""
    critic_warmup: int = 20_000
    """After --start-from: updates of the critics alone, before the actor learns on."""


_STEADY = PolicyConfig(
    "",
    Path(),
    learning_rate=5e-4,
    critic_norm=True,
    normalise=True,
    n_step=3,
    temperature_rate=1e-4,
    target_entropy=-0.5,
)
"""What all tasks but walker_walk share."""
_GENERAL = replace(_STEADY, decisions=600_000, envs=4, temperature=0.1, replay_size=800_000, eval_every=4_000)
"""What a task without a recipe of its own gets: cheetah_run's."""
RECIPES: dict[str, PolicyConfig] = {
    "walker_walk": PolicyConfig("walker_walk", Path()),
    "cheetah_run": replace(_GENERAL, task="cheetah_run"),
    "humanoid_walk": replace(
        _STEADY,
        task="humanoid_walk",
        decisions=20_000_000,
        envs=16,
        updates_per_decision=0.5,
        temperature=0.01,
        eval_every=24_000,
    ),
}
"""Defaults by task. Plain SAC is enough for walker_walk. The others get standardised observations, layer norms in the
critics and three-step returns; humanoid_walk also more fresh decisions for each update: physics is far cheaper than
gradients. Where a run has levelled off, another from it (--start-from) with other steps or exploration climbs on."""


def recipes() -> dict[str, PolicyConfig]:
    """Defaults of every task, those that were added included."""
    return {name: RECIPES.get(name, replace(_GENERAL, task=name)) for name in TASKS}

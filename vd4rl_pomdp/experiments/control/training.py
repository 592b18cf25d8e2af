"""From a set to a frozen encoder, its representations, and a policy on them: the stages, without their folders."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from vd4rl_pomdp.data import Dataset
from vd4rl_pomdp.experiments.control.config import NO_MEMORY, UNTRAINED, ControlRun
from vd4rl_pomdp.experiments.control.data import HiddenView, PlayedSet
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.runs.metrics import Means
from vd4rl_pomdp.seeding import seed_networks, stream_generator

if TYPE_CHECKING:
    from finetune.features import FeatureBatch
    from pretrain.config import PretrainConfig


def pretrained(run: ControlRun, played: PlayedSet) -> tuple[Encoder, dict[str, float]]:
    """The encoder of a run's method, as the `cpu` preset trains it, and the means of its last tenth of steps."""
    from pretrain.build import build_on_states, build_target
    from pretrain.objectives import METHODS
    from pretrain.train import STAGE, PretrainTrainer

    config, dataset = _pretrain_config(run), played.dataset
    seed_networks(run.seed, STAGE)
    target = build_target(config, dataset.action_after(dataset.transition_rows).numpy())
    view = HiddenView(played, run.hidden_share, run.seed, STAGE)
    objective = build_on_states(config, dataset.action_dim, target, played.standardise.mean.shape[0])
    means = Means()
    if METHODS.named(config.method).trained:
        trainer = PretrainTrainer(objective, dataset, config, view)
        for step in range(config.steps):
            logs = trainer.update()
            if step >= config.steps * 9 // 10:
                means.add(logs)
    return objective.encoder.eval().requires_grad_(False), _finite(run, means.take())


def _pretrain_config(run: ControlRun) -> PretrainConfig:
    from pretrain.config import PretrainConfig

    method = "state" if run.method == NO_MEMORY else run.method
    memory = {"history": "gru"} if run.method == UNTRAINED else {}
    chosen = {"method": method, "seed": run.seed, "steps": run.pretrain_steps, "precision": "fp32"}
    return PretrainConfig.of("cpu", **chosen, **memory)


class Ends(NamedTuple):
    """Representations of both ends of every transition, in order."""

    z: Tensor
    """(..., M, D)."""
    next_z: Tensor
    """(..., M, D)."""


def both_ends(encoder: Encoder, features: Tensor, dataset: Dataset, next_rows: Tensor) -> Ends:
    """Representations of the rows that have a successor, and of where their transitions end, from whole histories.

    Args:
        encoder: the frozen encoder.
        features: (N, F) frame features of all rows.
        dataset: the set.
        next_rows: (M,) int64, the row where each transition ends.
    """
    episodes = zip(dataset.episode_start.tolist(), dataset.episode_end.tolist(), strict=True)
    parts = []
    for rows in (torch.arange(start, end) for start, end in episodes):
        parts.append(encoder.from_features(features[rows][None], dataset.actions_before(rows)[None])[0])
    states = torch.cat(parts)
    return Ends(states[dataset.transition_rows], states[next_rows])


def trained_policy(run: ControlRun, played: PlayedSet, encoder: Encoder) -> tuple[Policy, Ends]:
    """TD3+BC, as the `cpu` preset has it, on a frozen encoder; the policy, and the (V, M, D) float16 representations
    of V views that it was trained on."""
    from finetune.algorithms import TD3BC
    from finetune.config import FinetuneConfig
    from finetune.features import STAGE

    config = FinetuneConfig.of("cpu", seed=run.seed, updates=run.updates)
    options: Any = config.options
    dataset = played.dataset
    returns = dataset.n_step_returns(dataset.transition_rows, options.n_step, options.gamma)
    views = (HiddenView(played, run.hidden_share, run.seed, STAGE, number) for number in range(config.views))
    every = torch.arange(dataset.num_rows)
    with torch.no_grad():
        ends = [both_ends(encoder, encoder.frame(view.observe(every)), dataset, returns[2]) for view in views]
    encoded = Ends(*(torch.stack([part.half() for part in parts]) for parts in zip(*ends, strict=True)))
    seed_networks(run.seed, STAGE)
    policy = Policy(encoder.dim, dataset.action_dim, config.hidden_dim)
    policy.standardise.fit(encoded.z)
    algorithm = TD3BC(policy, options, config.learning_rate, config.updates, stream_generator(run.seed, STAGE, "noise"))
    generator = stream_generator(run.seed, STAGE, "batches")
    batches = _batches(dataset, encoded, returns[:2], config.batch_size, generator)
    means = Means()
    for _ in range(config.updates):
        means.add(algorithm.update(next(batches)))
    _finite(run, means.take())
    return policy.eval().requires_grad_(False), encoded


def _batches(
    dataset: Dataset, ends: Ends, returns: tuple[Tensor, Tensor], size: int, generator: torch.Generator
) -> Iterator[FeatureBatch]:
    """Uniform transitions; both ends come from the same view."""
    from finetune.features import FeatureBatch

    action, (reward, discount) = dataset.action_after(dataset.transition_rows), returns
    views, transitions = ends.z.shape[:2]
    while True:
        index = torch.randint(transitions, (size,), generator=generator)
        view = torch.randint(views, (size,), generator=generator)
        z, next_z = (part[view, index].float() for part in ends)
        yield FeatureBatch(z, action[index], reward[index], discount[index], next_z)


def _finite(run: ControlRun, means: dict[str, float]) -> dict[str, float]:
    """The means; one that is not finite raises FloatingPointError."""
    bad = [name for name, value in means.items() if not abs(value) < float("inf")]
    if bad:
        raise FloatingPointError(f"{run.method} on {run.task}, seed {run.seed}: {bad[0]} is {means[bad[0]]}")
    return means

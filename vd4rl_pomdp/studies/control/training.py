"""From a set to a frozen encoder, its representations, and a policy on them: the stages, without their folders."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from vd4rl_pomdp.core.errors import DivergedError
from vd4rl_pomdp.core.seeding import seed_networks, stream_generator
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.runs.metrics import Means
from vd4rl_pomdp.studies.control.config import NO_MEMORY, UNTRAINED, ControlRun
from vd4rl_pomdp.studies.control.data import HiddenView, PlayedSet

if TYPE_CHECKING:
    from finetune.histories import Histories
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


def trained_policy(run: ControlRun, played: PlayedSet, encoder: Encoder) -> tuple[Policy, Tensor]:
    """TD3+BC on a frozen encoder, as the `cpu` preset has it, but for the run's updates and histories.

    Returns:
        The policy, and what it was trained on: (V, N + ..., D) float16 of V views, first those of the set's N rows.
    """
    from finetune.algorithms import TD3BC
    from finetune.config import FinetuneConfig
    from finetune.features import STAGE, FeatureSampler
    from finetune.histories import Histories

    memory = {name: getattr(run, name) for name in ("readout", "random_histories", "history_window")}
    config = FinetuneConfig.of("cpu", seed=run.seed, updates=run.updates, **memory)
    options: Any = config.options
    told: Any = config.memory
    if encoder.memory is not None:
        encoder.config = replace(encoder.config, **told.encoder_changes)
    histories = Histories(played.dataset, told, options.n_step, run.seed)
    views = [HiddenView(played, run.hidden_share, run.seed, STAGE, number) for number in range(config.views)]
    features = torch.stack([_encoded(encoder, histories, number, view) for number, view in enumerate(views)])
    seed_networks(run.seed, STAGE)
    policy = Policy(encoder.dim, played.dataset.action_dim, config.hidden_dim)
    policy.standardise.fit(features)
    batches, noise = (stream_generator(run.seed, STAGE, name) for name in ("batches", "noise"))
    sampler = FeatureSampler(histories, features, config.batch_size, options.n_step, options.gamma, batches)
    algorithm, means = TD3BC(policy, options, config.learning_rate, config.updates, noise), Means()
    for _ in range(config.updates):
        means.add(algorithm.update(sampler.sample()))
    _finite(run, means.take())
    return policy.eval().requires_grad_(False), features


@torch.no_grad()
def _encoded(encoder: Encoder, histories: Histories, number: int, view: HiddenView) -> Tensor:
    """A view's representations (N + ..., D) float16, numbered as `Histories` says."""
    dataset, drawn = histories.dataset, histories.of_view(number)
    frames = encoder.frame(view.observe(torch.arange(dataset.num_rows)))
    out = torch.empty(histories.features, encoder.dim, dtype=torch.float16)
    bounds = zip(dataset.episode_start.tolist(), dataset.episode_end.tolist(), strict=True)
    for episode, (start, end) in enumerate(bounds):
        drawn.fill(out, encoder, frames[start:end], episode)
    return out


def _finite(run: ControlRun, means: dict[str, float]) -> dict[str, float]:
    """The means; one that is not finite raises DivergedError."""
    bad = [name for name, value in means.items() if not abs(value) < float("inf")]
    if bad:
        where = f"{run.method} on {run.task}, seed {run.seed}"
        raise DivergedError(f"{where}: {bad[0]} is {means[bad[0]]}", "leave it out of --methods or --seeds")
    return means

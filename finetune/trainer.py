"""Trainer of one fine-tuning run: algorithm, batches, evaluation and output files."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch

from finetune.algorithms import ALGORITHMS, Algorithm
from finetune.algorithms.algorithm import ReturnOptions
from finetune.config import FinetuneConfig
from finetune.end_to_end import EndToEnd
from finetune.evaluation import episode_rows, evaluate, jobs_of, own_and_none
from finetune.features import STAGE, ExactSampler, FeatureSampler, FrozenEncoder, encode_views
from finetune.histories import Histories, HistoryOptions
from vd4rl_pomdp.core.seeding import seed_networks
from vd4rl_pomdp.core.streams import random_stream
from vd4rl_pomdp.core.tasks import TASKS, DMCTask
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import Dataset, TransitionSampler, View
from vd4rl_pomdp.data.parity import render_info
from vd4rl_pomdp.data.reference import Reference
from vd4rl_pomdp.envs.dmc import observed_states
from vd4rl_pomdp.envs.make import layout_of
from vd4rl_pomdp.nn.encoder import Encoder, EncoderCard
from vd4rl_pomdp.nn.encoder_folder import FILES_OF_RUN, copy_encoder, record_probe, save_encoder
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.nn.probes import probe_state
from vd4rl_pomdp.policies.actor import Actor, read_actor
from vd4rl_pomdp.runs import (
    CRITIC_FILE,
    EPISODES_FILE,
    FILM_FILE,
    LABELS_FILE,
    METRICS_FILE,
    PRETRAIN_TIMING_FILE,
    PROBE_FILE,
    RENDER_FILE,
    TIMING_FILE,
    interrupt,
)
from vd4rl_pomdp.runs.critic import critic_of
from vd4rl_pomdp.runs.episodes import append_episodes, drop_episodes_after, read_episodes
from vd4rl_pomdp.runs.files import Row, read_json, replacing_file, write_json
from vd4rl_pomdp.runs.loop import Loop, training
from vd4rl_pomdp.runs.metrics import EVALUATION, read_metrics
from vd4rl_pomdp.runs.run import RunFolder

RESULTS = ("policy/config.json", "policy/model.safetensors", EPISODES_FILE, *FILES_OF_RUN)
"""Files of a finished run."""
FEATURES_FILE = "features.npy"
PATH_EPISODES = 20
"""Maximum episodes for the error on the data's own path, evenly spaced among those with at least one decision."""
STANDARDISED_BY = 1024
"""Minimum transitions for estimating feature means and standard deviations without cached features (`--views 0`)."""


def labels_of(config: FinetuneConfig, card: EncoderCard) -> dict[str, Any]:
    """Columns that identify a run's rows."""
    before = {"method": card.method, "task": card.task, "quality": card.quality}
    return before | {"corruption": card.corruption["corruption"], "algorithm": config.algorithm, "seed": config.seed}


def make_trainer(
    config: FinetuneConfig, dataset: Dataset, encoder: Encoder, card: EncoderCard, run: RunFolder
) -> FinetuneTrainer:
    """Build a run's trainer, with batches from cached features, from features encoded on the fly, or from pixels.

    Labels, encoder and features are written into the run's folder, which must be owned.
    """
    write_json(run.path / LABELS_FILE, labels_of(config, card))
    if not all((run.path / name).exists() for name in FILES_OF_RUN):
        # copied, with the pretraining's timing, so that the run can be moved and evaluated anywhere
        before = config.encoder.parent  # a pretraining run, or a fine-tuning run on its encoder
        timing = before / (PRETRAIN_TIMING_FILE if (before / LABELS_FILE).exists() else TIMING_FILE)
        if timing.exists():
            write_json(run.path / PRETRAIN_TIMING_FILE, read_json(timing))
        changes = config.memory.encoder_changes if isinstance(config.memory, HistoryOptions) else {}
        copy_encoder(config.encoder, run.path / "encoder", changes)
    seed_networks(config.seed, STAGE)
    policy = Policy(encoder.dim, dataset.action_dim, config.hidden_dim).to(dataset.t.device)
    draws = random_stream(config.seed, STAGE, "batches", device=dataset.t.device)
    corruption = CorruptionConfig.fill(card.corruption)  # as in pretraining: the corruption is part of the environment
    returns = config.options if isinstance(config.options, ReturnOptions) else ReturnOptions()
    frozen = FrozenEncoder(encoder, dataset, corruption, config.shift, config.precision, config.seed_of_views)
    encode: Callable[[int], torch.Tensor] = partial(frozen.episode, view=frozen.view(0))
    sampler: FeatureSampler | ExactSampler | TransitionSampler
    if card.end_to_end:
        view = View(dataset, corruption, config.shift, config.seed_of_views, STAGE)
        sampler = TransitionSampler(view, config.batch_size, draws, returns.n_step, returns.gamma)
    elif config.views:
        histories = Histories(dataset, config.memory, returns.n_step, config.seed_of_views)
        features = encode_views(frozen, histories, config.views, run.path / FEATURES_FILE, run.inputs["encoder"])
        policy.standardise.fit(features)
        _probe(features, dataset, run)
        encode = lambda number: features[0, dataset.rows_of(number)].float()  # noqa: E731, of the first view
        sampler = FeatureSampler(histories, features, config.batch_size, returns.n_step, returns.gamma, draws)
    else:
        sampler = ExactSampler(frozen, config.memory, config.batch_size, returns.n_step, returns.gamma, draws)
        batches = math.ceil(STANDARDISED_BY / config.batch_size)
        policy.standardise.fit(torch.cat([sampler.sample().z for _ in range(batches)]))
    noise = random_stream(config.seed, STAGE, "noise", device=dataset.t.device)
    algorithm = ALGORITHMS.named(config.algorithm)(policy, config.options, config.learning_rate, config.updates, noise)
    reference = Reference.of(dataset)
    actor = reference.actor_file
    path = partial(path_error, dataset, read_actor(actor), encode) if actor and dataset.physics is not None else None
    trained = EndToEnd(algorithm, encoder, config) if card.end_to_end else algorithm
    return FinetuneTrainer(trained, sampler, config, card, run, reference, path)


@torch.no_grad()
def path_error(
    dataset: Dataset,
    actor: Actor,
    encode: Callable[[int], torch.Tensor],
    policy: Callable[[torch.Tensor], torch.Tensor],
) -> float:
    """Mean squared difference between a policy and the behaviour policy's mean action, on the data's own states.

    Over all decisions of at most PATH_EPISODES episodes. `encode` gives an episode's representations (rows, D).
    """
    assert dataset.task is not None
    assert dataset.physics is not None
    task = TASKS.named(dataset.task)
    assert isinstance(task, DMCTask), "other tasks store no states"
    deciding = np.flatnonzero((dataset.episode_end - dataset.episode_start).cpu().numpy() > 1)
    last = len(deciding) - 1
    errors = []
    for number in deciding[np.unique(np.linspace(0, last, min(last + 1, PATH_EPISODES)).astype(int))].tolist():
        physics = dataset.physics[dataset.rows_of(number)][:-1]  # no decision at an episode's last row
        behaviour = np.array([actor.act(state) for state in observed_states(task, physics)])
        actions = policy(encode(number)[:-1]).cpu().numpy()
        errors.append(np.square(actions - behaviour.reshape(actions.shape)).mean(1))
    return float(np.concatenate(errors).mean())


def _probe(features: torch.Tensor, dataset: Dataset, run: RunFolder) -> None:
    """Write how well the first view predicts the simulator state, if the task is known, states are stored, and an
    episode can be held out."""
    if dataset.physics is None or dataset.num_episodes < 2 or dataset.task is None or dataset.task not in TASKS:
        return
    if (run.path / PROBE_FILE).exists():
        record_probe(run.path / "encoder", read_json(run.path / PROBE_FILE))
        return
    arrays = features[0, : dataset.num_rows].float().cpu().numpy(), dataset.physics, dataset.episode.cpu().numpy()
    errors = probe_state(*arrays, layout_of(TASKS.named(dataset.task)))
    record_probe(run.path / "encoder", errors)
    write_json(run.path / PROBE_FILE, errors)


@dataclass(eq=False)
class FinetuneTrainer:
    """One run: an algorithm, its batches, and where the results go."""

    algorithm: Algorithm | EndToEnd
    sampler: FeatureSampler | ExactSampler | TransitionSampler
    config: FinetuneConfig
    card: EncoderCard
    folder: RunFolder
    reference: Reference
    path_error: Callable[[Policy], float] | None
    step: int = 0
    settle: Callable[[], None] = lambda: None
    """Brings algorithm and sampler up to date when a stack makes the updates."""
    loop: Loop = field(init=False)
    """Set while training."""

    def begin(self, title: str) -> AbstractContextManager[Loop]:
        """Open the training loop, resuming from the newest checkpoint. No progress is shown without a title."""
        self.reference.write(self.folder.path)
        labels, total = labels_of(self.config, self.card), self.config.updates
        return training(self.folder, self, title, total, "updates", labels=labels, card=asdict(self.card))

    def resume(self) -> None:
        """Drop evaluations newer than the checkpoint, and repeat one that was interrupted right after it."""
        drop_episodes_after(self.folder.path / EPISODES_FILE, self.step)  # left by a checkpoint that was lost
        if self.step and self.loop.due(self.config.eval_every):
            self.evaluate()

    def finish(self) -> None:
        path = self.folder.path
        if self.path_error:
            self.reference.with_path_error(self.path_error(self.algorithm.policy)).write(path)
        (path / FEATURES_FILE).unlink(missing_ok=True)
        if self.config.eval_episodes:
            write_json(path / RENDER_FILE, render_info(self.card.task))
        gamma = getattr(self.config.options, "gamma", None)
        critic = critic_of(read_metrics(path / METRICS_FILE), self.step, self.reference.mean_reward, gamma)
        write_json(path / CRITIC_FILE, critic)
        self.folder.finish(updates=self.step)

    def evaluate(self) -> None:
        """Save this step's policy, play its episodes unless their rows exist, and log the scores.

        The step's checkpoint is saved before, so signals may interrupt the episodes.

        Raises:
            FloatingPointError: a weight is not finite.
        """
        run, loop, config = self.folder, self.loop, self.config
        own = CorruptionConfig.fill(self.card.corruption)
        counts = config.eval_episodes, config.eval_clean_episodes or config.eval_episodes
        clean = config.eval_clean and self.step == config.updates
        under = list(zip(own_and_none(own) if clean else [own], counts, strict=False))
        with interrupt.deferred(False):
            loop.require_finite(self.algorithm.policy)
            self.algorithm.policy.save(run.path / "policy", self.step)
            if isinstance(self.algorithm, EndToEnd):
                loop.require_finite(self.algorithm.encoder)
                save_encoder(run.path / "encoder", self.algorithm.encoder, self.card)
            if not config.eval_episodes:
                append_episodes(run.path / EPISODES_FILE, [])  # a finished run has the file
                return
            rows = [row for row in read_episodes(run.path / EPISODES_FILE) if row["step"] == self.step]
            played = Counter(row["evaluated_under"] for row in rows)
            if any(played[one.corruption] < episodes for one, episodes in under):
                rows = self._play(run, under)
        scores = {
            f"{EVALUATION}{measure}/{name}": float(np.mean([r[measure] for r in rows if r["evaluated_under"] == name]))
            for name in dict.fromkeys(row["evaluated_under"] for row in rows)
            for measure in ("return", "score")
        }
        loop.log_evaluation(scores)
        loop.show(score=scores[f"{EVALUATION}score/{own.corruption}"])

    def _play(self, run: RunFolder, under: list[tuple[CorruptionConfig, int]]) -> list[Row]:
        """Play the given number of episodes under each corruption, save a film of the first, then append all rows."""
        config, task = self.config, TASKS.named(self.card.task)
        drop_episodes_after(run.path / EPISODES_FILE, self.step - 1)
        jobs = [
            job
            for number, (one, count) in enumerate(under)
            for job in jobs_of(run.path, task, [one], count, config.eval_length, film=not number)
        ]
        episodes = evaluate(jobs, config.workers)
        rows = episode_rows(episodes, labels_of(config, self.card) | {"step": self.step})
        if episodes[0].film is not None:
            with replacing_file(run.path / FILM_FILE) as fresh, fresh.open("wb") as file:
                np.savez_compressed(file, **episodes[0].film)  # type: ignore[arg-type]
        append_episodes(run.path / EPISODES_FILE, rows)
        return rows

    def state(self) -> dict[str, Any]:
        self.settle()
        parts = {"algorithm": self.algorithm.state_dict(), "sampler": self.sampler.state_dict()}
        return {"step": self.step} | parts

    def restore(self, state: dict[str, Any]) -> None:
        self.step = state["step"]
        self.algorithm.load_state_dict(state["algorithm"])
        self.sampler.load_state_dict(state["sampler"])

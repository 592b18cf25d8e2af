"""`vd4rl-pomdp finetune`: a frozen encoder, features of the set, an algorithm, and its evaluations."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from finetune.algorithms import ALGORITHMS, Algorithm
from finetune.algorithms.algorithm import ReturnOptions
from finetune.config import FinetuneConfig, as_trained
from finetune.end_to_end import EndToEnd
from finetune.evaluation import episode_rows, evaluate, jobs_of, own_and_none
from finetune.features import STAGE, ExactSampler, FeatureSampler, FrozenEncoder, encode_views
from finetune.histories import Histories, HistoryOptions
from finetune.path import DataPath
from vd4rl_pomdp.core.errors import refuse_outside
from vd4rl_pomdp.core.registry import warn_of_other_code
from vd4rl_pomdp.core.seeding import seed_networks
from vd4rl_pomdp.core.streams import random_stream
from vd4rl_pomdp.core.tasks import TASKS, UNKNOWN_QUALITY
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import Dataset, TransitionSampler, View, open_dataset
from vd4rl_pomdp.data.folder import read_plan
from vd4rl_pomdp.data.parity import render_info
from vd4rl_pomdp.data.reference import Reference
from vd4rl_pomdp.envs.make import layout_of
from vd4rl_pomdp.nn.encoder import Encoder, EncoderCard
from vd4rl_pomdp.nn.encoder_folder import (
    FILES_OF_RUN,
    copy_encoder,
    encoder_hash,
    load_encoder,
    read_record,
    save_encoder,
    tell_probe,
)
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.nn.probes import probe_state
from vd4rl_pomdp.policies.actor import read_actor
from vd4rl_pomdp.runs import (
    EPISODES_FILE,
    FILM_FILE,
    LABELS_FILE,
    PRETRAIN_TIMING_FILE,
    PROBE_FILE,
    RENDER_FILE,
    TIMING_FILE,
    interrupt,
)
from vd4rl_pomdp.runs.device import pick_device
from vd4rl_pomdp.runs.episodes import append_episodes, drop_episodes_after, read_episodes
from vd4rl_pomdp.runs.files import Row, read_json, replacing_file, write_json
from vd4rl_pomdp.runs.loop import Loop, training
from vd4rl_pomdp.runs.metrics import EVALUATION
from vd4rl_pomdp.runs.outputs import refuse_inside
from vd4rl_pomdp.runs.run import RunFolder

RESULTS = ("policy/config.json", "policy/model.safetensors", EPISODES_FILE, *FILES_OF_RUN)
"""What a finished run holds."""
FEATURES_FILE = "features.npy"
STANDARDISED_BY = 1024
"""Least transitions whose representations give their means and deviations, where none are kept (`--views 0`)."""


def finetune(config: FinetuneConfig) -> RunFolder:
    """Run the stage, or resume it; writes the policy and `episodes.csv` into the run's folder."""
    config.check()
    refuse_inside(config.out)
    dataset = open_dataset(config.data)
    dataset.require_transitions()
    encoder, card = load_encoder(config.encoder, dataset.task, dataset.action_dim, dataset.frame_size)
    refuse_outside(config, shift=(0, dataset.frame_size - 1))
    config = as_trained(config, card.end_to_end, encoder.memory is not None, TASKS.named(card.task).decisions)
    if isinstance(config.memory, HistoryOptions):
        encoder.config = replace(encoder.config, **config.memory.encoder_changes)
    if encoder.reads_state:
        dataset.require_states()
    device = pick_device(config.device)
    untold = card.quality if card.data == dataset.fingerprint else UNKNOWN_QUALITY
    card = replace(card, quality=dataset.quality or untold)  # the policy's set names its rows
    inputs = {"data": dataset.fingerprint, "encoder": encoder_hash(config.encoder)}
    before = read_record(config.encoder)
    with RunFolder(config.out, STAGE, config, inputs, RESULTS, before.parts, read_plan(config.data)) as run:
        if not run.finished:
            warn_of_other_code(config.encoder, before.code, before.parts, "it was pretrained; pretrain it again")
            write_json(run.path / LABELS_FILE, labels_of(config, card))
            _keep_encoder(config, run.path)
            dataset.to(device)
            _trainer(config, dataset, encoder.to(device), card, run).run(run)
    return run


def labels_of(config: FinetuneConfig, card: EncoderCard) -> dict[str, Any]:
    """The columns that name a run's rows."""
    labels = {name: getattr(card, name) for name in ("method", "task", "quality")}
    return labels | {
        "corruption": card.corruption["corruption"],
        "algorithm": config.algorithm,
        "seed": config.seed,
    }


def _trainer(
    config: FinetuneConfig, dataset: Dataset, encoder: Encoder, card: EncoderCard, run: RunFolder
) -> FinetuneTrainer:
    """What a run trains and on which batches: cached features, features encoded anew, or pixels."""
    seed_networks(config.seed, STAGE)
    policy = Policy(encoder.dim, dataset.action_dim, config.hidden_dim).to(dataset.t.device)
    draws = random_stream(config.seed, STAGE, "batches", device=dataset.t.device)
    corruption = CorruptionConfig.fill(card.corruption)  # as in pretraining: what is hidden belongs to the world
    returns = config.options if isinstance(config.options, ReturnOptions) else ReturnOptions()
    frozen = FrozenEncoder(encoder, dataset, corruption, config.shift, config.precision, config.seed_of_views)
    encode = partial(frozen.episode, view=frozen.view(0))
    sampler: FeatureSampler | ExactSampler | TransitionSampler
    if card.end_to_end:
        view = View(dataset, corruption, config.shift, config.seed_of_views, STAGE)
        sampler = TransitionSampler(view, config.batch_size, draws, returns.n_step, returns.gamma)
    elif config.views:
        histories = Histories(dataset, config.memory, returns.n_step, config.seed_of_views)
        features = encode_views(frozen, histories, config.views, run.path / FEATURES_FILE)
        policy.standardise.fit(features)
        _probe(features, dataset, run)
        encode = partial(_cached, features, dataset)
        sampler = FeatureSampler(histories, features, config.batch_size, returns.n_step, returns.gamma, draws)
    else:
        sampler = ExactSampler(frozen, config.memory, config.batch_size, returns.n_step, returns.gamma, draws)
        batches = math.ceil(STANDARDISED_BY / config.batch_size)
        policy.standardise.fit(torch.cat([sampler.sample().z for _ in range(batches)]))
    noise = random_stream(config.seed, STAGE, "noise", device=dataset.t.device)
    algorithm = ALGORITHMS.named(config.algorithm)(policy, config.options, config.learning_rate, config.updates, noise)
    reference = Reference.of(dataset)
    actor = reference.actor_file
    path = DataPath(dataset, read_actor(actor), encode) if actor and dataset.physics is not None else None
    return FinetuneTrainer(
        EndToEnd(algorithm, encoder, config) if card.end_to_end else algorithm, sampler, config, card, reference, path
    )


def _cached(features: torch.Tensor, dataset: Dataset, number: int) -> torch.Tensor:
    """Representations (rows, D) of an episode in the first view."""
    return features[0, dataset.rows_of(number)].float()


def _probe(features: torch.Tensor, dataset: Dataset, run: RunFolder) -> None:
    """Write how well the first view tells the simulator state, if the set stores it and has an episode to hold out."""
    if dataset.physics is None or dataset.task is None or dataset.num_episodes < 2:
        return
    if (run.path / PROBE_FILE).exists():
        tell_probe(run.path / "encoder", read_json(run.path / PROBE_FILE))
        return
    arrays = features[0, : dataset.num_rows].float().cpu().numpy(), dataset.physics, dataset.episode.cpu().numpy()
    errors = probe_state(*arrays, layout_of(TASKS.named(dataset.task)))
    tell_probe(run.path / "encoder", errors)
    write_json(run.path / PROBE_FILE, errors)


class FinetuneTrainer:
    """One algorithm on one stream of batches."""

    def __init__(
        self,
        algorithm: Algorithm | EndToEnd,
        sampler: FeatureSampler | ExactSampler | TransitionSampler,
        config: FinetuneConfig,
        card: EncoderCard,
        reference: Reference,
        path: DataPath | None,
    ) -> None:
        self.algorithm, self.sampler = algorithm, sampler
        self.config, self.card = config, card
        self.reference, self.path = reference, path
        self.step = 0
        self._precise = torch.autocast(
            algorithm.policy.standardise.mean.device.type,
            torch.bfloat16,
            config.update_precision == "bf16",
            cache_enabled=False,
        )
        """Not cached, because weights move between the losses of an update."""

    def run(self, run: RunFolder) -> None:
        """Train to the end, from the newest checkpoint if there is one."""
        config, labels = self.config, labels_of(self.config, self.card)
        title = f"finetune {config.algorithm} on {self.card.method}"
        self.reference.write(run.path)
        with training(run, self, title, config.updates, "updates", labels=labels, card=asdict(self.card)) as loop:
            drop_episodes_after(run.path / EPISODES_FILE, self.step)  # of a checkpoint that is gone
            if self.step and loop.due(config.eval_every):  # cut between this step's checkpoint and its scores
                self.evaluate(run, loop)
            for step in loop:
                batch = self.sampler.sample()
                with self._precise:
                    logs = self.algorithm.update(batch)  # type: ignore[arg-type]
                loop.add(logs)
                self.step = step
                if loop.due(config.log_every):
                    loop.log()
                if loop.due(config.eval_every):
                    loop.save()  # first, so that a kill while episodes are played costs no update
                    self.evaluate(run, loop)
        if self.path:
            self.reference.with_path_error(self.path.action_error(self.algorithm.policy)).write(run.path)
        (run.path / FEATURES_FILE).unlink(missing_ok=True)
        write_json(run.path / RENDER_FILE, render_info(self.card.task))
        run.finish(updates=self.step)

    def evaluate(self, run: RunFolder, loop: Loop) -> None:
        """Keep this step's policy, play its episodes unless their rows are there, and log the scores.

        The step's checkpoint is kept: while it plays, a signal need not wait.

        Raises:
            FloatingPointError: a weight is not finite.
        """
        own = CorruptionConfig.fill(self.card.corruption)
        under = own_and_none(own) if self.config.eval_clean and self.step == self.config.updates else [own]
        with interrupt.deferred(False):
            loop.require_finite(self.algorithm.policy)
            self.algorithm.policy.save(run.path / "policy", self.step)
            if isinstance(self.algorithm, EndToEnd):
                loop.require_finite(self.algorithm.encoder)
                save_encoder(run.path / "encoder", self.algorithm.encoder, self.card)
            rows = [row for row in read_episodes(run.path / EPISODES_FILE) if row["step"] == self.step]
            if len(rows) < len(under) * self.config.eval_episodes:
                rows = self._play(run, loop, under)
        scores = {
            f"{EVALUATION}{measure}/{name}": float(np.mean([r[measure] for r in rows if r["evaluated_under"] == name]))
            for name in dict.fromkeys(row["evaluated_under"] for row in rows)
            for measure in ("return", "score")
        }
        loop.log_evaluation(scores)
        loop.show(score=scores[f"{EVALUATION}score/{own.corruption}"])

    def _play(self, run: RunFolder, loop: Loop, under: list[CorruptionConfig]) -> list[Row]:
        """Keep a film of the first episode, then append the rows of all; they are the result."""
        config, task = self.config, TASKS.named(self.card.task)
        drop_episodes_after(run.path / EPISODES_FILE, self.step - 1)
        episodes = evaluate(
            jobs_of(run.path, task, under, config.eval_episodes, config.eval_length, film=True), config.workers
        )
        rows = episode_rows(episodes, labels_of(config, self.card) | {"step": self.step})
        if episodes[0].film is not None:
            with replacing_file(run.path / FILM_FILE) as fresh, fresh.open("wb") as file:
                np.savez_compressed(file, **episodes[0].film)  # type: ignore[arg-type]
        append_episodes(run.path / EPISODES_FILE, rows)
        return rows

    def state(self) -> dict[str, Any]:
        """Everything needed to resume to the bit."""
        parts = {"algorithm": self.algorithm.state_dict(), "sampler": self.sampler.state_dict()}
        return {"step": self.step} | parts

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from `state`."""
        self.step = state["step"]
        self.algorithm.load_state_dict(state["algorithm"])
        self.sampler.load_state_dict(state["sampler"])


def _keep_encoder(config: FinetuneConfig, run: Path) -> None:
    """Copy the encoder into the run, so that the run can be evaluated wherever it is moved; its timing, too."""
    source = config.encoder
    if all((run / name).exists() for name in FILES_OF_RUN):
        return
    timing = source.parent / TIMING_FILE
    if timing.exists():
        write_json(run / PRETRAIN_TIMING_FILE, read_json(timing))
    changes = config.memory.encoder_changes if isinstance(config.memory, HistoryOptions) else {}
    copy_encoder(source, run / "encoder", changes)

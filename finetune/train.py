"""The fine-tuning loop: frozen encoder, cached features, an algorithm, evaluation; resumable to the bit on a CPU."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from finetune.algorithms import ALGORITHMS, Algorithm
from finetune.config import FinetuneConfig
from finetune.end_to_end import EndToEnd
from finetune.evaluations import POLICY, Evaluations, labels
from finetune.features import STAGE, ExactSampler, FeatureFile, FeatureSampler, FrozenEncoder, encode_views
from finetune.histories import Histories, HistoryOptions
from finetune.path import DataPath
from finetune.settings import as_trained, check_n_step, return_options
from vd4rl_pomdp.core.errors import refuse_number, refuse_outside
from vd4rl_pomdp.core.registry import warn_of_other_code
from vd4rl_pomdp.core.seeding import seed_networks, stream_generator
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
    tell_probe,
)
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.nn.probes import probe_state
from vd4rl_pomdp.policies.actor import read_actor
from vd4rl_pomdp.runs import LABELS_FILE, PRETRAIN_TIMING_FILE, PROBE_FILE, RENDER_FILE, TIMING_FILE
from vd4rl_pomdp.runs.device import pick_device
from vd4rl_pomdp.runs.files import read_json, write_json
from vd4rl_pomdp.runs.loop import training
from vd4rl_pomdp.runs.outputs import refuse_inside
from vd4rl_pomdp.runs.run import RunFolder

RESULTS = (*POLICY, *FILES_OF_RUN)
"""What a finished run holds, beside the rows of its evaluations."""
STANDARDISED_BY = 1024
"""Least transitions whose representations give their means and deviations, where none are kept (`--views 0`)."""


def finetune(config: FinetuneConfig) -> RunFolder:
    """Run the stage, or go on with it; writes the policy and `episodes.csv` into the run's folder."""
    config.check()
    refuse_inside(config.out)
    device = pick_device(config.device)
    dataset = open_dataset(config.data)
    dataset.require_transitions()
    encoder, card = load_encoder(config.encoder, dataset.task, dataset.action_dim, dataset.frame_size)
    refuse_outside(config, shift=(0, dataset.frame_size - 1))
    decisions = TASKS.named(card.task).decisions
    refuse_number("eval_length", config.eval_length, 1, max(decisions, FinetuneConfig.eval_length))
    config = as_trained(config, card.method, card.end_to_end, encoder.memory is not None, decisions)
    if isinstance(config.memory, HistoryOptions):
        encoder.config = replace(encoder.config, **config.memory.encoder_changes)
    if encoder.reads_state:
        dataset.require_states()
    check_n_step(config, int((dataset.episode_end - dataset.episode_start).max()) - 1)
    untold = card.quality if card.data == dataset.fingerprint else UNKNOWN_QUALITY
    card = replace(card, quality=dataset.quality or untold)  # the policy's set names its rows
    inputs = {"data": dataset.fingerprint, "encoder": encoder_hash(config.encoder)}
    before = read_record(config.encoder)
    collection = read_plan(config.data)
    run = RunFolder(config.out, STAGE, config, inputs, RESULTS, before.parts, collection)
    if run.finished:
        Evaluations(run.path, config, card, Reference()).require_all()
    with run:
        if not run.finished:
            warn_of_other_code(config.encoder, before.code, before.parts, "it was pretrained; pretrain it again")
            write_json(run.path / LABELS_FILE, labels(config, card))
            _keep_encoder(config, run.path)
            dataset.to(device)
            _trainer(config, dataset, encoder.to(device), card, run).run(run)
    return run


def _trainer(
    config: FinetuneConfig, dataset: Dataset, encoder: Encoder, card: EncoderCard, run: RunFolder
) -> FinetuneTrainer:
    """What a run trains and on which batches: cached features, features encoded anew, or pixels."""
    seed_networks(config.seed, STAGE)
    policy = Policy(encoder.dim, dataset.action_dim, config.hidden_dim).to(dataset.t.device)
    generator = stream_generator(config.seed, STAGE, "batches")
    corruption, returns = CorruptionConfig.fill(card.corruption), return_options(config)
    frozen = FrozenEncoder(encoder, dataset, corruption, config.shift, config.precision, config.seed)
    encode = partial(frozen.episode, view=frozen.view(0))
    sampler: FeatureSampler | ExactSampler | TransitionSampler
    if card.end_to_end:
        view = View(dataset, corruption, config.shift, config.seed, STAGE)
        sampler = TransitionSampler(view, config.batch_size, generator, returns.n_step, returns.gamma)
    elif config.views:
        histories = Histories(dataset, config.memory, returns.n_step, config.seed)
        features = encode_views(frozen, histories, config.views, FeatureFile(run.path, run.inputs | run.code))
        policy.standardise.fit(features)
        _probe(features, dataset, run)
        encode = partial(_cached, features, dataset)
        sampler = FeatureSampler(histories, features, config.batch_size, returns.n_step, returns.gamma, generator)
    else:
        sampler = ExactSampler(frozen, config.memory, config.batch_size, returns.n_step, returns.gamma, generator)
        batches = math.ceil(STANDARDISED_BY / config.batch_size)
        policy.standardise.fit(torch.cat([sampler.sample().z for _ in range(batches)]))
    noise = stream_generator(config.seed, STAGE, "noise")
    algorithm = ALGORITHMS.named(config.algorithm)(policy, config.options, config.learning_rate, config.updates, noise)
    algorithm.precision = config.update_precision
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
        self.evaluations: Evaluations | None = None
        """Those of the run that it is part of."""

    def run(self, run: RunFolder) -> None:
        """Train to the end, from the newest checkpoint if there is one."""
        config = self.config
        title = f"finetune {config.algorithm} on {self.card.method}"
        self.reference.write(run.path)
        told = {"labels": labels(config, self.card), "card": asdict(self.card)}
        self.evaluations = Evaluations(run.path, config, self.card, self.reference)
        with training(run, self, title, config.updates, "updates", **told) as loop:
            self.evaluations.drop_after(self.step)
            if self.step and loop.due(config.eval_every):
                self.evaluations.carry_out(self.step, self.algorithm, loop)
            for step in loop:
                loop.add(self.algorithm.update(self.sampler.sample()))  # type: ignore[arg-type]
                self.step = step
                if loop.due(config.log_every):
                    loop.log()
                if loop.due(config.eval_every):
                    loop.save()
                    self.evaluations.carry_out(self.step, self.algorithm, loop)
        if self.path:
            self.reference.with_path_error(self.path.action_error(self.algorithm.policy)).write(run.path)
        FeatureFile(run.path, run.inputs).remove()
        write_json(run.path / RENDER_FILE, render_info(self.card.task))
        run.finish(updates=self.step)

    def state(self) -> dict[str, Any]:
        """Everything needed to go on to the bit."""
        parts = {"algorithm": self.algorithm.state_dict(), "sampler": self.sampler.state_dict()}
        return {"step": self.step} | parts

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from `state`."""
        self.step = state["step"]
        if self.evaluations is not None:  # before anything of the run is changed
            self.evaluations.require(self.step)
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

"""The fine-tuning loop: frozen encoder, cached features, an algorithm, evaluation; resumable to the bit on a CPU."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from finetune.algorithms import ALGORITHMS, Algorithm, ReturnOptions
from finetune.config import FinetuneConfig
from finetune.end_to_end import EndToEnd
from finetune.features import STAGE, ExactSampler, FeatureFile, FeatureSampler, FrozenEncoder, encode_views
from finetune.histories import Histories, HistoryOptions
from finetune.path import DataPath
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import Dataset, TransitionSampler, View, open_dataset
from vd4rl_pomdp.data.parity import render_info
from vd4rl_pomdp.envs.make import layout_of
from vd4rl_pomdp.errors import UserError, flag_of, refuse_number, refuse_outside
from vd4rl_pomdp.evaluation import (
    EpisodeJob,
    append_episodes,
    drop_episodes_after,
    episode_rows,
    episodes_until,
    evaluate,
    own_and_none,
    read_episodes,
)
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.nn.encoder_folder import (
    CONFIG,
    EncoderCard,
    copy_encoder,
    encoder_hash,
    load_encoder,
    save_encoder,
    tell_probe,
)
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.options import NO_OPTIONS, flat
from vd4rl_pomdp.policies.actor import read_actor
from vd4rl_pomdp.probes import probe_state
from vd4rl_pomdp.reference import Reference
from vd4rl_pomdp.runs import interrupt
from vd4rl_pomdp.runs.device import pick_device
from vd4rl_pomdp.runs.files import Row, read_json, replacing_file, write_json
from vd4rl_pomdp.runs.loop import Loop, training
from vd4rl_pomdp.runs.memory import require_disk, require_memory, telling_memory
from vd4rl_pomdp.runs.metrics import EVALUATION
from vd4rl_pomdp.runs.outputs import refuse_inside
from vd4rl_pomdp.runs.run import RunFolder
from vd4rl_pomdp.seeding import seed_networks, stream_generator
from vd4rl_pomdp.tasks import TASKS


def finetune(config: FinetuneConfig) -> RunFolder:
    """Run the stage, or go on with it; writes the policy and `episodes.csv` into the run's folder."""
    config.check()
    refuse_inside(config.out)
    with telling_memory(config, "views", "batch_size", "hidden_dim"):
        return _finetune(config)


def _finetune(config: FinetuneConfig) -> RunFolder:
    device = pick_device(config.device)
    dataset = open_dataset(config.data)
    dataset.require_transitions()
    encoder, card = load_encoder(config.encoder, dataset.task, dataset.action_dim, dataset.frame_size)
    refuse_outside(config, shift=(0, dataset.frame_size - 1))
    longest = max(TASKS.named(card.task).decisions, FinetuneConfig.eval_length)
    refuse_number("eval_length", config.eval_length, 1, longest)
    config = as_trained(config, card.method, card.end_to_end, encoder.gru is not None)
    if isinstance(config.memory, HistoryOptions):
        encoder.config = replace(encoder.config, **config.memory.encoder_changes)
    if encoder.reads_state:
        dataset.require_states()
    _check_n_step(config, dataset)
    card = replace(card, quality=dataset.quality or card.quality)  # the policy's set names its rows
    inputs = {"data": dataset.fingerprint, "encoder": encoder_hash(config.encoder)}
    run = RunFolder(config.out, STAGE, config, inputs)
    if not run.finished:
        _require_room(config, dataset, encoder, device, FeatureFile(run.path, inputs).exists)
    with run:
        if not run.finished:
            write_json(run.path / "labels.json", _labels(config, card))
            _keep_encoder(config, run.path)
            dataset.to(device)
            _trainer(config, dataset, encoder.to(device), card, run).run(run)
    return run


def as_trained(config: FinetuneConfig, method: str, algorithm: str, remembers: bool) -> FinetuneConfig:
    """The settings as an encoder's policy is trained with them: what it cannot read is no part of them.

    Args:
        config: the settings that were told.
        method: the encoder's.
        algorithm: the algorithm that the method brings along, if it has no frozen stage; else empty.
        remembers: whether the encoder has a memory.

    Raises:
        UserError: a setting that was not the default is not read.
    """
    if algorithm:
        config = _end_to_end(config, algorithm)
    return config if remembers and not algorithm else _without_memory(config, method)


def _end_to_end(config: FinetuneConfig, algorithm: str) -> FinetuneConfig:
    if config.views != config.usual()["views"]:
        raise UserError(f"--views is not read by the algorithm {algorithm}, which trains the encoder: leave it out")
    return config.altered(algorithm=algorithm, views=0)


def _without_memory(config: FinetuneConfig, method: str) -> FinetuneConfig:
    usual = config.usual()
    for name, value in flat(config.memory).items():
        if value != usual[name]:
            raise UserError(f"{flag_of(name)} is not read: {method} has no memory; leave it out")
    return replace(config, memory=NO_OPTIONS)


def _check_n_step(config: FinetuneConfig, dataset: Dataset) -> None:
    """Raise UserError for returns over more steps than an episode has."""
    longest = int((dataset.episode_end - dataset.episode_start).max()) - 1
    refuse_number("n_step", _returns(config).n_step, 1, max(longest, ReturnOptions.n_step))


def _require_room(config: FinetuneConfig, dataset: Dataset, encoder: Encoder, device: torch.device, kept: bool) -> None:
    """Refuse what plainly exceeds the memory or the disk: all views' features, or one batch through the networks.

    Features that are `kept` on the disk already take no more of it.
    """
    histories = Histories(dataset, config.memory, 1, config.seed)
    features = config.views * histories.features * encoder.dim * 2
    require_memory(features, device, config, "views")
    if not kept:
        require_disk(features, config.out, config, "views")
    row, weights = 2 * encoder.dim + 4 * config.hidden_dim, 15 * config.hidden_dim**2  # of float32 numbers
    require_memory(4 * (config.batch_size * row + weights), device, config, "batch_size", "hidden_dim")


def _returns(config: FinetuneConfig) -> ReturnOptions:
    """How returns are summed, also for an algorithm that does not look at them."""
    return config.options if isinstance(config.options, ReturnOptions) else ReturnOptions()


def _trainer(
    config: FinetuneConfig, dataset: Dataset, encoder: Encoder, card: EncoderCard, run: RunFolder
) -> FinetuneTrainer:
    """What a run trains and on which batches: cached features, features encoded anew, or pixels."""
    seed_networks(config.seed, STAGE)
    policy = Policy(encoder.dim, dataset.action_dim, config.hidden_dim).to(dataset.t.device)
    generator = stream_generator(config.seed, STAGE, "batches")
    corruption, returns = CorruptionConfig.fill(card.corruption), _returns(config)
    frozen = FrozenEncoder(encoder, dataset, corruption, config.shift, config.precision, config.seed)
    encode = partial(frozen.episode, view=frozen.view(0))
    sampler: FeatureSampler | ExactSampler | TransitionSampler
    if card.end_to_end:
        view = View(dataset, corruption, config.shift, config.seed, STAGE)
        sampler = TransitionSampler(view, config.batch_size, generator, returns.n_step, returns.gamma)
    elif config.views:
        histories = Histories(dataset, config.memory, returns.n_step, config.seed)
        features = encode_views(frozen, histories, config.views, FeatureFile(run.path, run.inputs))
        policy.standardise.fit(features)
        _probe(features, dataset, run)
        encode = partial(_cached, features, dataset)
        sampler = FeatureSampler(histories, features, config.batch_size, returns.n_step, returns.gamma, generator)
    else:
        sampler = ExactSampler(frozen, config.memory, config.batch_size, returns.n_step, returns.gamma, generator)
        policy.standardise.fit(torch.cat([sampler.sample().z for _ in range(4)]))
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
    return features[0, int(dataset.episode_start[number]) : int(dataset.episode_end[number])].float()


def _probe(features: torch.Tensor, dataset: Dataset, run: RunFolder) -> None:
    """Write how well the first view tells the simulator state, where the set stores it."""
    if dataset.physics is None or dataset.task is None or (run.path / "probe.json").exists():
        return
    arrays = features[0, : dataset.num_rows].float().cpu().numpy(), dataset.physics, dataset.episode.cpu().numpy()
    errors = probe_state(*arrays, layout_of(TASKS.named(dataset.task)))
    tell_probe(run.path / "encoder", errors)
    write_json(run.path / "probe.json", errors)


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
        self._episodes: Path | None = None
        """Rows of the run that it is part of."""

    def run(self, run: RunFolder) -> None:
        """Train to the end, from the newest checkpoint if there is one."""
        config = self.config
        title = f"finetune {config.algorithm} on {self.card.method}"
        self.reference.write(run.path)
        told = {"labels": _labels(config, self.card), "card": asdict(self.card)}
        self._episodes = run.path / "episodes.csv"
        with training(run, self, title, config.updates, "updates", **told) as loop:
            drop_episodes_after(self._episodes, self.step)
            if self.step and loop.due(config.eval_every):
                self._evaluate(run, loop)
            while self.step < config.updates:
                loop.add(self.algorithm.update(self.sampler.sample()))  # type: ignore[arg-type]
                self.step += 1
                if loop.due(config.log_every):
                    loop.log()
                evaluates = loop.due(config.eval_every)
                loop.step_done(save=evaluates or self.step % config.checkpoint_every == 0)
                if evaluates:
                    self._evaluate(run, loop)
        if self.path:
            self.reference.with_path_error(self.path.action_error(self.algorithm.policy)).write(run.path)
        FeatureFile(run.path, run.inputs).remove()
        write_json(run.path / "render.json", render_info(self.card.task))
        run.finish(updates=self.step)

    def _require_evaluations(self, path: Path) -> None:
        """Raise UserError if rows of an evaluation before the newest are gone: the run would end without them."""
        found = Counter(row["step"] for row in episodes_until(path, self.step))
        due = range(self.config.eval_every, self.step, self.config.eval_every)
        missing = [step for step in due if found[step] < self.config.eval_episodes]
        if missing:
            raise UserError(f"{path}: lacks the evaluation at update {missing[0]}; restore it or start another run")

    def _evaluation(self, path: Path) -> list[Row]:
        """The rows of the evaluation at the present step; none if there is none or the run was cut while it went on."""
        rows = [row for row in read_episodes(path) if row["step"] == self.step]
        return rows if len(rows) == len(self._evaluated_under()) * self.config.eval_episodes else []

    def _evaluated_under(self) -> list[CorruptionConfig]:
        """The corruptions of the evaluation at the present step; the run's own comes first."""
        own = CorruptionConfig.fill(self.card.corruption)
        clean = self.config.eval_clean and self.step == self.config.updates
        return own_and_none(own) if clean else [own]

    def _evaluate(self, run: RunFolder, loop: Loop) -> None:
        """Evaluate the present policy, unless that is done, and log the scores.

        Its checkpoint is kept: while it plays, a signal need not wait.
        """
        path = run.path / "episodes.csv"
        if not self._evaluation(path):
            with interrupt.at_once():
                drop_episodes_after(path, self.step - 1)
                self._play(run)
        row = scores_by_corruption(self._evaluation(path))
        loop.log_evaluation(row)
        loop.show(score=row[f"{EVALUATION}score/{self._evaluated_under()[0].corruption}"])

    def _play(self, run: RunFolder) -> None:
        """Keep a film of the first episode, then append the rows of all."""
        config = self.config
        self.algorithm.policy.save(run.path / "policy")
        if isinstance(self.algorithm, EndToEnd):
            save_encoder(run.path / "encoder", self.algorithm.encoder, self.card)
        task, under, actor = TASKS.named(self.card.task), self._evaluated_under(), self.reference.actor_file
        jobs = [
            EpisodeJob(
                encoder=run.path / "encoder",
                policy=run.path / "policy",
                version=self.step,
                task=task,
                corruption=corruption,
                episode=episode,
                film=episode == 0 and corruption is under[0],
                length=min(config.eval_length, task.decisions),
                actor=actor,
            )
            for corruption in under
            for episode in range(config.eval_episodes)
        ]
        episodes = evaluate(jobs, config.workers)
        rows = episode_rows(episodes, _labels(config, self.card) | {"step": self.step})
        if episodes[0].film is not None:
            with replacing_file(run.path / "film.npz") as fresh, fresh.open("wb") as file:
                np.savez_compressed(file, **episodes[0].film)  # type: ignore[arg-type]
        append_episodes(run.path / "episodes.csv", rows)

    def state(self) -> dict[str, Any]:
        """Everything needed to go on to the bit."""
        parts = {"algorithm": self.algorithm.state_dict(), "sampler": self.sampler.state_dict()}
        return {"step": self.step} | parts

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from `state`."""
        self.step = state["step"]
        if self._episodes is not None:  # before anything of the run is changed
            self._require_evaluations(self._episodes)
        self.algorithm.load_state_dict(state["algorithm"])
        self.sampler.load_state_dict(state["sampler"])


def scores_by_corruption(rows: list[Row]) -> dict[str, float]:
    """Mean return and score of an evaluation's episodes, by the corruption they were played under: a row of metrics."""
    return {
        f"{EVALUATION}{measure}/{under}": float(
            np.mean([row[measure] for row in rows if row["evaluated_under"] == under])
        )
        for under in dict.fromkeys(row["evaluated_under"] for row in rows)
        for measure in ("return", "score")
    }


def _labels(config: FinetuneConfig, card: EncoderCard) -> dict[str, Any]:
    """The columns that name a run's rows."""
    return {
        "method": card.method,
        "task": card.task,
        "quality": card.quality,
        "corruption": card.corruption["corruption"],
        "algorithm": config.algorithm,
        "seed": config.seed,
    }


def _keep_encoder(config: FinetuneConfig, run: Path) -> None:
    """Copy the encoder into the run, so that the run can be evaluated wherever it is moved; its timing, too."""
    source = config.encoder
    if (run / "encoder" / CONFIG).exists():
        return
    timing = source.parent / "timing.json"
    if timing.exists():
        write_json(run / "pretrain_timing.json", read_json(timing))
    changes = config.memory.encoder_changes if isinstance(config.memory, HistoryOptions) else {}
    copy_encoder(source, run / "encoder", changes)

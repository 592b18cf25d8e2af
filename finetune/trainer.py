"""One fine-tuning run: inputs, algorithm, batches, evaluation and output files."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
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
from vd4rl_pomdp.core.errors import refuse_outside
from vd4rl_pomdp.core.hardware import pick_device, set_products, warn_of_busy_cores
from vd4rl_pomdp.core.registry import warn_of_other_code
from vd4rl_pomdp.core.streams import random_stream, seed_networks
from vd4rl_pomdp.core.tasks import TASKS, UNKNOWN_QUALITY, DMCTask
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import Dataset, TransitionSampler, View, open_dataset
from vd4rl_pomdp.data.folder import read_plan
from vd4rl_pomdp.data.parity import render_info
from vd4rl_pomdp.data.reference import Reference
from vd4rl_pomdp.envs.dmc import observed_states
from vd4rl_pomdp.envs.make import layout_of
from vd4rl_pomdp.nn.encoder_folder import (
    FILES_OF_RUN,
    copy_encoder,
    encoder_hash,
    load_encoder,
    read_record,
    record_probe,
    save_encoder,
)
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
from vd4rl_pomdp.runs.outputs import refuse_inside
from vd4rl_pomdp.runs.run import RunFolder

RESULTS = ("policy/config.json", "policy/model.safetensors", EPISODES_FILE, *FILES_OF_RUN)
"""Files of a finished run."""
FEATURES_FILE = "features.npy"
PATH_EPISODES = 20
"""Maximum episodes for the error on the data's own path, evenly spaced among those with at least one decision."""
STANDARDISED_BY = 1024
"""Minimum transitions for estimating feature means and standard deviations without cached features (`--views 0`)."""


class FinetuneTrainer:
    """One run: its inputs; once built, its algorithm and batches; and its results."""

    algorithm: Algorithm | EndToEnd
    sampler: FeatureSampler | ExactSampler | TransitionSampler
    loop: Loop
    """Set while training."""

    def __init__(self, config: FinetuneConfig, datasets: dict[Path, Dataset], words: Sequence[str] | None) -> None:
        """Read and check the inputs of a config, reusing datasets that are open. Writes nothing.

        `words` are the run's own command line, for its record.
        """
        config.check()
        refuse_inside(config.out)
        self.dataset = dataset = datasets.get(config.data) or open_dataset(config.data)
        datasets[config.data] = dataset
        dataset.require_transitions()
        self.encoder, card = load_encoder(config.encoder, dataset.task, dataset.action_dim, dataset.frame_size)
        refuse_outside(config, shift=(0, dataset.frame_size - 1))
        self.config = config = as_trained(config, card.end_to_end, self.encoder.memory is not None, card.task)
        self._changes = config.memory.encoder_changes if isinstance(config.memory, HistoryOptions) else {}
        self.encoder.config = replace(self.encoder.config, **self._changes)
        if self.encoder.reads_state:
            dataset.require_states()
        self.device = pick_device(config.device)
        untold = card.quality if card.data == dataset.fingerprint else UNKNOWN_QUALITY
        self.card = replace(card, quality=dataset.quality or untold)  # rows carry the quality of the policy's dataset
        inputs = {"data": dataset.fingerprint, "encoder": encoder_hash(config.encoder)}
        self._pretrained = read_record(config.encoder)
        plan = read_plan(config.data)
        self.run = RunFolder(config.out, STAGE, config, inputs, RESULTS, self._pretrained.parts, plan, words)
        self.step = 0
        self.settle: Callable[[], None] = lambda: None
        """Brings algorithm and sampler up to date when a stack makes the updates."""

    @property
    def labels(self) -> dict[str, Any]:
        """Columns that identify the run's rows."""
        card, config = self.card, self.config
        before = {"method": card.method, "task": card.task, "quality": card.quality}
        own = {"algorithm": config.algorithm, "seed": config.seed}
        return before | {"corruption": card.corruption["corruption"]} | own

    def build(self) -> None:
        """Create algorithm and batches: of cached features, of features encoded on the fly, or of pixels.

        Labels, encoder and features are written into the run's folder, which must be owned.
        """
        set_products(self.device, self.config.precision)
        config, card, run = self.config, self.card, self.run
        parts, what = self._pretrained.parts, "it was pretrained; pretrain it again"
        warn_of_other_code(config.encoder, vars(self._pretrained), parts, what)
        device, dataset, encoder = self.device, self.dataset.to(self.device), self.encoder.to(self.device)
        write_json(run.path / LABELS_FILE, self.labels)
        if not all((run.path / name).exists() for name in FILES_OF_RUN):
            # copied, with the pretraining's timing, so that the run can be moved and evaluated anywhere
            before = config.encoder.parent  # a pretraining run, or a fine-tuning run on its encoder
            timing = before / (PRETRAIN_TIMING_FILE if (before / LABELS_FILE).exists() else TIMING_FILE)
            if timing.exists():
                write_json(run.path / PRETRAIN_TIMING_FILE, read_json(timing))
            copy_encoder(config.encoder, run.path / "encoder", self._changes)
        seed_networks(config.seed, STAGE)
        policy = Policy(encoder.dim, dataset.action_dim, config.hidden_dim).to(device)
        draws, noise = (random_stream(config.seed, STAGE, name, device=device) for name in ("batches", "noise"))
        corruption = CorruptionConfig.fill(card.corruption)  # as in pretraining: it is part of the environment
        returns = config.options if isinstance(config.options, ReturnOptions) else ReturnOptions()
        frozen = FrozenEncoder(encoder, dataset, corruption, config.shift, config.precision, config.seed_of_views)
        encode: Callable[[int], torch.Tensor] = partial(frozen.episode, view=frozen.view(0))
        if card.end_to_end:
            view = View(dataset, corruption, config.shift, config.seed_of_views, STAGE)
            self.sampler = TransitionSampler(view, config.batch_size, draws, returns.n_step, returns.gamma)
        elif config.views:
            histories = Histories(dataset, config.memory, returns.n_step, config.seed_of_views)
            features = encode_views(frozen, histories, config.views, run.path / FEATURES_FILE, run.inputs["encoder"])
            policy.standardise.fit(features)
            self._probe(features)
            encode = lambda number: features[0, dataset.rows_of(number)].float()  # noqa: E731, of the first view
            sizes = config.batch_size, returns.n_step, returns.gamma
            self.sampler = FeatureSampler(histories, features, *sizes, draws)
        else:
            sizes = config.batch_size, returns.n_step, returns.gamma
            self.sampler = exact = ExactSampler(frozen, config.memory, *sizes, draws)
            batches = math.ceil(STANDARDISED_BY / config.batch_size)
            policy.standardise.fit(torch.cat([exact.sample().z for _ in range(batches)]))
        kind = ALGORITHMS.named(config.algorithm)
        algorithm = kind(policy, config.options, config.learning_rate, config.updates, noise)
        self.algorithm = EndToEnd(algorithm, encoder, config) if card.end_to_end else algorithm
        self.reference = Reference.of(dataset)
        actor = self.reference.actor_file if dataset.physics is not None else None
        self._path_error = partial(path_error, dataset, read_actor(actor), encode) if actor else None

    def _probe(self, features: torch.Tensor) -> None:
        """Write how well the first view predicts the simulator state, if the task is known, states are stored, and an
        episode can be held out."""
        dataset, path = self.dataset, self.run.path
        if dataset.physics is None or dataset.num_episodes < 2 or dataset.task is None or dataset.task not in TASKS:
            return
        if (path / PROBE_FILE).exists():
            record_probe(path / "encoder", read_json(path / PROBE_FILE))
            return
        arrays = features[0, : dataset.num_rows].float().cpu().numpy(), dataset.physics, dataset.episode.cpu().numpy()
        errors = probe_state(*arrays, layout_of(TASKS.named(dataset.task)))
        record_probe(path / "encoder", errors)
        write_json(path / PROBE_FILE, errors)

    def begin(self, title: str) -> AbstractContextManager[Loop]:
        """Open the training loop, resuming from the newest checkpoint. No progress is shown without a title."""
        self.reference.write(self.run.path)
        if self.card.end_to_end:
            warn_of_busy_cores(self.device)
        total, card = self.config.updates, asdict(self.card)
        return training(self.run, self, title, total, "updates", labels=self.labels, card=card)

    def resume(self) -> None:
        """Drop evaluations newer than the checkpoint, and repeat one that was interrupted right after it."""
        drop_episodes_after(self.run.path / EPISODES_FILE, self.step)  # left by a checkpoint that was lost
        if self.step and self.loop.due(self.config.eval_every):
            self.evaluate()

    def finish(self) -> None:
        path = self.run.path
        if self._path_error:
            self.reference.with_path_error(self._path_error(self.algorithm.policy)).write(path)
        (path / FEATURES_FILE).unlink(missing_ok=True)
        if self.config.eval_episodes:
            write_json(path / RENDER_FILE, render_info(self.card.task))
        gamma = getattr(self.config.options, "gamma", None)
        critic = critic_of(read_metrics(path / METRICS_FILE), self.step, self.reference.mean_reward, gamma)
        write_json(path / CRITIC_FILE, critic)
        self.run.finish(updates=self.step)

    def evaluate(self) -> None:
        """Save this step's policy, play its episodes unless their rows exist, and log the scores.

        The step's checkpoint is saved before, so signals may interrupt the episodes.

        Raises:
            FloatingPointError: a weight is not finite.
        """
        run, loop, config = self.run, self.loop, self.config
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
                rows = self._play(under)
        scores = {
            f"{EVALUATION}{measure}/{name}": float(np.mean([r[measure] for r in rows if r["evaluated_under"] == name]))
            for name in dict.fromkeys(row["evaluated_under"] for row in rows)
            for measure in ("return", "score")
        }
        loop.log_evaluation(scores)
        loop.show(score=scores[f"{EVALUATION}score/{own.corruption}"])

    def _play(self, under: list[tuple[CorruptionConfig, int]]) -> list[Row]:
        """Play the given number of episodes under each corruption, save a film of the first, then append all rows."""
        run, config, task = self.run, self.config, TASKS.named(self.card.task)
        drop_episodes_after(run.path / EPISODES_FILE, self.step - 1)
        jobs = [
            job
            for number, (one, count) in enumerate(under)
            for job in jobs_of(run.path, task, [one], count, config.eval_length, film=not number)
        ]
        episodes = evaluate(jobs, config.workers)
        rows = episode_rows(episodes, self.labels | {"step": self.step})
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

"""`vd4rl-pomdp finetune`: a frozen encoder, features of the set, an algorithm, and its evaluations."""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack
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
from finetune.features import STAGE, ExactSampler, FeatureSampler, FrozenEncoder, StackedSampler, encode_views
from finetune.histories import Histories, HistoryOptions
from finetune.path import DataPath
from finetune.stack import Stack
from vd4rl_pomdp.core.errors import UserError, flag_of, refuse_outside
from vd4rl_pomdp.core.options import flat
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
from vd4rl_pomdp.runs.device import pick_device, set_products
from vd4rl_pomdp.runs.episodes import append_episodes, drop_episodes_after, read_episodes
from vd4rl_pomdp.runs.files import Row, read_json, replacing_file, write_json
from vd4rl_pomdp.runs.loop import Loop, in_step, save, training
from vd4rl_pomdp.runs.metrics import EVALUATION, read_metrics
from vd4rl_pomdp.runs.outputs import refuse_inside
from vd4rl_pomdp.runs.replay import Replay
from vd4rl_pomdp.runs.run import RunFolder
from vd4rl_pomdp.runs.workers import kept_workers

RESULTS = ("policy/config.json", "policy/model.safetensors", EPISODES_FILE, *FILES_OF_RUN)
"""What a finished run holds."""
FEATURES_FILE = "features.npy"
STANDARDISED_BY = 1024
"""Least transitions whose representations give their means and deviations, where none are kept (`--views 0`)."""


def finetune(config: FinetuneConfig) -> RunFolder:
    """Run the stage, or resume it; writes the policy and `episodes.csv` into the run's folder."""
    return finetune_all([config])[0]


def finetune_all(
    configs: Sequence[FinetuneConfig], words: Sequence[Sequence[str] | None] | None = None
) -> list[RunFolder]:
    """Run the stage, or resume it, for several runs at once, whose updates are one (see `finetune.stack`).

    Args:
        configs: of each run; they may differ in seeds, encoder, data, and how they are evaluated.
        words: of each run's own command, for its record.

    Raises:
        UserError: settings that cannot work, or runs that do not stack.
        FloatingPointError: a run diverged; the others were trained to their end.
    """
    datasets: dict[Path, Dataset] = {}
    asked = [_Asked(config, datasets, own) for config, own in zip(configs, words or [None] * len(configs), strict=True)]
    if len(asked) > 1:
        _refuse_unlike(asked)
    with ExitStack() as owned:
        for one in asked:
            owned.enter_context(one.run)
        train([one.trainer() for one in asked if not one.run.finished])
    return [one.run for one in asked]


class _Asked:
    """A run that was asked for, and what it reads."""

    def __init__(self, config: FinetuneConfig, datasets: dict[Path, Dataset], words: Sequence[str] | None) -> None:
        """Read what a config names, sets only where they are not among those that were opened; nothing is written."""
        config.check()
        refuse_inside(config.out)
        self.dataset = dataset = datasets.get(config.data) or open_dataset(config.data)
        datasets[config.data] = dataset
        dataset.require_transitions()
        self.encoder, card = load_encoder(config.encoder, dataset.task, dataset.action_dim, dataset.frame_size)
        refuse_outside(config, shift=(0, dataset.frame_size - 1))
        remembers, decisions = self.encoder.memory is not None, TASKS.named(card.task).decisions
        self.config = config = as_trained(config, card.end_to_end, remembers, decisions)
        if isinstance(config.memory, HistoryOptions):
            self.encoder.config = replace(self.encoder.config, **config.memory.encoder_changes)
        if self.encoder.reads_state:
            dataset.require_states()
        self.device = pick_device(config.device)
        untold = card.quality if card.data == dataset.fingerprint else UNKNOWN_QUALITY
        self.card = replace(card, quality=dataset.quality or untold)  # the policy's set names its rows
        inputs = {"data": dataset.fingerprint, "encoder": encoder_hash(config.encoder)}
        self.before = read_record(config.encoder)
        plan = read_plan(config.data)
        self.run = RunFolder(config.out, STAGE, config, inputs, RESULTS, self.before.parts, plan, words)

    def trainer(self) -> FinetuneTrainer:
        """What trains the run, whose folder is owned; encodes the set."""
        what = "it was pretrained; pretrain it again"
        warn_of_other_code(self.config.encoder, self.before.code, self.before.parts, what)
        write_json(self.run.path / LABELS_FILE, labels_of(self.config, self.card))
        _keep_encoder(self.config, self.run.path)
        self.dataset.to(self.device)
        return _trainer(self.config, self.dataset, self.encoder.to(self.device), self.card, self.run)


ALIKE = (
    *("algorithm", "updates", "batch_size", "hidden_dim", "learning_rate", "update_precision", "views", "device"),
    *("eval_every", "log_every", "checkpoint_every"),
)
"""Settings that runs of a stack share, besides the algorithm's options."""


def _refuse_unlike(asked: Sequence[_Asked]) -> None:
    """Raise UserError for runs that do not stack, naming two and what they differ in."""
    first = asked[0]
    for number, one in enumerate(asked):
        if one.card.end_to_end:
            raise UserError(f"{one.config.out}: {one.card.method} trains its encoder, too, and does not stack")
        if not one.config.views:
            raise UserError(f"{one.config.out}: --views 0 encodes every batch anew and does not stack")
        if any(one.config.out.resolve() == other.config.out.resolve() for other in asked[:number]):
            raise UserError(f"--out {one.config.out} is given twice: a folder holds one run")
        for (what, value), (_, other) in zip(_alike(first), _alike(one), strict=False):
            if value != other:
                raise UserError(
                    f"{first.config.out} and {one.config.out} do not stack: {what} is {value} there and {other} here; "
                    "train them by commands of their own"
                )


def _alike(asked: _Asked) -> list[tuple[str, Any]]:
    """What runs of a stack share, in words and by value; the algorithm first, which decides what options there are."""
    settings = {name: getattr(asked.config, name) for name in ALIKE} | flat(asked.config.options)
    widths = [("the representations' width", asked.encoder.dim), ("the actions' width", asked.dataset.action_dim)]
    return [(flag_of(name), value) for name, value in settings.items()] + widths


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
        features = encode_views(frozen, histories, config.views, run.path / FEATURES_FILE, run.inputs["encoder"])
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
        EndToEnd(algorithm, encoder, config) if card.end_to_end else algorithm,
        sampler,
        config,
        card,
        run,
        reference,
        path,
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
    """One run: an algorithm, its stream of batches, and where the results go."""

    loop: Loop
    """While it is trained."""

    def __init__(
        self,
        algorithm: Algorithm | EndToEnd,
        sampler: FeatureSampler | ExactSampler | TransitionSampler,
        config: FinetuneConfig,
        card: EncoderCard,
        run: RunFolder,
        reference: Reference,
        path: DataPath | None,
    ) -> None:
        self.algorithm, self.sampler = algorithm, sampler
        self.config, self.card, self.folder = config, card, run
        self.reference, self.path = reference, path
        self.step = 0
        self.settle: Callable[[], None] = lambda: None
        """Brings algorithm and sampler to the last update's state, where others make the updates."""

    def begin(self, title: str) -> AbstractContextManager[Loop]:
        """Open the loop, from the newest checkpoint if there is one; a run without a title shows no progress."""
        self.reference.write(self.folder.path)
        labels, total = labels_of(self.config, self.card), self.config.updates
        return training(self.folder, self, title, total, "updates", labels=labels, card=asdict(self.card))

    def resume(self) -> None:
        """Drop what is newer than the checkpoint, and make up for an evaluation that was cut off behind it."""
        drop_episodes_after(self.folder.path / EPISODES_FILE, self.step)  # of a checkpoint that is gone
        if self.step and self.loop.due(self.config.eval_every):
            self.evaluate()

    def finish(self) -> None:
        """Write what a trained run ends with."""
        path = self.folder.path
        if self.path:
            error = self.path.action_error(self.algorithm.policy)
            self.reference.with_path_error(error).write(path)
        (path / FEATURES_FILE).unlink(missing_ok=True)
        write_json(path / RENDER_FILE, render_info(self.card.task))
        gamma = getattr(self.config.options, "gamma", None)
        critic = critic_of(read_metrics(path / METRICS_FILE), self.step, self.reference.mean_reward, gamma)
        write_json(path / CRITIC_FILE, critic)
        self.folder.finish(updates=self.step)

    def evaluate(self) -> None:
        """Keep this step's policy, play its episodes unless their rows are there, and log the scores.

        The step's checkpoint is kept: while it plays, a signal need not wait.

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
        """Play so many episodes under each, keep a film of the first, then append the rows of all: the result."""
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
        """Everything needed to resume to the bit."""
        self.settle()
        parts = {"algorithm": self.algorithm.state_dict(), "sampler": self.sampler.state_dict()}
        return {"step": self.step} | parts

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from `state`."""
        self.step = state["step"]
        self.algorithm.load_state_dict(state["algorithm"])
        self.sampler.load_state_dict(state["sampler"])


class Updates:
    """Updates of one run, or of several at once; replayed where a GPU is."""

    def __init__(self, trainers: Sequence[FinetuneTrainer]) -> None:
        """Begin where the trainers stand."""
        first = trainers[0].algorithm
        self._algorithm: Algorithm | EndToEnd = first
        self._sampler: Any = trainers[0].sampler
        self._counting = first.algorithm if isinstance(first, EndToEnd) else first
        if len(trainers) > 1:
            stack = Stack([trainer.algorithm for trainer in trainers])  # type: ignore[misc]
            self._sampler = sampler = StackedSampler([trainer.sampler for trainer in trainers])  # type: ignore[misc]
            self._algorithm = self._counting = stack.whole
            for number, trainer in enumerate(trainers):
                trainer.settle = partial(_settle, trainer, stack, sampler, number)
        device = first.policy.standardise.mean.device
        precision = trainers[0].config.update_precision
        set_products(device, precision)
        # not cached, because weights move between the losses of an update
        self._precise = torch.autocast(device.type, torch.bfloat16, precision == "bf16", cache_enabled=False)
        streams, trained = [self._sampler.draws, self._counting.draws], [self._algorithm, self._counting]
        self._replay = Replay(self._update, device, streams, self._counting.period, trained)
        if self._replay.replays:
            self._counting.count_on(device)

    def __call__(self, made: int) -> dict[str, torch.Tensor]:
        """The update after so many: its scalars, of several runs a number each."""
        return self._replay(made % self._counting.period)

    def _update(self, turn: int) -> dict[str, torch.Tensor]:
        self._counting.take_turn(turn)
        batch = self._sampler.sample()
        with self._precise:
            return self._algorithm.update(batch)


def _settle(trainer: FinetuneTrainer, stack: Stack, sampler: StackedSampler, number: int) -> None:
    stack.settle(number)
    trainer.sampler.draws.set_state(sampler.draws.get_state(number))


def train(trainers: Sequence[FinetuneTrainer]) -> None:
    """Train runs to their end; those after the same update together, and those that are behind the others first.

    Raises:
        FloatingPointError: one diverged, and is marked; the others were trained to their end.
    """
    left, diverged = list(trainers), list[FloatingPointError]()

    def each(act: Callable[[FinetuneTrainer], None], group: Sequence[FinetuneTrainer]) -> None:
        for trainer in [one for one in group if one in left]:
            try:
                act(trainer)
            except FloatingPointError as error:
                trainer.folder.mark_diverged(trainer.step, str(error))
                diverged.append(error)
                left.remove(trainer)
                if left:
                    print(f"warning: training diverged, {error}; the other runs go on", file=sys.stderr)

    with ExitStack() as opened:
        opened.enter_context(kept_workers())
        for trainer in trainers:
            title = f"finetune {trainer.config.algorithm} on {trainer.card.method}" if trainer is trainers[0] else ""
            more = f" and {len(trainers) - 1} more" if title and len(trainers) > 1 else ""
            trainer.loop = opened.enter_context(trainer.begin(title + more))
        each(FinetuneTrainer.resume, trainers)
        while behind := [one for one in left if one.step < one.config.updates]:
            first = min(one.step for one in behind)
            group = [one for one in behind if one.step == first]
            until = min((one.step for one in left if one.step > first), default=behind[0].config.updates)
            updates, settings = Updates(group), group[0].config
            for step in in_step(loops := [one.loop for one in group], until):
                logs = updates(step - 1)
                for number, one in enumerate(group):
                    if one in left:
                        one.loop.add(logs if len(group) == 1 else {name: value[number] for name, value in logs.items()})
                        one.step = step
                if loops[0].due(settings.log_every):
                    each(lambda one: one.loop.log(), group)
                if loops[0].due(settings.eval_every):
                    save([one.loop for one in group if one in left])  # first: a kill while it plays costs no update
                    each(FinetuneTrainer.evaluate, group)
                loops[:] = [one.loop for one in group if one in left]
            for one in group:
                one.settle()
                one.settle = lambda: None
    for trainer in left:
        trainer.finish()
    if diverged:
        raise diverged[0]


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

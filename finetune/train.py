"""`vd4rl-pomdp finetune`: trains one run, or several at once, each with its own `finetune.trainer`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from finetune.algorithms import Algorithm
from finetune.config import FinetuneConfig, as_trained
from finetune.end_to_end import EndToEnd
from finetune.features import STAGE, StackedSampler
from finetune.histories import HistoryOptions
from finetune.stack import Stack
from finetune.trainer import RESULTS, FinetuneTrainer, make_trainer
from vd4rl_pomdp.core.errors import UserError, flag_of, refuse_outside
from vd4rl_pomdp.core.options import flat
from vd4rl_pomdp.core.registry import warn_of_other_code
from vd4rl_pomdp.core.tasks import UNKNOWN_QUALITY
from vd4rl_pomdp.data import Dataset, open_dataset
from vd4rl_pomdp.data.folder import read_plan
from vd4rl_pomdp.nn.encoder_folder import encoder_hash, load_encoder, read_record
from vd4rl_pomdp.runs.device import pick_device, set_products
from vd4rl_pomdp.runs.loop import in_step, save
from vd4rl_pomdp.runs.outputs import refuse_inside
from vd4rl_pomdp.runs.replay import Replay
from vd4rl_pomdp.runs.run import RunFolder
from vd4rl_pomdp.runs.workers import kept_workers


def finetune(config: FinetuneConfig) -> RunFolder:
    """Run or resume the stage; writes the policy and `episodes.csv` into the run's folder."""
    return finetune_all([config])[0]


def finetune_all(
    configs: Sequence[FinetuneConfig], words: Sequence[Sequence[str] | None] | None = None
) -> list[RunFolder]:
    """Run or resume the stage for several runs, with shared updates (see `finetune.stack`).

    They may differ in seeds, encoder, data and evaluation; `words` are each run's command line, for its record.

    Raises:
        UserError: invalid settings, or runs that cannot be stacked.
        FloatingPointError: a run diverged; the others were trained to the end.
    """
    datasets: dict[Path, Dataset] = {}
    commands = words or [None] * len(configs)
    prepared = [_Prepared(config, datasets, own) for config, own in zip(configs, commands, strict=True)]
    if len(prepared) > 1:
        _refuse_unlike(prepared)
    with ExitStack() as owned:
        for one in prepared:
            owned.enter_context(one.run)
        train([one.trainer() for one in prepared if not one.run.finished])
    return [one.run for one in prepared]


class _Prepared:
    """A requested run and its inputs."""

    def __init__(self, config: FinetuneConfig, datasets: dict[Path, Dataset], words: Sequence[str] | None) -> None:
        """Read the inputs of a config, reusing datasets that are open. Writes nothing."""
        config.check()
        refuse_inside(config.out)
        self.dataset = dataset = datasets.get(config.data) or open_dataset(config.data)
        datasets[config.data] = dataset
        dataset.require_transitions()
        self.encoder, card = load_encoder(config.encoder, dataset.task, dataset.action_dim, dataset.frame_size)
        refuse_outside(config, shift=(0, dataset.frame_size - 1))
        remembers = self.encoder.memory is not None
        self.config = config = as_trained(config, card.end_to_end, remembers, card.task)
        if isinstance(config.memory, HistoryOptions):
            self.encoder.config = replace(self.encoder.config, **config.memory.encoder_changes)
        if self.encoder.reads_state:
            dataset.require_states()
        self.device = pick_device(config.device)
        untold = card.quality if card.data == dataset.fingerprint else UNKNOWN_QUALITY
        self.card = replace(card, quality=dataset.quality or untold)  # rows carry the quality of the policy's dataset
        inputs = {"data": dataset.fingerprint, "encoder": encoder_hash(config.encoder)}
        self.before = read_record(config.encoder)
        plan = read_plan(config.data)
        self.run = RunFolder(config.out, STAGE, config, inputs, RESULTS, self.before.parts, plan, words)

    def trainer(self) -> FinetuneTrainer:
        """Create the run's trainer, which encodes the dataset. The run's folder must be owned."""
        what = "it was pretrained; pretrain it again"
        warn_of_other_code(self.config.encoder, vars(self.before), self.before.parts, what)
        self.dataset.to(self.device)
        return make_trainer(self.config, self.dataset, self.encoder.to(self.device), self.card, self.run)


ALIKE = (
    *("algorithm", "updates", "batch_size", "hidden_dim", "learning_rate", "update_precision", "views", "device"),
    *("eval_every", "log_every", "checkpoint_every"),
)
"""Settings that all runs of a stack must share, besides the algorithm's options."""


def _refuse_unlike(prepared: Sequence[_Prepared]) -> None:
    """Raise UserError for runs that cannot be stacked, naming two of them and the difference."""
    first = prepared[0]
    for number, one in enumerate(prepared):
        if one.card.end_to_end:
            raise UserError(
                f"{one.config.out}: {one.card.method} also trains its encoder and cannot be stacked; train it by itself"
            )
        if not one.config.views:
            raise UserError(
                f"{one.config.out}: --views 0 encodes every batch and cannot be stacked; train it by itself"
            )
        if any(one.config.out.resolve() == other.config.out.resolve() for other in prepared[:number]):
            raise UserError(f"--out {one.config.out} is given twice: a folder holds one run")
        for (what, value), (_, other) in zip(_alike(first), _alike(one), strict=False):
            if value != other:
                raise UserError(
                    f"{first.config.out} and {one.config.out} cannot be stacked: {what} is {value} and {other}; "
                    "train them by separate commands"
                )


def _alike(prepared: _Prepared) -> list[tuple[str, Any]]:
    """What runs of a stack must share, as (description, value). The algorithm comes first: it decides the options."""
    settings = {name: getattr(prepared.config, name) for name in ALIKE} | flat(prepared.config.options)
    widths = [("the representations' width", prepared.encoder.dim), ("the actions' width", prepared.dataset.action_dim)]
    return [(flag_of(name), value) for name, value in settings.items()] + widths


ONE_THREAD_UNITS = 512
"""Up to this width, one CPU thread updates a single policy on cached features at least as fast as several, which wait
for each other between small products."""


class Updates:
    """Updates of one run or a stack, replayed as CUDA graphs on a GPU."""

    def __init__(self, trainers: Sequence[FinetuneTrainer]) -> None:
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
        # no cache: weights change between the losses of an update
        self._precise = torch.autocast(device.type, torch.bfloat16, precision == "bf16", cache_enabled=False)
        streams, trained = [self._sampler.draws, self._counting.draws], [self._algorithm, self._counting]
        self._replay = Replay(self._update, device, streams, self._counting.period, trained)
        if self._replay.replays:
            self._counting.count_on(device)
        settings = trainers[0].config
        small = settings.views > 0 and settings.hidden_dim <= ONE_THREAD_UNITS and len(trainers) == 1
        self._one_thread = small and device.type == "cpu"

    def __call__(self, made: int) -> dict[str, torch.Tensor]:
        """Do the update that follows `made` updates. Returns scalars, (S,) for a stack."""
        turn = made % self._counting.period
        if not self._one_thread:
            return self._replay(turn)
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            return self._replay(turn)
        finally:
            torch.set_num_threads(threads)

    def _update(self, turn: int) -> dict[str, torch.Tensor]:
        self._counting.take_turn(turn)
        batch = self._sampler.sample()
        with self._precise:
            return self._algorithm.update(batch)


def _settle(trainer: FinetuneTrainer, stack: Stack, sampler: StackedSampler, number: int) -> None:
    stack.settle(number)
    trainer.sampler.draws.set_state(sampler.draws.get_state(number))


def train(trainers: Sequence[FinetuneTrainer]) -> None:
    """Train runs to the end: those at the same update together, those that are behind first.

    Raises:
        FloatingPointError: a run diverged and is marked; the others were trained to the end.
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
                    save([one.loop for one in group if one in left])  # before playing: a kill then costs no update
                    each(FinetuneTrainer.evaluate, group)
                loops[:] = [one.loop for one in group if one in left]
            for one in group:
                one.settle()
                one.settle = lambda: None
    for trainer in left:
        trainer.finish()
    if diverged:
        raise diverged[0]

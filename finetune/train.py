"""`vd4rl-pomdp finetune`: trains one run, or several at once, each a `finetune.trainer.FinetuneTrainer`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import torch

from finetune.config import FinetuneConfig
from finetune.end_to_end import EndToEnd
from finetune.features import ExactSampler, StackedSampler
from finetune.stack import Stack
from finetune.trainer import FinetuneTrainer
from vd4rl_pomdp.core.errors import UserError, flag_of
from vd4rl_pomdp.core.hardware import set_products, warn_of_slow_bf16
from vd4rl_pomdp.core.options import flat
from vd4rl_pomdp.data import Dataset
from vd4rl_pomdp.runs.loop import in_step, save
from vd4rl_pomdp.runs.replay import Replay
from vd4rl_pomdp.runs.run import RunFolder
from vd4rl_pomdp.runs.workers import kept_workers


def finetune(config: FinetuneConfig) -> RunFolder:
    """Run or resume the stage; writes the policy and `episodes.csv` into the run's folder."""
    return finetune_all([config])[0]


def finetune_all(
    configs: Sequence[FinetuneConfig], words: Sequence[Sequence[str] | None] | None = None
) -> list[RunFolder]:
    """Run or resume the stage for several runs in step; on a GPU with shared updates (see `finetune.stack`).

    They may differ in seeds, encoder, data and evaluation; `words` are each run's command line, for its record.

    Raises:
        UserError: invalid settings, or runs that cannot be stacked.
        FloatingPointError: a run diverged; the others were trained to the end.
    """
    datasets: dict[Path, Dataset] = {}
    commands = words or [None] * len(configs)
    trainers = [FinetuneTrainer(config, datasets, own) for config, own in zip(configs, commands, strict=True)]
    if len(trainers) > 1:
        _refuse_unlike(trainers)
    with ExitStack() as owned:
        for one in trainers:
            owned.enter_context(one.run)
        unfinished = [one for one in trainers if not one.run.finished]
        for one in unfinished[:1]:  # once for a stack, before its features are encoded
            warn_of_slow_bf16(one.device, precision=one.config.precision, update_precision=one.config.update_precision)
        for one in unfinished:
            one.build()
        train(unfinished)
    return [one.run for one in trainers]


ALIKE = (
    *("algorithm", "updates", "batch_size", "hidden_dim", "learning_rate", "update_precision", "views", "device"),
    *("eval_every", "log_every", "checkpoint_every"),
)
"""Settings that all runs of a stack must share, besides the algorithm's options."""


def _refuse_unlike(trainers: Sequence[FinetuneTrainer]) -> None:
    """Raise UserError for runs that cannot be stacked, naming two of them and the difference."""
    first = trainers[0]
    for number, one in enumerate(trainers):
        if one.card.end_to_end:
            raise UserError(
                f"{one.config.out}: {one.card.method} also trains its encoder and cannot be stacked; train it by itself"
            )
        if not one.config.views:
            raise UserError(
                f"{one.config.out}: --views 0 encodes every batch and cannot be stacked; train it by itself"
            )
        if any(one.config.out.resolve() == other.config.out.resolve() for other in trainers[:number]):
            raise UserError(f"--out {one.config.out} is given twice: a folder holds one run")
        for (what, value), (_, other) in zip(_alike(first), _alike(one), strict=False):
            if value != other:
                raise UserError(
                    f"{first.config.out} and {one.config.out} cannot be stacked: {what} is {value} and {other}; "
                    "train them by separate commands"
                )


def _alike(trainer: FinetuneTrainer) -> list[tuple[str, Any]]:
    """What runs of a stack must share, as (description, value). The algorithm comes first: it decides the options."""
    settings = {name: getattr(trainer.config, name) for name in ALIKE} | flat(trainer.config.options)
    widths = [("the representations' width", trainer.encoder.dim), ("the actions' width", trainer.dataset.action_dim)]
    return [(flag_of(name), value) for name, value in settings.items()] + widths


ONE_THREAD_UNITS = 512
"""Up to this width, one CPU thread updates a single policy on cached features at least as fast as several, which wait
for each other between small products."""


class Updates:
    """Updates of one run or a stack, replayed as CUDA graphs on a GPU."""

    def __init__(self, algorithms: Sequence[Any], samplers: Sequence[Any], config: FinetuneConfig) -> None:
        """The algorithm (or `EndToEnd`) and batches of each run, and the settings that they share."""
        self._samplers, self._stack = samplers, Stack(algorithms) if len(algorithms) > 1 else None
        self._sampler = StackedSampler(samplers) if self._stack else samplers[0]
        self._algorithm: Any = self._stack.whole if self._stack else algorithms[0]
        counting = self._algorithm.algorithm if isinstance(self._algorithm, EndToEnd) else self._algorithm
        self._counting, device = counting, counting.policy.standardise.mean.device
        set_products(device, config.update_precision)
        # no cache: weights change between the losses of an update
        bf16 = config.update_precision == "bf16"
        self._precise = torch.autocast(device.type, torch.bfloat16, bf16, cache_enabled=False)
        streams = [self._sampler.draws, counting.draws]
        obstacle = self._sampler.obstacle if isinstance(self._sampler, ExactSampler) else ""
        trained = [self._algorithm, counting]
        self._replay = Replay(self._update, device, streams, counting.period, trained, obstacle=obstacle)
        if self._replay.replays:
            counting.count_on(device)
        small = config.views > 0 and config.hidden_dim <= ONE_THREAD_UNITS and not self._stack
        self._one_thread = small and device.type == "cpu"

    def __call__(self, made: int) -> list[dict[str, torch.Tensor]]:
        """Do the update that follows `made` updates. Returns each run's scalars."""
        logs = self._logs(made % self._counting.period)
        if not self._stack:
            return [logs]
        return [{name: value[run] for name, value in logs.items()} for run in range(len(self._samplers))]

    def _logs(self, turn: int) -> dict[str, torch.Tensor]:
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

    def settle(self, number: int) -> None:
        """Write the progress of a stack's run back into its own algorithm and sampler."""
        if self._stack:
            self._stack.settle(number)
            self._samplers[number].draws.set_state(self._sampler.draws.get_state(number))


def stacks_on(device: torch.device) -> bool:
    """Whether runs share updates on a device: a CPU is as fast with one after another, which equals single runs."""
    return device.type == "cuda"


def train(trainers: Sequence[FinetuneTrainer]) -> None:
    """Train runs to the end: those at the same update in step, those that are behind first.

    Raises:
        FloatingPointError: a run diverged and is marked; the others were trained to the end.
    """
    left, diverged = list(trainers), list[FloatingPointError]()

    def each(act: Callable[[FinetuneTrainer], None], group: Sequence[FinetuneTrainer]) -> None:
        for trainer in [one for one in group if one in left]:
            try:
                act(trainer)
            except FloatingPointError as error:
                trainer.run.mark_diverged(trainer.step, str(error))
                diverged.append(error)
                left.remove(trainer)
                if left:
                    print(f"warning: training diverged, {error}; the other runs continue", file=sys.stderr)

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
            settings = group[0].config
            updates = []
            for members in [group] if stacks_on(group[0].device) else [[one] for one in group]:
                shared = Updates([one.algorithm for one in members], [one.sampler for one in members], settings)
                updates.append((members, shared))
                for number, one in enumerate(members):
                    one.settle = partial(shared.settle, number)
            for step in in_step(loops := [one.loop for one in group], until):
                for members, shared in updates:
                    if any(one in left for one in members):
                        for one, logs in zip(members, shared(step - 1), strict=True):
                            if one in left:
                                one.loop.add(logs)
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

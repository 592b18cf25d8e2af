"""A fine-tuning's settings as its encoder and its set let them be."""

from __future__ import annotations

from dataclasses import replace

from finetune.algorithms import ReturnOptions
from finetune.config import FinetuneConfig
from vd4rl_pomdp.core.errors import UserError, flag_of, refuse_number
from vd4rl_pomdp.core.options import NO_OPTIONS, flat


def as_trained(config: FinetuneConfig, method: str, algorithm: str, remembers: bool, decisions: int) -> FinetuneConfig:
    """The settings as an encoder's policy is trained with them: what it cannot read is no part of them.

    An evaluation of the default length is one of whole episodes, however long they are.

    Args:
        config: the settings that were told.
        method: the encoder's.
        algorithm: the algorithm that the method brings along, if it has no frozen stage; else empty.
        remembers: whether the encoder has a memory.
        decisions: of an episode of the task.

    Raises:
        UserError: a setting that was not the default is not read.
    """
    if config.eval_length == FinetuneConfig.eval_length:
        config = replace(config, eval_length=max(config.eval_length, decisions))
    if algorithm:
        config = _end_to_end(config, algorithm)
    return config if remembers and not algorithm else _without_memory(config, method)


def _end_to_end(config: FinetuneConfig, algorithm: str) -> FinetuneConfig:
    if config.algorithm not in (FinetuneConfig.algorithm, algorithm):
        raise UserError(
            f"--algorithm {config.algorithm} is not read: the encoder is trained by {algorithm}; leave it out"
        )
    if config.views != config.usual()["views"]:
        raise UserError(f"--views is not read by the algorithm {algorithm}, which trains the encoder: leave it out")
    return config.altered(algorithm=algorithm, views=0)


def _without_memory(config: FinetuneConfig, method: str) -> FinetuneConfig:
    usual = config.usual()
    for name, value in flat(config.memory).items():
        if value != usual[name]:
            raise UserError(f"{flag_of(name)} is not read: {method} has no memory; leave it out")
    return replace(config, memory=NO_OPTIONS)


def check_n_step(config: FinetuneConfig, longest: int) -> None:
    """Raise UserError for returns over more steps than the `longest` episode has."""
    refuse_number("n_step", return_options(config).n_step, 1, max(longest, ReturnOptions.n_step))


def return_options(config: FinetuneConfig) -> ReturnOptions:
    """How returns are summed, also for an algorithm that does not look at them."""
    return config.options if isinstance(config.options, ReturnOptions) else ReturnOptions()

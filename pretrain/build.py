"""Build the objective and its encoder from a training config."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from pretrain.config import HiddenOptions, TrainingConfig, history_of
from pretrain.objectives import METHODS
from pretrain.objectives.untrained import StateOptions
from vd4rl_pomdp.core.options import flat
from vd4rl_pomdp.core.state_scale import StateScale
from vd4rl_pomdp.core.tasks import FRAME_SIZE, FRAME_STACK
from vd4rl_pomdp.nn.action_target import ActionTarget, make_action_target
from vd4rl_pomdp.nn.encoder import Encoder, EncoderConfig
from vd4rl_pomdp.nn.frame import STATE, encoder_settings
from vd4rl_pomdp.nn.memory import MemoryOptions
from vd4rl_pomdp.nn.objective import ActionOptions, Objective


def build_target(config: TrainingConfig, actions: np.ndarray) -> ActionTarget | None:
    """Build the action target from the (N, A) float32 training actions; None if the method predicts no actions."""
    options = config.options
    if not isinstance(options, ActionOptions):
        return None
    # K-means is seeded by the run: the codes it finds are part of the variance between seeds
    return make_action_target(options.action_target, actions, flat(options).get("codes", 0), config.seed)


def build_objective(
    config: TrainingConfig,
    action_dim: int,
    target: ActionTarget | None,
    states: StateScale | None = None,
    observation: tuple[int, int] = (3 * FRAME_STACK, FRAME_SIZE),
) -> Objective:
    """Build the objective of a config, with a new encoder.

    Args:
        config: the run's settings.
        action_dim: action dimension A.
        target: from `build_target`.
        states: scale of the simulator states; needed if states are an input or a regression target.
        observation: channels and image size of pixel observations, such as (9, 84).
    """
    method, memory, options = METHODS.named(config.method), {}, config.options
    shape: dict[str, Any]
    if method.reads_state or config.frame_encoder == STATE:  # raw, with noise, or standardised with hidden coordinates
        assert states is not None
        frame: dict[str, Any] = {}
        if isinstance(options, StateOptions) and (options.pose_noise or options.velocity_noise):
            frame = {"noise": states.noise(options.pose_noise, options.velocity_noise).tolist()}
        if isinstance(config.frame, HiddenOptions):
            share = config.frame.hidden_share
            frame = {"mean": states.mean.tolist(), "std": states.std.tolist(), "hidden_share": share}
        shape = {"frame_encoder": STATE, "channels": len(states.std), "size": 1, "frame_options": frame}
    else:
        channels, size = observation
        shape = {"frame_encoder": config.frame_encoder, "channels": channels, "size": size}
        shape |= encoder_settings(config.frame)
    if isinstance(config.memory, MemoryOptions):
        others = asdict(config.memory)
        hidden, m = others.pop("hidden_dim"), others.pop("m")
        past = method.past if m is None else m
        memory = {
            "history": history_of(config.method, method, getattr(config, "history", "method")),
            "use_actions": method.use_actions,
            "hidden_dim": hidden,
            "history_window": 0 if past is None else past + 1,  # the m rows of the past, and row t itself
            "memory_options": others,
        }
    encoder = Encoder(EncoderConfig(action_dim, **shape, **memory))
    return method.build(encoder, states if method.regresses_state else target, options, config.seed)

"""From a training's settings to its objective."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from types import MappingProxyType
from typing import Any

import numpy as np

from pretrain.config import TrainingConfig, history_of
from pretrain.objectives import METHODS, Method
from pretrain.objectives.untrained import StateOptions
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import Options, flat
from vd4rl_pomdp.core.state_scale import StateScale
from vd4rl_pomdp.core.tasks import FRAME_SIZE, FRAME_STACK
from vd4rl_pomdp.nn.action_target import ActionTarget, make_action_target
from vd4rl_pomdp.nn.encoder import Encoder, EncoderConfig
from vd4rl_pomdp.nn.frame import STATE, encoder_settings
from vd4rl_pomdp.nn.memory import MemoryOptions
from vd4rl_pomdp.nn.objective import ActionOptions, Objective


def build_target(config: TrainingConfig, actions: np.ndarray) -> ActionTarget | None:
    """What the action head of a config's method predicts, None for a method that has none.

    Args:
        config: the run's settings.
        actions: (N, A) float32 training actions.
    """
    options = config.options
    if not isinstance(options, ActionOptions):
        return None
    return make_action_target(options.action_target, actions, flat(options).get("codes", 0), config.seed)


def build_objective(
    config: TrainingConfig,
    action_dim: int,
    target: ActionTarget | None,
    states: StateScale | None = None,
    observation: tuple[int, int] = (3 * FRAME_STACK, FRAME_SIZE),
) -> Objective:
    """Build the objective of a config.

    Args:
        config: the run's settings.
        action_dim: width of actions.
        target: from `build_target`.
        states: scale of the simulator's states, for methods that read or regress them.
        observation: channels and size of an observation, for methods that read pixels.
    """
    method = METHODS.named(config.method)
    if method.reads_state and states is not None:
        return build_on_states(config, action_dim, target, len(states.std), _noise(config.options, states))
    channels, size = observation
    return _build(
        config,
        states if method.regresses_state else target,
        action_dim=action_dim,
        frame_encoder=config.frame_encoder,
        **encoder_settings(config.frame),
        channels=channels,
        size=size,
    )


def build_on_states(
    config: TrainingConfig,
    action_dim: int,
    target: ActionTarget | None,
    state_dim: int,
    frame_options: Mapping[str, Any] = MappingProxyType({}),
) -> Objective:
    """Build the objective of a config on states in place of pixels, whatever its method reads.

    Args:
        config: the run's settings; those of the frame encoder are not read.
        action_dim: width of actions.
        target: from `build_target`.
        state_dim: width P of the states; observations are (..., P, 1, 1).
        frame_options: what `StateFrame` is told.
    """
    return _build(
        config,
        target,
        action_dim=action_dim,
        frame_encoder=STATE,
        feature_dim=state_dim,
        frame_options=dict(frame_options),
        channels=state_dim,
        size=1,
    )


def _build(config: TrainingConfig, target: ActionTarget | StateScale | None, **shape: Any) -> Objective:
    """The objective of a config on an encoder of a given shape, with the memory that the config says."""
    method = METHODS.named(config.method)
    encoder = EncoderConfig(**shape, **_memory(config, method))
    objective = method.build(Encoder(encoder), target, config.options, config.seed)
    if isinstance(objective, Objective) and not isinstance(getattr(objective, "encoder", None), Encoder):
        raise UserError(f"the objective of the method {config.method} has no `encoder`: keep the one that it is given")
    return objective


def _noise(options: Options, states: StateScale) -> dict[str, Any]:
    """What the `state` reference's encoder is told of noise; nothing if there is none."""
    if not isinstance(options, StateOptions) or not (options.pose_noise or options.velocity_noise):
        return {}
    return {"noise": states.noise(options.pose_noise, options.velocity_noise).tolist()}


def _memory(config: TrainingConfig, method: Method) -> dict[str, Any]:
    """What an encoder's config says of its memory."""
    if not isinstance(config.memory, MemoryOptions):
        return {}
    told = asdict(config.memory)
    hidden, m = told.pop("hidden_dim"), told.pop("m")
    past = method.past if m is None else m
    return {
        "history": history_of(config.method, method, getattr(config, "history", "method")),
        "use_actions": method.use_actions,
        "hidden_dim": hidden,
        "history_window": 0 if past is None else past + 1,
        "memory_options": told,
    }

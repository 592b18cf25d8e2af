"""Every pretraining method by name. A method is one file and one entry here, or `METHODS.register` from anywhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

from torch import Tensor

from baselines import ACRO, CURL, DRIML, HOMER, OneStepInverse
from pretrain.config import PretrainConfig
from pretrain.objectives.all_history import AllHistory
from pretrain.objectives.forward_jump import ForwardJump
from pretrain.objectives.masked_inverse import MaskedInverse
from pretrain.objectives.untrained import Untrained
from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.nn.action_target import ActionTarget
from vd4rl_pomdp.nn.encoder import Encoder, EncoderConfig
from vd4rl_pomdp.nn.frame import STATE
from vd4rl_pomdp.objective import InverseConfig, Objective
from vd4rl_pomdp.registry import Registry
from vd4rl_pomdp.tasks import FRAME_SIZE, FRAME_STACK

INVERSE = (*(field.name for field in fields(InverseConfig)), "action_target", "codes")
"""Settings that all inverse models read."""
MEMORY = ("m", "hidden_dim", "gru_layers", "history_window")
"""Settings that an encoder with a memory reads."""
PIXELS = ("frame_encoder", "feature_dim")
"""Settings that an encoder of pixels reads."""
OPTIONS = frozenset((*INVERSE, *MEMORY, *PIXELS, "n", "literal_future", "homer_codes"))
"""Settings that not every method reads."""


@dataclass(frozen=True)
class Method:
    """How to build an objective, and the encoder it trains."""

    build: Callable[[Encoder, ActionTarget, PretrainConfig], Objective]
    history: str = "none"
    """Memory of its encoder unless the user chooses: gru or none."""
    use_actions: bool = False
    """Whether the GRU reads past actions."""
    past: int | None = None
    """Rows before t that a state is computed from unless the user chooses m; None: all."""
    trained: bool = True
    """False for references that take no gradient step."""
    end_to_end: str = ""
    """Fine-tuning algorithm that trains the encoder, too; empty for frozen encoders."""
    reads_state: bool = False
    """Whether it is given the simulator state in place of pixels."""
    options: tuple[str, ...] = INVERSE
    """Which of `OPTIONS` it reads, besides those of its encoder; the others are refused."""


def _masked(encoder: Encoder, target: ActionTarget, config: PretrainConfig) -> Objective:
    return MaskedInverse(encoder, target, config, config.literal_future, config.n)


def _curl(encoder: Encoder, target: ActionTarget, config: PretrainConfig) -> Objective:
    return CURL(encoder, config.seed)


def _driml(encoder: Encoder, target: ActionTarget, config: PretrainConfig) -> Objective:
    return DRIML(encoder, config.max_k, config.seed)


def _homer(encoder: Encoder, target: ActionTarget, config: PretrainConfig) -> Objective:
    return HOMER(encoder, config.homer_codes, config.seed)


_MASKED = (*INVERSE, "n", "hidden_dim", "gru_layers")
"""What MIK reads, its backward GRU included."""
_OWN = {
    "no_history": Method(AllHistory),
    "ah": Method(AllHistory, "gru"),
    "ah+a": Method(AllHistory, "gru", use_actions=True),
    "fj": Method(ForwardJump, "gru", past=8),
    "fj+a": Method(ForwardJump, "gru", use_actions=True, past=8),
    "mik": Method(_masked, "gru", options=_MASKED),
    "mik+a": Method(_masked, "gru", use_actions=True, options=(*_MASKED, "literal_future")),
    "acro": Method(ACRO),
    "one_step_inverse": Method(OneStepInverse, options=tuple(name for name in INVERSE if name != "max_k")),
    "curl": Method(_curl, options=()),
    "driml": Method(_driml, options=("max_k",)),
    "homer": Method(_homer, options=("homer_codes",)),
    "random": Method(Untrained, trained=False, options=()),
    "bc": Method(Untrained, trained=False, end_to_end="bc", options=()),
    "drq_bc": Method(Untrained, trained=False, end_to_end="drqv2_bc", options=()),
    "state": Method(Untrained, trained=False, reads_state=True, options=()),
}
METHODS: Registry[Method] = Registry(
    "method", _OWN, lambda part: isinstance(part, Method), "a pretrain.objectives.Method"
)
"""All methods. Packages offer theirs in the group of entry points `vd4rl_pomdp.methods`; each names a `Method`."""


def memory_of(config: PretrainConfig) -> str:
    """Memory of a config's encoder, gru or none; a memory for a method that can have none raises UserError."""
    method = METHODS.named(config.method)
    history = method.history if config.history == "method" else config.history
    if history != "none" and (method.end_to_end or method.reads_state):
        raise UserError(f"{config.method} has no memory: --history {history} is for pretrained methods")
    return history


def unread_options(config: PretrainConfig) -> set[str]:
    """Those of `OPTIONS` that a config's method and encoder do not read."""
    method = METHODS.named(config.method)
    read = {*method.options, *(() if memory_of(config) == "none" else MEMORY)}
    read |= set() if method.reads_state else set(PIXELS)
    return set(OPTIONS) - (read if config.action_target in ("kmeans", "bins") else read - {"codes"})


def build_objective(
    config: PretrainConfig,
    action: Tensor,
    target: ActionTarget,
    state_dim: int = 0,
    observation: tuple[int, int] = (3 * FRAME_STACK, FRAME_SIZE),
) -> Objective:
    """Build the objective of a config.

    Args:
        config: the run's settings.
        action: (N, A) float32, for its width alone.
        target: what an action head predicts.
        state_dim: width of the simulator state, for methods that read it.
        observation: channels and size of an observation, for methods that read pixels.
    """
    method = METHODS.named(config.method)
    past = method.past if config.m is None else config.m
    channels, size = observation
    shape: dict[str, Any] = {"frame_encoder": config.frame_encoder, "channels": channels, "size": size}
    if method.reads_state:
        shape = {"frame_encoder": STATE, "channels": state_dim, "size": 1}
    encoder = Encoder(
        EncoderConfig(
            action_dim=action.shape[1],
            feature_dim=config.feature_dim,
            history=memory_of(config),
            use_actions=method.use_actions,
            hidden_dim=config.hidden_dim,
            gru_layers=config.gru_layers,
            history_window=0 if past is None else past + 1,
            **shape,
        )
    )
    return method.build(encoder, target, config)

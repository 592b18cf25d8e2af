"""Every pretraining method by name. A method is one file and one entry here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from baselines import ACRO
from pretrain.config import PretrainConfig
from pretrain.objectives.masked_inverse import MaskedInverse
from pretrain.objectives.untrained import Untrained
from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.nn.action_target import ActionTarget
from vd4rl_pomdp.nn.encoder import Encoder, EncoderConfig
from vd4rl_pomdp.objective import Objective


@dataclass(frozen=True)
class Method:
    """How to build an objective, and the encoder it trains."""

    build: Callable[[Encoder, ActionTarget, PretrainConfig], Objective]
    history: str
    """Memory of its encoder unless the user chooses: gru or none."""
    use_actions: bool = False
    """Whether the GRU reads past actions."""
    trained: bool = True
    """False for references that take no gradient step."""


def _mik(encoder: Encoder, target: ActionTarget, config: PretrainConfig) -> Objective:
    return MaskedInverse(encoder, target, config, config.literal_future)


METHODS: dict[str, Method] = {
    "mik+a": Method(_mik, "gru", use_actions=True),
    "acro": Method(ACRO, "none"),
    "random": Method(Untrained, "none", trained=False),
}


def get_method(name: str) -> Method:
    """The method called `name`; raises UserError listing the choices."""
    if name not in METHODS:
        raise UserError(f"unknown method {name!r}: choose one of {', '.join(METHODS)}")
    return METHODS[name]


def build_objective(config: PretrainConfig, action: Tensor, target: ActionTarget) -> Objective:
    """Build the objective of a config.

    Args:
        config: the run's settings.
        action: (N, A) float32, for its width alone.
        target: what an action head predicts.
    """
    method = get_method(config.method)
    encoder = Encoder(
        EncoderConfig(
            action_dim=action.shape[1],
            frame_encoder=config.frame_encoder,
            feature_dim=config.feature_dim,
            history=method.history if config.history == "method" else config.history,
            use_actions=method.use_actions,
            hidden_dim=config.hidden_dim,
            gru_layers=config.gru_layers,
            history_window=0,
        )
    )
    return method.build(encoder, target, config)

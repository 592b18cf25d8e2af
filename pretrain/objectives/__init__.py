"""Every pretraining method by name. A method is one file and one entry here, or `register_method` from anywhere."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, fields
from importlib.metadata import EntryPoint, entry_points
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
from vd4rl_pomdp.tasks import FRAME_SIZE, FRAME_STACK

ENTRY_POINTS = "vd4rl_pomdp.methods"
"""Group of entry points under which a package offers methods; each names a `Method`."""
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
METHODS: dict[str, Method] = {
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


def register_method(name: str, method: Method) -> None:
    """Add a method of one's own; a name that is taken raises UserError."""
    if name in METHODS:
        raise UserError(f"a method called {name!r} exists already: choose another name")
    METHODS[name] = method


_broken: dict[str, str] = {}
"""Methods that an installed package offers and that cannot be loaded, and why."""


def _load_plugins() -> None:
    """Register the methods that installed packages offer; one that cannot be loaded is told of once, and left out."""
    for entry in entry_points(group=ENTRY_POINTS):
        if entry.name not in METHODS and entry.name not in _broken:
            try:
                register_method(entry.name, _load(entry))
            except Exception as error:  # other people's code may raise anything
                _broken[entry.name] = f"{entry.value}: {type(error).__name__}: {' '.join(str(error).split())}"
                print(f"warning: method {entry.name!r} cannot be loaded ({_broken[entry.name]})", file=sys.stderr)


def _load(entry: EntryPoint) -> Method:
    method = entry.load()
    if not isinstance(method, Method):
        raise TypeError(f"is a {type(method).__name__}, not a pretrain.objectives.Method")
    return method


def get_method(name: str) -> Method:
    """The method called `name`; raises UserError listing the choices."""
    _load_plugins()
    if name in _broken:
        raise UserError(
            f"method {name!r} cannot be loaded ({_broken[name]}): mend or remove the package that offers it"
        )
    if name not in METHODS:
        raise UserError(f"unknown method {name!r}: choose one of {', '.join(METHODS)}")
    return METHODS[name]


def memory_of(config: PretrainConfig) -> str:
    """Memory of a config's encoder, gru or none; a memory for a method that can have none raises UserError."""
    method = get_method(config.method)
    history = method.history if config.history == "method" else config.history
    if history != "none" and (method.end_to_end or method.reads_state):
        raise UserError(f"{config.method} has no memory: --history {history} is for pretrained methods")
    return history


def unread_options(config: PretrainConfig) -> set[str]:
    """Those of `OPTIONS` that a config's method and encoder do not read."""
    method = get_method(config.method)
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
    method = get_method(config.method)
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

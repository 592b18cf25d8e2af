"""Every pretraining method by name. A method is one file and one entry here, or `METHODS.register` from anywhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from baselines import (
    ACDF,
    ACRO,
    CURL,
    DRIML,
    HOMER,
    SMWM,
    ACDFOptions,
    ACROOptions,
    DRIMLOptions,
    HOMEROptions,
    OneStepInverse,
    SMWMOptions,
)
from pretrain.objectives.all_history import AllHistory
from pretrain.objectives.forward_jump import ForwardJump
from pretrain.objectives.masked_inverse import MaskedActionOptions, MaskedInverse, MaskedOptions
from pretrain.objectives.supervised import Supervised, SupervisedOptions
from pretrain.objectives.untrained import StateOptions, Untrained
from vd4rl_pomdp.core.options import Options, refuse_options
from vd4rl_pomdp.core.registry import Registry
from vd4rl_pomdp.corruptions.augmentation import Sharing
from vd4rl_pomdp.nn.objective import ActionOptions, InverseOptions, Objective


@dataclass(frozen=True)
class Method:
    """How to build an objective, and the encoder it trains."""

    build: Callable[..., Objective]
    """From (encoder, target, options, seed): an `Encoder`, the `ActionTarget` if its options are `ActionOptions` (else
    None; the `StateScale` of the set if it regresses states), its options and the run's seed. An objective's class is
    one."""
    history: str = "none"
    """Name of its encoder's memory, or none; --history chooses another."""
    use_actions: bool = False
    """Whether the memory reads past actions; without a memory of its own, under --history alone."""
    past: int | None = None
    """Rows before t that a state is computed from unless the user chooses m; None: all."""
    shift: Sharing | Literal["own"] = "window"
    """What shares one random shift: the observations of a window, or the frames of one observation, where what a window
    shares would give the answer away, or where its authors have it so; own: the objective shifts by itself, and what it
    is given is not shifted. An option `shift_shared` of its options, where it is True, makes it the window."""
    trained: bool = True
    """False for references that take no gradient step."""
    end_to_end: str = ""
    """Fine-tuning algorithm that trains the encoder, too; empty for frozen encoders."""
    reads_state: bool = False
    """Whether it is given the simulator state in place of pixels."""
    regresses_state: bool = False
    """Whether its loss, and nothing else of it, is told the simulator states: its windows are `StateWindows`."""
    histories: bool = False
    """Whether these are histories up to their episodes' ends, shown by their first observation alone, whatever --window
    is; half of them begin with an episode, the others at a random row."""
    least_batch: int = 1
    """Windows that a batch holds at least: 2 where a loss tells those of one window from those of another."""
    options: type[Options] = Options
    """Class of its options."""
    summary: str = ""
    """One line that says what it is."""


_OWN = {
    "no_history": Method(
        AllHistory, options=InverseOptions, summary="inverse model on the observations t and t+k alone"
    ),
    "ah": Method(AllHistory, "gru", options=InverseOptions, summary="inverse model on the whole past at t and at t+k"),
    "ah+a": Method(
        AllHistory,
        "gru",
        use_actions=True,
        options=InverseOptions,
        summary="ah whose pasts hold actions, the predicted one among them",
    ),
    "fj": Method(
        ForwardJump, "gru", past=8, options=InverseOptions, summary="inverse model on t, t+k and the m rows before each"
    ),
    "fj+a": Method(
        ForwardJump,
        "gru",
        use_actions=True,
        past=8,
        options=InverseOptions,
        summary="fj whose windows hold actions",
    ),
    "mik": Method(
        MaskedInverse,
        "gru",
        options=MaskedOptions,
        summary="inverse model on the past at t and the future from t+k on; between them is masked",
    ),
    "mik+a": Method(
        MaskedInverse,
        "gru",
        use_actions=True,
        options=MaskedActionOptions,
        summary="mik with past and future actions: the paper's method",
    ),
    "acro": Method(
        ACRO, shift="observation", options=ACROOptions, summary="memoryless multi-step inverse model, as published"
    ),
    "one_step_inverse": Method(
        OneStepInverse, options=ActionOptions, summary="inverse model on the observations t and t+1"
    ),
    "acdf": Method(
        ACDF, options=ACDFOptions, summary="memoryless multi-step inverse model with a latent forward model"
    ),
    "smwm": Method(
        SMWM, options=SMWMOptions, summary="one-step inverse model with a latent forward model that moves both its ends"
    ),
    "curl": Method(
        CURL, shift="own", least_batch=2, summary="contrastive: two augmentations of one observation find each other"
    ),
    "driml": Method(
        DRIML,
        least_batch=2,
        shift="observation",
        options=DRIMLOptions,
        summary="contrastive: (s_t, a_t) finds s_{t+k}, globally and by place",
    ),
    "homer": Method(HOMER, shift="observation", options=HOMEROptions, summary="tells real transitions from imposters"),
    "random": Method(Untrained, trained=False, summary="no training: the floor"),
    "supervised": Method(
        Supervised,
        "gru",
        regresses_state=True,
        options=SupervisedOptions,
        summary="mik's encoder, trained to regress the simulator's state: a reference for memory",
    ),
    "supervised+a": Method(
        Supervised,
        "gru",
        use_actions=True,
        regresses_state=True,
        options=SupervisedOptions,
        summary="supervised whose past holds actions, as mik+a's does",
    ),
    "supervised_picture": Method(
        Supervised,
        regresses_state=True,
        options=SupervisedOptions,
        summary="supervised without a memory: a reference for what one observation tells",
    ),
    "integrator": Method(
        Supervised,
        "integrator",
        use_actions=True,
        regresses_state=True,
        histories=True,
        options=SupervisedOptions,
        summary="supervised on the first observation, the actions since and the time: a floor for memory",
    ),
    "bc": Method(Untrained, trained=False, end_to_end="bc", summary="end to end by behaviour cloning, no frozen stage"),
    "drq_bc": Method(
        Untrained, trained=False, end_to_end="drqv2_bc", summary="end to end by DrQ-v2+BC, no frozen stage"
    ),
    "state": Method(
        Untrained,
        trained=False,
        reads_state=True,
        options=StateOptions,
        summary="the simulator's state in place of an encoder: a reference",
    ),
}
METHODS: Registry[Method] = Registry(
    "method",
    _OWN,
    lambda part: isinstance(part, Method),
    "a pretrain.objectives.Method",
    lambda name, part: refuse_options(part.options),
)
"""All methods. Packages offer theirs in the group of entry points `vd4rl_pomdp.methods`; each names a `Method`."""

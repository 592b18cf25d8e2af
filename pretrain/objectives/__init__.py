"""Registry of pretraining methods. To add one: write a file and an entry here, or call `METHODS.register` anywhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from baselines.acdf import ACDF, ACDFOptions
from baselines.acro import ACRO, ACROOptions
from baselines.curl import CURL
from baselines.driml import DRIML, DRIMLOptions
from baselines.homer import HOMER, HOMEROptions
from baselines.one_step_inverse import OneStepInverse
from baselines.smwm import SMWM, SMWMOptions
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
    """How to build an objective and the encoder that it trains."""

    build: Callable[..., Objective]
    """Called with (encoder, target, options, seed); usually the objective's class. `target` is the `ActionTarget` if
    the options are `ActionOptions`, the `StateScale` of the data set if `regresses_state`, else None."""
    history: str = "none"
    """Default memory of the encoder, "none" for none; --history overrides it."""
    use_actions: bool = False
    """Whether the memory also reads past actions; for a method with history "none" it matters only with --history."""
    past: int | None = None
    """Default of --m: rows before t that s_t is computed from, None for all."""
    shift: Sharing | Literal["own"] = "window"
    """Unit of the random shift. "window": all observations of a window move together. "observation": each observation
    moves independently, as its authors do, or because a shared shift would leak the answer to a contrastive loss.
    "own": the objective shifts by itself and receives unshifted windows. `shift_shared=True` in the method's options
    overrides this with "window"."""
    trained: bool = True
    """False for references that take no gradient step."""
    end_to_end: str = ""
    """Fine-tuning algorithm that also trains the encoder; empty for frozen encoders."""
    reads_state: bool = False
    """Whether the encoder's input is the simulator state instead of pixels."""
    regresses_state: bool = False
    """Whether the loss is computed from simulator states; its batches are then `StateWindows`."""
    histories: bool = False
    """Train on histories up to the episode's end instead of windows of --window rows; only the first observation is
    used. Half of them start at an episode's first row, half at a random row."""
    least_batch: int = 1
    """Smallest --batch-size; 2 for losses that contrast windows with each other."""
    options: type[Options] = Options
    summary: str = ""


_OWN = {
    "no_history": Method(
        AllHistory, options=InverseOptions, summary="inverse model on only the observations t and t+k"
    ),
    "ah": Method(AllHistory, "gru", options=InverseOptions, summary="inverse model on the whole past at t and at t+k"),
    "ah+a": Method(
        AllHistory,
        "gru",
        use_actions=True,
        options=InverseOptions,
        summary="ah with past actions, including the predicted one",
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
        summary="fj with the actions of its windows",
    ),
    "mik": Method(
        MaskedInverse,
        "gru",
        options=MaskedOptions,
        summary="inverse model on the past at t and the future from t+k on, the steps between masked",
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
        SMWM,
        options=SMWMOptions,
        summary="one-step inverse model with a latent forward model, whose gradients reach both states",
    ),
    "curl": Method(
        CURL, shift="own", least_batch=2, summary="contrastive: matches two augmentations of one observation"
    ),
    "driml": Method(
        DRIML,
        least_batch=2,
        shift="observation",
        options=DRIMLOptions,
        summary="contrastive: matches (s_t, a_t) with s_{t+k}, on global and local features",
    ),
    "homer": Method(
        HOMER, shift="observation", options=HOMEROptions, summary="contrastive: classifies transitions as real or fake"
    ),
    "random": Method(Untrained, trained=False, summary="an untrained encoder, as a baseline"),
    "supervised": Method(
        Supervised,
        "gru",
        regresses_state=True,
        options=SupervisedOptions,
        summary="mik's encoder, regressing the simulator's state: a privileged reference with memory",
    ),
    "supervised+a": Method(
        Supervised,
        "gru",
        use_actions=True,
        regresses_state=True,
        options=SupervisedOptions,
        summary="supervised with past actions, as in mik+a",
    ),
    "supervised_picture": Method(
        Supervised,
        regresses_state=True,
        options=SupervisedOptions,
        summary="supervised on single observations: a privileged reference without memory",
    ),
    "integrator": Method(
        Supervised,
        "integrator",
        use_actions=True,
        regresses_state=True,
        histories=True,
        options=SupervisedOptions,
        summary="supervised on only the first observation, later actions and time",
    ),
    "bc": Method(Untrained, trained=False, end_to_end="bc", summary="behaviour cloning from pixels, end to end"),
    "drq_bc": Method(Untrained, trained=False, end_to_end="drqv2_bc", summary="DrQ-v2+BC from pixels, end to end"),
    "state": Method(
        Untrained,
        trained=False,
        reads_state=True,
        options=StateOptions,
        summary="the simulator's state instead of an encoder: a privileged reference",
    ),
}
METHODS: Registry[Method] = Registry(
    "method",
    _OWN,
    lambda part: isinstance(part, Method),
    "a pretrain.objectives.Method",
    lambda name, part: refuse_options(part.options),
)
"""All methods. Other packages add a `Method` through the entry point group `vd4rl_pomdp.methods`."""

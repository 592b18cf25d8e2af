"""Settings of `vd4rl-pomdp navigation train` and its presets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

from pretrain.config import TrainingConfig, frame_options, memory_options
from pretrain.objectives import METHODS
from vd4rl_pomdp.core.errors import UserError, refuse_outside, refuse_unknown
from vd4rl_pomdp.core.options import NO_OPTIONS, Limits, Options, flat
from vd4rl_pomdp.nn.objective import ActionOptions
from vd4rl_pomdp.studies.navigation.pictures import SHAPES, Picture
from vd4rl_pomdp.studies.navigation.runs import METHOD_NAMES, REFERENCES

_PAPER: dict[str, Any] = {
    "steps": 200_000,
    "window": 64,
    "learning_rate": 1e-4,
    "l2_states": 1e-3,
    "frame_encoder": "mixer",
    "gru_layers": 2,
    "log_every": 100,
    "checkpoint_every": 1_000,
}
_CPU: dict[str, Any] = {
    "steps": 2_500,
    "average_last": 200,
    "window": 40,
    "learning_rate": 2e-3,
    "schedule": "cosine",
    "warm_up": 100,
    "picture": "grey50",
    "frame_encoder": "small",
    "feature_dim": 128,
    "hidden_dim": 128,
    "precision": "bf16",
    "log_every": 50,
    "checkpoint_every": 250,
}
_SMOKE: dict[str, Any] = {
    "steps": 30,
    "average_last": 10,
    "batch_size": 4,
    "window": 16,
    "max_k": 3,
    "warm_up": 5,
    "feature_dim": 32,
    "hidden_dim": 32,
    "head_dim": 32,
    "codes": 6,
    "burn_in": 4,
    "evaluation_windows": 8,
    "refit_windows": 16,
    "refit_steps": 50,
    "log_every": 5,
    "checkpoint_every": 10,
}
_NETWORK_OF = dict(zip(REFERENCES, ("mik+a", "no_history", "ah", "ah+a"), strict=True))
"""Objectives whose networks the references have."""


@dataclass(frozen=True)
class ReferenceOptions(Options):
    """Options of the references, which train no inverse model."""

    max_k: int = 15
    """The K of the objectives to compare with; it determines a table cell and one of the initial draws."""

    limits: ClassVar[Limits] = {"max_k": 1}


@dataclass(frozen=True)
class NoiseOptions(Options):
    """Options of exogenous noise."""

    exogenous_weight: float = 0.5
    """Factor of the added images."""

    limits: ClassVar[Limits] = {"exogenous_weight": (0, 1)}

    def check(self) -> None:
        """Raise UserError for values that cannot work."""
        super().check()
        if not self.exogenous_weight:
            raise UserError("--exogenous-weight is 0, which adds nothing: leave --exogenous out")


@dataclass(frozen=True, kw_only=True)
class NavigationConfig(TrainingConfig):
    """Settings of `vd4rl-pomdp navigation train`.

    Methods are no_history, ah, ah+a, fj, fj+a, mik, mik+a, others that predict actions, random (mik+a, untrained), and
    supervised_picture, supervised and supervised+a (the networks of no_history, ah and ah+a, trained on the true
    states).
    """

    average_last: int = 10_000
    """Number of last steps over which reported training metrics are averaged."""
    schedule: Literal["constant", "cosine"] = "constant"
    """Learning rate after the warm-up: constant, or cosine decay to zero."""
    warm_up: int = 0
    """Steps of linear learning-rate warm-up."""
    picture: Picture = "rgb100"
    """rgb100: images as stored; rgb50: averaged over 2x2 pixels; grey50: their luminance."""
    exogenous: str = "none"
    """Images added to every observation: none, textures, photographs, or a folder of CIFAR-10, PNG or JPEG files."""
    noise: Options = NO_OPTIONS
    """Options of the exogenous noise."""
    burn_in: int = 10
    """First rows of a window, excluded from state errors."""
    evaluation_windows: int = 256
    """Held-out evaluation windows."""
    refit_windows: int = 1024
    """Training windows to refit the probe on."""
    refit_steps: int = 4_000
    """Gradient steps of the refitted probe."""

    choosers: ClassVar[tuple[str, ...]] = (*TrainingConfig.choosers, "exogenous")
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {"paper": _PAPER, "cpu": _CPU, "smoke": _CPU | _SMOKE}
    """The paper's setting for a GPU, one for two CPU cores, and one that takes seconds."""

    @classmethod
    def parts(cls, values: Mapping[str, Any]) -> dict[str, Options]:
        """Options of method, memory, frame encoder and noise."""
        method = METHODS.named(_NETWORK_OF.get(values["method"], values["method"]))
        return {
            "options": (ReferenceOptions if values["method"] in REFERENCES else method.options).fill(values),
            "memory": memory_options(method.history, values),
            "frame": frame_options(method, values),
            "noise": (Options if values["exogenous"] == "none" else NoiseOptions).fill(values),
        }

    def trained(self) -> TrainingConfig:
        """The same settings for the objective that a method trains: itself, unless it is a reference."""
        if self.method not in REFERENCES:
            return self
        method, values = _NETWORK_OF[self.method], self.defaults(self.preset) | flat(self)
        return replace(self, method=method, options=METHODS.named(method).options.fill(values))

    def check(self) -> None:
        """Reject invalid settings before anything is read or written."""
        super().check()
        refuse_outside(
            self, steps=1, burn_in=0, average_last=1, evaluation_windows=1, refit_windows=1, refit_steps=1, warm_up=0
        )
        trained = self.trained()
        if not isinstance(trained.options, ActionOptions):
            raise UserError(f"{trained.method} predicts no actions: choose one of {', '.join(METHOD_NAMES)}")
        refuse_unknown("picture", self.picture, SHAPES)
        if self.burn_in >= self.window:
            raise UserError(f"--burn-in {self.burn_in} leaves no row of a window of {self.window}: lower it")

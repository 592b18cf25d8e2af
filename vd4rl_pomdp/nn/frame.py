"""Frame encoders e(o): convolutions on one frame stack, then Linear, LayerNorm, Tanh."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from vd4rl_pomdp.core.errors import UserError, first_line
from vd4rl_pomdp.core.hardware import compiled_on_gpu
from vd4rl_pomdp.core.options import Limits, Options, refuse_options
from vd4rl_pomdp.core.registry import Registry
from vd4rl_pomdp.corruptions.keys import DRAWS, derive_keys, draw_integers, draw_normals
from vd4rl_pomdp.nn.pretrained import Pretrained


@dataclass(frozen=True)
class FrameOptions(Options):
    """Options of every frame encoder."""

    feature_dim: int = 256
    """Dimension of the frame encoder's output."""

    limits: ClassVar[Limits] = {"feature_dim": 1}


def encoder_settings(options: Options) -> dict[str, Any]:
    """Split a frame encoder's options into the `EncoderConfig` fields `feature_dim` and `frame_options` (the rest)."""
    others = asdict(options)
    return {"feature_dim": others.pop("feature_dim"), "frame_options": others}


@dataclass(frozen=True)
class FrameEncoderPart:
    """How to build a frame encoder's convolutions; `FrameEncoder` adds Linear, LayerNorm and Tanh."""

    build: Callable[[int, int, Any], nn.Module]
    """Called with (channels, size, options); returns a module (N, C, size, size) -> (N, C', H', W') of pixels in
    [-0.5, 0.5]. Its optional attribute `found` is a dict of option values known only after building, such as the hash
    of the weights that a model name stands for; the encoder's config records them."""
    options: type[FrameOptions] = FrameOptions
    summary: str = ""


class FrameEncoder(nn.Module):
    """Encodes uint8 frame stacks.

    Shapes: (..., C, size, size) uint8 or float in 0..255 -> (..., feature_dim) float32.
    """

    def __init__(self, convolutions: nn.Module, map_shape: tuple[int, ...], feature_dim: int) -> None:
        super().__init__()
        self.convolutions = convolutions
        self.found: dict[str, Any] = getattr(convolutions, "found", {})
        """See `FrameEncoderPart.build`."""
        self.map_shape = map_shape
        """(C', H', W') of the feature maps."""
        flat = math.prod(map_shape)
        self.project = nn.Sequential(nn.Linear(flat, feature_dim), nn.LayerNorm(feature_dim), nn.Tanh())

    def forward(self, obs: Tensor) -> Tensor:
        return _features(self, obs, self._precision(obs))

    def maps(self, obs: Tensor) -> Tensor:
        """Feature maps (..., C', H', W') of every stack, the input of `from_maps`."""
        return _maps(self, obs, self._precision(obs))

    def from_maps(self, maps: Tensor) -> Tensor:
        """Features (..., feature_dim) float32 of feature maps."""
        dtype = next(self.project.parameters()).dtype
        features = self.project(maps.flatten(-3).flatten(0, -2)).to(dtype)
        return features.view(*maps.shape[:-3], features.shape[-1])

    def _precision(self, obs: Tensor) -> torch.dtype:
        if torch.is_autocast_enabled(obs.device.type):
            return torch.get_autocast_dtype(obs.device.type)  # a float32 copy would be the largest tensor in memory
        return next(self.project.parameters()).dtype


# functions, not methods: deepcopy of an encoder must not copy compiled code
@compiled_on_gpu
def _maps(encoder: FrameEncoder, obs: Tensor, dtype: torch.dtype) -> Tensor:
    pixels = obs.reshape(-1, *obs.shape[-3:]).contiguous(memory_format=torch.channels_last).to(dtype, copy=True)
    image = pixels.mul_(1 / 255).sub_(0.5)
    return encoder.convolutions(image).view(*obs.shape[:-3], *encoder.map_shape)


@compiled_on_gpu
def _features(encoder: FrameEncoder, obs: Tensor, dtype: torch.dtype) -> Tensor:
    return encoder.from_maps(_maps.__wrapped__(encoder, obs, dtype))


def _convolutions(*shapes: tuple[int, int, int], half: bool = False) -> Callable[..., nn.Sequential]:
    """Builder of convolutions with ReLU, each (output channels, kernel, stride); `half`: after 2x2 mean pooling."""

    def build(channels: int, size: int, options: FrameOptions) -> nn.Sequential:
        layers: list[nn.Module] = [nn.AvgPool2d(2, ceil_mode=True)] if half else []
        for width, extent, stride in shapes:
            layers += [nn.Conv2d(channels, width, extent, stride=stride), nn.ReLU()]
            channels = width
        return nn.Sequential(*layers)

    return build


_PATCH, _MIXER_DIM, _MIXER_LAYERS = 10, 256, 8


class MixerLayer(nn.Module):
    """Mixes (N, patches, dim) over the patches, then over the features (Tolstikhin et al. 2021, arXiv 2105.01601)."""

    def __init__(self, patches: int, dim: int) -> None:
        super().__init__()
        self.norms = nn.ModuleList([nn.LayerNorm(dim), nn.LayerNorm(dim)])
        self.over_patches = nn.Sequential(nn.Linear(patches, dim // 2), nn.GELU(), nn.Linear(dim // 2, patches))
        self.over_features = nn.Sequential(nn.Linear(dim, 4 * dim), nn.GELU(), nn.Linear(4 * dim, dim))

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.over_patches(self.norms[0](x).transpose(1, 2)).transpose(1, 2)
        return x + self.over_features(self.norms[1](x))


class _Pool(nn.Module):
    """Mean over patches: (N, patches, dim) -> (N, dim, 1, 1)."""

    def forward(self, x: Tensor) -> Tensor:
        return x.mean(1)[..., None, None]


class _Patches(nn.Module):
    """Feature maps as a sequence: (N, dim, h, w) -> (N, h * w, dim)."""

    def forward(self, x: Tensor) -> Tensor:
        return x.flatten(2).transpose(1, 2)


def _mixer(channels: int, size: int, options: FrameOptions) -> nn.Sequential:
    """MLP-Mixer of 8 layers on patches of 10x10 pixels (the paper's navigation encoder)."""
    if size % _PATCH:
        raise UserError(
            f"frame encoder 'mixer' cuts images into patches of {_PATCH} pixels, and {size} is not a multiple: "
            "choose another --frame-encoder"
        )
    layers = [MixerLayer((size // _PATCH) ** 2, _MIXER_DIM) for _ in range(_MIXER_LAYERS)]
    patches = nn.Conv2d(channels, _MIXER_DIM, _PATCH, stride=_PATCH)
    return nn.Sequential(patches, _Patches(), *layers, nn.LayerNorm(_MIXER_DIM), _Pool())


@dataclass(frozen=True)
class PretrainedOptions(FrameOptions):
    """Options of a frozen image model."""

    model: str = "facebook/dinov2-small"
    """Model in transformers' local cache, or a folder written by save_pretrained."""
    model_size: int = 224
    """Height and width to which frames are resized."""
    weights: str = ""
    """Required content hash of the model's weights; empty: any. The hash used is recorded in the encoder's config."""

    limits: ClassVar[Limits] = {"model_size": (1, 4096)}


STATE = "state"
"""Value of --frame-encoder for simulator states; not in FRAME_ENCODERS, since it reads no pixels."""


def _refuse_part(name: str, part: FrameEncoderPart) -> None:
    """Raise UserError for a frame encoder with a reserved name or invalid options."""
    if name == STATE:
        raise UserError("this name is reserved for simulator states: choose another")
    refuse_options(part.options, FrameOptions)


FRAME_ENCODERS: Registry[FrameEncoderPart] = Registry(
    "frame encoder",
    {
        # Kostrikov et al. 2020, arXiv 2004.13649
        "drq": FrameEncoderPart(
            _convolutions((32, 3, 2), (32, 3, 1), (32, 3, 1), (32, 3, 1)),
            summary="four 3x3 convolutions of 32 channels, as in DrQ and V-D4RL",
        ),
        # Mnih et al. 2015
        "nature": FrameEncoderPart(
            _convolutions((32, 8, 4), (64, 4, 2), (64, 3, 1)),
            summary="three convolutions of 32 and 64 channels, at a fraction of drq's cost",
        ),
        "nature_half": FrameEncoderPart(
            _convolutions((32, 4, 2), (64, 4, 2), (64, 3, 1), half=True),
            summary="nature at half the resolution",
        ),
        "small": FrameEncoderPart(
            _convolutions((16, 5, 2), (32, 3, 2), (32, 3, 2)),
            summary="three strided convolutions of few channels, for grey 50x50 images",
        ),
        "mixer": FrameEncoderPart(_mixer, summary="MLP-Mixer on patches of 10x10 pixels, as in the paper's mazes"),
        "pretrained": FrameEncoderPart(
            lambda channels, size, options: Pretrained(options.model, options.model_size, options.weights, channels),
            PretrainedOptions,
            "a frozen image model from Hugging Face transformers, DINOv2 by default",
        ),
        "flat": FrameEncoderPart(_convolutions(), summary="no convolution, for observations of a few numbers"),
    },
    lambda part: isinstance(part, FrameEncoderPart),
    "a vd4rl_pomdp.nn.frame.FrameEncoderPart",
    _refuse_part,
)
"""All frame encoders. Other packages add theirs through the entry point group `vd4rl_pomdp.frame_encoders`."""


class StateFrame(nn.Module):
    """Returns the simulator state, given instead of pixels, as features: (..., P, 1, 1) -> (..., P) float32."""

    noise: Tensor
    mean: Tensor
    std: Tensor

    def __init__(
        self,
        width: int,
        noise: Sequence[float] = (),
        mean: Sequence[float] = (),
        std: Sequence[float] = (),
        hidden_share: float = 0.0,
    ) -> None:
        """For P = `width` coordinates; ValueError if noise, mean or std is neither empty nor of length P.

        `noise` is the standard deviation of what is added to each coordinate, `mean` and `std` standardise it, and
        `hidden_share` is the probability of setting it to zero, its standardised mean.
        """
        super().__init__()
        for values in (noise, mean, std):
            if len(values) not in (0, width):
                raise ValueError(f"{len(values)} numbers for states of {width} coordinates")
        self.width, self.hidden_share = width, hidden_share
        for name, values in (("noise", noise), ("mean", mean), ("std", std)):
            self.register_buffer(name, torch.tensor(values, dtype=torch.float64), persistent=False)
        self.nothing = nn.Parameter(torch.zeros(0))
        """Optimisers need at least one parameter, and weight files one tensor."""

    def forward(self, obs: Tensor) -> Tensor:
        """The state itself; UserError for images, or if it has another width, as in earlier versions."""
        if obs.shape[-2:] != (1, 1):
            raise UserError(
                f"this encoder reads simulator states (..., {self.width}, 1, 1), not images {tuple(obs.shape)}: give "
                "it the dataset's or the environment's states"
            )
        if obs.shape[-3] != self.width:
            raise UserError(
                f"this encoder reads states of {self.width} coordinates, the task's have {obs.shape[-3]}: "
                "pretrain the reference `state` again"
            )
        return obs.flatten(-3).float()

    @property
    def draws(self) -> bool:
        """Whether `observe` is random, so that its result depends on the key."""
        return len(self.noise) > 0 or self.hidden_share > 0

    def observe(self, state: Tensor, key: Tensor) -> Tensor:
        """Turn states into observations: (..., P) float32, (...,) int64 -> (..., P, 1, 1) float32.

        Adds noise, standardises, hides coordinates; equal keys give equal draws.
        """
        if len(self.noise):
            state = (state + draw_normals(key, state.shape[-1]) * self.noise).float()
        if len(self.std):
            state = ((state - self.mean) / torch.where(self.std > 0, self.std, 1)).float()
        if self.hidden_share:
            hidden = draw_integers(derive_keys(1, key), DRAWS, state.shape[-1]) < self.hidden_share * DRAWS
            state = state.masked_fill(hidden, 0.0)
        return state[..., None, None]


def make_frame_encoder(name: str, channels: int, size: int, settings: Mapping[str, Any]) -> FrameEncoder:
    """Build a frame encoder by name for images (channels, size, size); `settings` are its options by name.

    Raises:
        UserError: an unknown name or option, or a module that cannot read images of this size or returns no maps.
    """
    part = FRAME_ENCODERS.named(name)
    options = part.options.fill(settings)
    if unknown := settings.keys() - vars(options).keys():
        raise UserError(f"frame encoder {name!r} has no option {min(unknown)!r}")
    try:
        convolutions = part.build(channels, size, options)
        if not isinstance(convolutions, nn.Module):
            kind = type(convolutions).__name__
            raise UserError(f"frame encoder {name!r} builds a {kind}, not a module: return what makes the maps")
        with torch.no_grad():
            maps = convolutions(torch.zeros(1, channels, size, size))
    except RuntimeError as error:
        raise UserError(
            f"frame encoder {name!r} cannot read images of {size}x{size} pixels ({first_line(error)}): choose "
            "another --frame-encoder, or a dataset of larger frames"
        ) from error
    if not isinstance(maps, Tensor) or maps.dim() != 4:
        made = ("N", *maps.shape[1:]) if isinstance(maps, Tensor) else f"a {type(maps).__name__}"
        raise UserError(
            f"frame encoder {name!r} makes {made} of N images, not maps (N, C', H', W'): "
            "give its module's output height and width, 1 for none"
        )
    encoder = FrameEncoder(convolutions, tuple(maps.shape[1:]), options.feature_dim)
    for parameter in encoder.parameters():
        if parameter.dim() == 4:
            parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
    return encoder

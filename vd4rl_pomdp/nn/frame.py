"""Frame encoders e(o): convolutions on one stacked observation, then Linear, LayerNorm, Tanh."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from vd4rl_pomdp.core.compiling import compiled_on_gpu
from vd4rl_pomdp.core.errors import UserError, first_line
from vd4rl_pomdp.core.options import Limits, Options, refuse_options
from vd4rl_pomdp.core.registry import Registry
from vd4rl_pomdp.corruptions.keys import DRAWS, derive_keys, draw_integers, draw_normals
from vd4rl_pomdp.nn.pretrained import Pretrained


@dataclass(frozen=True)
class FrameOptions(Options):
    """Options of every frame encoder."""

    feature_dim: int = 256
    """Width of the frame encoder's output."""

    limits: ClassVar[Limits] = {"feature_dim": 1}


def encoder_settings(options: Options) -> dict[str, Any]:
    """What `EncoderConfig` is told of a frame encoder's options: `feature_dim`, and as `frame_options` all others."""
    told = asdict(options)
    return {"feature_dim": told.pop("feature_dim"), "frame_options": told}


@dataclass(frozen=True)
class FrameEncoderPart:
    """How to build what comes before a frame encoder's last layer."""

    build: Callable[[int, int, Any], nn.Module]
    """From channels and size of a picture, and options: a module (N, C, size, size) -> (N, C', H', W'), of pixels in
    [-0.5, 0.5]; a linear layer, a layer norm and a tanh follow. What the module finds out when it is built, such as
    which weights a name stands for, is its attribute `found`: values of options, which the encoder's record keeps."""
    options: type[FrameOptions] = FrameOptions
    """Class of its options."""
    summary: str = ""
    """One line that says what it is."""


class FrameEncoder(nn.Module):
    """Encodes uint8 frame stacks.

    Shapes: (..., C, size, size) uint8 or float in 0..255 -> (..., feature_dim) float32.
    """

    def __init__(self, convolutions: nn.Module, channels: int, size: int, feature_dim: int) -> None:
        super().__init__()
        self.convolutions = convolutions
        self.found: dict[str, Any] = getattr(convolutions, "found", {})
        """See `FrameEncoderPart.build`."""
        with torch.no_grad():
            maps = convolutions(torch.zeros(1, channels, size, size))
        if not isinstance(maps, Tensor):
            raise UserError(
                f"a frame encoder's module must give feature maps (N, C', H', W'), not a {type(maps).__name__}"
            )
        self.map_shape = tuple(maps.shape[1:])
        """(C', H', W') of the feature maps."""
        flat = math.prod(self.map_shape)
        self.project = nn.Sequential(nn.Linear(flat, feature_dim), nn.LayerNorm(feature_dim), nn.Tanh())

    def forward(self, obs: Tensor) -> Tensor:
        """Features of every stack."""
        return _features(self, obs, self._precision(obs))

    def maps(self, obs: Tensor) -> Tensor:
        """Feature maps (..., C', H', W') of every stack, the layer before `from_maps`."""
        return _maps(self, obs, self._precision(obs))

    def from_maps(self, maps: Tensor) -> Tensor:
        """Features (..., feature_dim) float32 of feature maps."""
        dtype = next(self.project.parameters()).dtype
        return self.project(maps.flatten(-3).flatten(0, -2)).to(dtype).view(*maps.shape[:-3], -1)

    def _precision(self, obs: Tensor) -> torch.dtype:
        """What pixels are converted to."""
        if torch.is_autocast_enabled(obs.device.type):
            return torch.get_autocast_dtype(obs.device.type)  # a float32 copy would be the largest tensor
        return next(self.project.parameters()).dtype


# functions, not methods: what was compiled must not go along where an encoder is copied
@compiled_on_gpu(training=True)
def _maps(encoder: FrameEncoder, obs: Tensor, dtype: torch.dtype) -> Tensor:
    pixels = obs.reshape(-1, *obs.shape[-3:]).contiguous(memory_format=torch.channels_last).to(dtype, copy=True)
    image = pixels.mul_(1 / 255).sub_(0.5)
    return encoder.convolutions(image).view(*obs.shape[:-3], *encoder.map_shape)


@compiled_on_gpu(training=True)
def _features(encoder: FrameEncoder, obs: Tensor, dtype: torch.dtype) -> Tensor:
    return encoder.from_maps(_maps.__wrapped__(encoder, obs, dtype))


def _rectified(channels: int, *shapes: tuple[int, int, int]) -> list[nn.Module]:
    """Rectified convolutions by output channels, extent and stride."""
    layers: list[nn.Module] = []
    for width, extent, stride in shapes:
        layers += [nn.Conv2d(channels, width, extent, stride=stride), nn.ReLU()]
        channels = width
    return layers


def _drq(channels: int, size: int, options: FrameOptions) -> nn.Sequential:
    """Four 3x3 convolutions of 32 channels, the first with stride 2 (Kostrikov et al. 2020; used by V-D4RL)."""
    return nn.Sequential(*_rectified(channels, (32, 3, 2), (32, 3, 1), (32, 3, 1), (32, 3, 1)))


def _nature(channels: int, size: int, options: FrameOptions) -> nn.Sequential:
    """Three convolutions, two of them strided (Mnih et al. 2015): a fraction of DrQ's cost."""
    return nn.Sequential(*_rectified(channels, (32, 8, 4), (64, 4, 2), (64, 3, 1)))


def _nature_half(channels: int, size: int, options: FrameOptions) -> nn.Sequential:
    """The same at half the resolution: means over 2x2 pixels, which a first convolution of half the extent reads."""
    half = nn.AvgPool2d(2, ceil_mode=True)
    return nn.Sequential(half, *_rectified(channels, (32, 4, 2), (64, 4, 2), (64, 3, 1)))


def _small(channels: int, size: int, options: FrameOptions) -> nn.Sequential:
    """Three strided convolutions of 16 to 32 channels, for grey 50x50 pictures on a CPU."""
    return nn.Sequential(*_rectified(channels, (16, 5, 2), (32, 3, 2), (32, 3, 2)))


_PATCH, _MIXER_DIM, _MIXER_LAYERS = 10, 256, 8


class MixerLayer(nn.Module):
    """Mixes (N, patches, dim) over the patches, then over the features (Tolstikhin et al. 2021, arXiv 2105.01601)."""

    def __init__(self, patches: int, dim: int) -> None:
        super().__init__()
        self.norms = nn.ModuleList([nn.LayerNorm(dim), nn.LayerNorm(dim)])
        self.over_patches = nn.Sequential(nn.Linear(patches, dim // 2), nn.GELU(), nn.Linear(dim // 2, patches))
        self.over_features = nn.Sequential(nn.Linear(dim, 4 * dim), nn.GELU(), nn.Linear(4 * dim, dim))

    def forward(self, x: Tensor) -> Tensor:
        """Same shape."""
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
            f"frame encoder 'mixer' cuts pictures into patches of {_PATCH} pixels, and {size} is no multiple of it: "
            "choose another --frame-encoder"
        )
    layers = [MixerLayer((size // _PATCH) ** 2, _MIXER_DIM) for _ in range(_MIXER_LAYERS)]
    patches = nn.Conv2d(channels, _MIXER_DIM, _PATCH, stride=_PATCH)
    return nn.Sequential(patches, _Patches(), *layers, nn.LayerNorm(_MIXER_DIM), _Pool())


def _flat(channels: int, size: int, options: FrameOptions) -> nn.Sequential:
    """No convolution: for observations that are a handful of numbers, as in finite worlds."""
    return nn.Sequential()


@dataclass(frozen=True)
class PretrainedOptions(FrameOptions):
    """Options of a frozen image model."""

    model: str = "facebook/dinov2-small"
    """Name of a model in transformers' cache on this machine, or a folder that its save_pretrained wrote."""
    model_size: int = 224
    """Height and width to which frames are resized for it."""
    weights: str = ""
    """Content hash that its weights must have; empty: any, and the encoder's record tells which they were."""

    limits: ClassVar[Limits] = {"model_size": (1, 4096)}


def _pretrained(channels: int, size: int, options: PretrainedOptions) -> Pretrained:
    """Frozen features of each frame by a model of transformers; the linear layer behind them is trained."""
    return Pretrained(options.model, options.model_size, options.weights, channels)


STATE = "state"
"""Frame encoder of the `state` reference, which is no part: it reads no pixels."""


def _refuse_part(name: str, part: FrameEncoderPart) -> None:
    """Raise UserError for a frame encoder that could not be told from another, or whose options cannot work."""
    if name == STATE:
        raise UserError("encoders of simulator states have this name: choose another")
    refuse_options(part.options, FrameOptions)


FRAME_ENCODERS: Registry[FrameEncoderPart] = Registry(
    "frame encoder",
    {
        "drq": FrameEncoderPart(_drq, summary="four 3x3 convolutions of 32 channels, as in DrQ and V-D4RL"),
        "nature": FrameEncoderPart(
            _nature, summary="three convolutions of 32 and 64 channels, at a fraction of drq's cost"
        ),
        "nature_half": FrameEncoderPart(_nature_half, summary="nature on pictures of half the resolution"),
        "small": FrameEncoderPart(
            _small, summary="three strided convolutions of few channels, for grey 50x50 pictures"
        ),
        "mixer": FrameEncoderPart(_mixer, summary="MLP-Mixer on patches of 10x10 pixels: the paper's on mazes"),
        "pretrained": FrameEncoderPart(
            _pretrained, PretrainedOptions, "a frozen image model that transformers knows by name, DINOv2 by default"
        ),
        "flat": FrameEncoderPart(_flat, summary="no convolution, for observations of a few numbers"),
    },
    lambda part: isinstance(part, FrameEncoderPart),
    "a vd4rl_pomdp.nn.frame.FrameEncoderPart",
    _refuse_part,
)
"""All frame encoders. Packages offer theirs in the group of entry points `vd4rl_pomdp.frame_encoders`."""


class StateFrame(nn.Module):
    """Hands the simulator state through, in place of pixels: (..., P, 1, 1) -> (..., P) float32."""

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
        """See the class.

        Args:
            width: coordinates P of a state.
            noise: standard deviation of the noise that is added to each coordinate; empty for none.
            mean, std: of each coordinate, which is standardised; empty: states stay as they are.
            hidden_share: probability with which a coordinate is set to zero, its mean.

        Raises:
            ValueError: numbers of another width.
        """
        super().__init__()
        for values in (noise, mean, std):
            if len(values) not in (0, width):
                raise ValueError(f"{len(values)} numbers for states of {width} coordinates")
        self.width, self.hidden_share = width, hidden_share
        for name, values in (("noise", noise), ("mean", mean), ("std", std)):
            self.register_buffer(name, torch.tensor(values, dtype=torch.float64), persistent=False)
        self.nothing = nn.Parameter(torch.zeros(0))
        """Optimisers and files want one."""

    def forward(self, obs: Tensor) -> Tensor:
        """The state itself.

        Raises:
            UserError: it has another width, as those of earlier versions have.
        """
        if obs.shape[-3] != self.width:
            raise UserError(
                f"this encoder reads states of {self.width} coordinates, the task's have {obs.shape[-3]}: "
                "pretrain the reference `state` again"
            )
        return obs.flatten(-3).float()

    @property
    def draws(self) -> bool:
        """Whether what is observed of a state depends on a key."""
        return len(self.noise) > 0 or self.hidden_share > 0

    def observe(self, state: Tensor, key: Tensor) -> Tensor:
        """Observations of states.

        Args:
            state: (..., P) float32.
            key: (...,) int64, what noise and hidden coordinates are drawn from; equal keys give equal ones.

        Returns:
            (..., P, 1, 1) float32.
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
    """Build a frame encoder by name for pictures (channels, size, size), with values of its options.

    Raises:
        UserError: an unknown name or option, a module that makes no maps, or cannot read pictures of this size.
    """
    part = FRAME_ENCODERS.named(name)
    options = part.options.fill(settings)
    if unknown := settings.keys() - vars(options).keys():
        raise UserError(f"frame encoder {name!r} has no option {min(unknown)!r}")
    try:
        maps = part.build(channels, size, options)
        if not isinstance(maps, nn.Module):
            raise UserError(
                f"frame encoder {name!r} builds a {type(maps).__name__}, not a module: return what makes the maps"
            )
        encoder = FrameEncoder(maps, channels, size, options.feature_dim)
    except RuntimeError as error:
        raise UserError(
            f"frame encoder {name!r} cannot read pictures of {size}x{size} pixels ({first_line(error)}): choose "
            "another --frame-encoder, or a set of larger frames"
        ) from error
    if len(encoder.map_shape) != 3:
        raise UserError(
            f"frame encoder {name!r} makes {('N', *encoder.map_shape)} of N pictures, not maps (N, C', H', W'): "
            "give its module's output height and width, 1 for none"
        )
    for parameter in encoder.parameters():
        if parameter.dim() == 4:
            parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
    return encoder

"""Frame encoders e(o): convolutions on one frame stack, then Linear, LayerNorm, Tanh."""

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
    """Dimension of the frame encoder's output."""

    limits: ClassVar[Limits] = {"feature_dim": 1}


def encoder_settings(options: Options) -> dict[str, Any]:
    """Split a frame encoder's options into the `EncoderConfig` fields `feature_dim` and `frame_options` (the rest)."""
    told = asdict(options)
    return {"feature_dim": told.pop("feature_dim"), "frame_options": told}


@dataclass(frozen=True)
class FrameEncoderPart:
    """How to build a frame encoder's convolutions; `FrameEncoder` adds Linear, LayerNorm and Tanh."""

    build: Callable[[int, int, Any], nn.Module]
    """Called with (channels, size, options); returns a module (N, C, size, size) -> (N, C', H', W') of pixels in
    [-0.5, 0.5]. Its optional attribute `found` is a dict of option values known only after building, such as the hash
    of the weights that a model name stands for; the encoder's config records them."""
    options: type[FrameOptions] = FrameOptions
    """Class of its options."""
    summary: str = ""
    """One-line description."""


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
        """Feature maps (..., C', H', W') of every stack, the input of `from_maps`."""
        return _maps(self, obs, self._precision(obs))

    def from_maps(self, maps: Tensor) -> Tensor:
        """Features (..., feature_dim) float32 of feature maps."""
        dtype = next(self.project.parameters()).dtype
        return self.project(maps.flatten(-3).flatten(0, -2)).to(dtype).view(*maps.shape[:-3], -1)

    def _precision(self, obs: Tensor) -> torch.dtype:
        """Dtype that pixels are converted to."""
        if torch.is_autocast_enabled(obs.device.type):
            return torch.get_autocast_dtype(obs.device.type)  # a float32 copy would be the largest tensor in memory
        return next(self.project.parameters()).dtype


# functions, not methods: deepcopy of an encoder must not copy compiled code
@compiled_on_gpu(training=True)
def _maps(encoder: FrameEncoder, obs: Tensor, dtype: torch.dtype) -> Tensor:
    pixels = obs.reshape(-1, *obs.shape[-3:]).contiguous(memory_format=torch.channels_last).to(dtype, copy=True)
    image = pixels.mul_(1 / 255).sub_(0.5)
    return encoder.convolutions(image).view(*obs.shape[:-3], *encoder.map_shape)


@compiled_on_gpu(training=True)
def _features(encoder: FrameEncoder, obs: Tensor, dtype: torch.dtype) -> Tensor:
    return encoder.from_maps(_maps.__wrapped__(encoder, obs, dtype))


def _rectified(channels: int, *shapes: tuple[int, int, int]) -> list[nn.Module]:
    """Convolutions with ReLU; each shape is (output channels, kernel size, stride)."""
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
    """Nature at half resolution: 2x2 average pooling, then a first convolution with half the kernel size and stride."""
    half = nn.AvgPool2d(2, ceil_mode=True)
    return nn.Sequential(half, *_rectified(channels, (32, 4, 2), (64, 4, 2), (64, 3, 1)))


def _small(channels: int, size: int, options: FrameOptions) -> nn.Sequential:
    """Three strided convolutions of 16 to 32 channels, for grey 50x50 images on a CPU."""
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
            f"frame encoder 'mixer' cuts images into patches of {_PATCH} pixels, and {size} is not a multiple: "
            "choose another --frame-encoder"
        )
    layers = [MixerLayer((size // _PATCH) ** 2, _MIXER_DIM) for _ in range(_MIXER_LAYERS)]
    patches = nn.Conv2d(channels, _MIXER_DIM, _PATCH, stride=_PATCH)
    return nn.Sequential(patches, _Patches(), *layers, nn.LayerNorm(_MIXER_DIM), _Pool())


def _flat(channels: int, size: int, options: FrameOptions) -> nn.Sequential:
    """No convolution, for observations of a few numbers, as in the finite worlds of the theory study."""
    return nn.Sequential()


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


def _pretrained(channels: int, size: int, options: PretrainedOptions) -> Pretrained:
    """Frozen features of each frame from a transformers model; only the linear layer after them is trained."""
    return Pretrained(options.model, options.model_size, options.weights, channels)


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
        "drq": FrameEncoderPart(_drq, summary="four 3x3 convolutions of 32 channels, as in DrQ and V-D4RL"),
        "nature": FrameEncoderPart(
            _nature, summary="three convolutions of 32 and 64 channels, at a fraction of drq's cost"
        ),
        "nature_half": FrameEncoderPart(_nature_half, summary="nature at half the resolution"),
        "small": FrameEncoderPart(_small, summary="three strided convolutions of few channels, for grey 50x50 images"),
        "mixer": FrameEncoderPart(_mixer, summary="MLP-Mixer on patches of 10x10 pixels, as in the paper's mazes"),
        "pretrained": FrameEncoderPart(
            _pretrained, PretrainedOptions, "a frozen image model from Hugging Face transformers, DINOv2 by default"
        ),
        "flat": FrameEncoderPart(_flat, summary="no convolution, for observations of a few numbers"),
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
        """Initialise.

        Args:
            width: number of coordinates P.
            noise: standard deviation of the noise added to each coordinate; empty: no noise.
            mean, std: statistics that standardise each coordinate; empty: states are not standardised.
            hidden_share: probability of setting a coordinate to zero, its standardised mean.

        Raises:
            ValueError: noise, mean or std is neither empty nor of length P.
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
        """Features (..., P) float32: the state itself.

        Raises:
            UserError: the state has another width, as in earlier versions.
        """
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
        """Turn states into observations: add noise, standardise, hide coordinates.

        Args:
            state: (..., P) float32.
            key: (...,) int64 keys of the random draws; equal keys give equal noise and hidden coordinates.

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
    """Build a frame encoder by name for images (channels, size, size); `settings` are its options by name.

    Raises:
        UserError: an unknown name or option, or a module that cannot read images of this size or returns no maps.
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
            f"frame encoder {name!r} cannot read images of {size}x{size} pixels ({first_line(error)}): choose "
            "another --frame-encoder, or a dataset of larger frames"
        ) from error
    if len(encoder.map_shape) != 3:
        raise UserError(
            f"frame encoder {name!r} makes {('N', *encoder.map_shape)} of N images, not maps (N, C', H', W'): "
            "give its module's output height and width, 1 for none"
        )
    for parameter in encoder.parameters():
        if parameter.dim() == 4:
            parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
    return encoder

"""All registered frame encoders satisfy the contract of frame encoders; violations are caught."""

from collections.abc import Callable

import pytest
import torch
from torch import nn

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.nn.frame import FRAME_ENCODERS, FrameEncoderPart
from vd4rl_pomdp.testing import check_frame_encoder
from vd4rl_pomdp.testing import frame_encoders as checks
from vd4rl_pomdp.testing.contract import run_check

SIZE = 20
"""Image size that all encoders with small kernels can read."""


@pytest.mark.parametrize("check", checks.CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize(
    "name", [name for name in FRAME_ENCODERS if name != "pretrained"]
)  # tests/nn/test_pretrained.py
def test_frame_encoder_conforms(name, check):
    run_check("frame encoder", check, name, size=50)


def convolution(channels: int, size: int, options: object) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(channels, 4, 5, stride=3), nn.ReLU())


def with_layer(make: Callable[[], nn.Module]) -> Callable[..., nn.Sequential]:
    """A frame encoder with an additional layer."""
    return lambda channels, size, options: nn.Sequential(convolution(channels, size, options), make())


class Flat(nn.Module):
    def forward(self, x):
        return x.flatten(1)


class Bounded(nn.Module):
    """Its features are not finite."""

    def forward(self, x):
        return x / (x * 0)


class Lost(nn.Module):
    def __init__(self):
        super().__init__()
        self.unused = nn.Linear(2, 2)

    def forward(self, x):
        return x


class Hidden(nn.Module):
    """Its weight is not part of its state."""

    def __init__(self):
        super().__init__()
        self.weight = torch.rand(()) + 1

    def forward(self, x):
        return x * self.weight


class Whitened(nn.Module):
    """Normalises by statistics of the batch, without a gradient."""

    def forward(self, x):
        return (x - x.mean().detach()) / (x.std().detach() + 1e-3)


class Backbone(nn.Conv2d):
    """Frozen pretrained weights."""

    def __init__(self):
        super().__init__(4, 4, 1)
        self.requires_grad_(False)


MUTANTS = [
    (Bounded, checks.features_have_one_shape, "some are not finite"),
    (
        lambda: nn.BatchNorm2d(4),
        checks.images_are_not_mixed,
        r"features of image 1 have gradients to \[True, True, True\]",
    ),
    (Whitened, checks.images_are_not_mixed, "image 1 has other features in a batch than alone"),
    (
        Lost,
        checks.gradients_reach_all_parameters,
        "none reaches convolutions.1.unused.bias, convolutions.1.unused.weight",
    ),
    (nn.Dropout, checks.a_seed_decides_everything, "features differ between calls, training True"),
    (Hidden, checks.a_folder_gives_back_the_encoder, "its features differ"),
]


@pytest.mark.parametrize(("layer", "check", "reason"), MUTANTS, ids=lambda value: getattr(value, "__name__", ""))
def test_nonconforming_frame_encoders_are_caught(layer, check, reason):
    FRAME_ENCODERS.register("mine", FrameEncoderPart(with_layer(layer)))
    with pytest.raises(AssertionError, match=f"frame encoder 'mine' violates its contract(.|\n)*{reason}"):
        run_check("frame encoder", check, "mine", size=SIZE)


def test_frozen_backbone_conforms():
    FRAME_ENCODERS.register("mine", FrameEncoderPart(with_layer(Backbone)))
    check_frame_encoder("mine", size=SIZE)


def test_check_frame_encoder_accepts_conforming_encoders():
    FRAME_ENCODERS.register("mine", FrameEncoderPart(convolution))
    check_frame_encoder("mine")
    check_frame_encoder("mine", size=SIZE, feature_dim=5)
    with pytest.raises(UserError, match="--depth is not read by"):
        check_frame_encoder("mine", depth=3)
    with pytest.raises(UserError, match="'mixer' cuts images into patches"):
        check_frame_encoder("mixer", size=84)
    for name in ("vit", "state"):
        with pytest.raises(UserError, match=f"unknown frame encoder '{name}'"):
            check_frame_encoder(name)


class Twice(nn.Module):
    """A convolution used twice under two names."""

    def __init__(self):
        super().__init__()
        self.first = self.second = nn.Conv2d(4, 4, 1)

    def forward(self, x):
        return self.second(self.first(x))


class OverFrames(nn.Module):
    """A convolution over positions and frames."""

    def __init__(self):
        super().__init__()
        self.convolution = nn.Conv3d(1, 2, (2, 1, 1))

    def forward(self, x):
        return self.convolution(x[:, None]).flatten(1, 2)


@pytest.mark.parametrize("layer", [Twice, OverFrames])
def test_shared_weights_and_3d_convolutions_conform(layer):
    FRAME_ENCODERS.register("mine", FrameEncoderPart(with_layer(layer)))
    check_frame_encoder("mine", size=SIZE)


class Pair(nn.Module):
    def forward(self, x):
        return x, x


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (with_layer(Flat), r"makes \('N', 144\) of N images, not maps \(N, C', H', W'\): give its module's output"),
        (lambda channels, size, options: None, "frame encoder 'mine' builds a NoneType, not a module: return what"),
        (lambda channels, size, options: Pair(), r"'mine' makes a tuple of N images, not maps \(N, C', H', W'\)"),
    ],
)
def test_invalid_frame_encoders_are_rejected(build, message):
    FRAME_ENCODERS.register("mine", FrameEncoderPart(build))
    with pytest.raises(UserError, match=message):
        checks.make("mine", size=SIZE)


def test_reserved_frame_encoder_name_is_rejected():
    with pytest.raises(UserError, match="frame encoder 'state': this name is reserved"):
        FRAME_ENCODERS.register("state", FrameEncoderPart(convolution))

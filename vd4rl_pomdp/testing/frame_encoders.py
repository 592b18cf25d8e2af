"""Conformance checks of frame encoders: shapes, no mixing of images, gradients, determinism, saving and loading."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from pretrain.config import PretrainConfig
from pretrain.train import build_objective
from vd4rl_pomdp.core.options import check_options
from vd4rl_pomdp.core.tasks import FRAME_SIZE, FRAME_STACK
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.nn.frame import FRAME_ENCODERS, FrameEncoder
from vd4rl_pomdp.testing.contract import (
    Check,
    claim,
    claim_close,
    claim_equal,
    claim_gradients,
    reloaded,
    run_checks,
    weighted_sum,
)

CHANNELS = 3 * FRAME_STACK


def check_frame_encoder(name: str, size: int = FRAME_SIZE, **options: Any) -> None:
    """Run all checks on a frame encoder of `vd4rl_pomdp.nn.frame.FRAME_ENCODERS`, on images of `size`.

    UserError also if it cannot read images of that size or returns no maps.
    """
    FRAME_ENCODERS.named(name)
    check_options(PretrainConfig.of("smoke", frame_encoder=name, **options))
    run_checks("frame encoder", CHECKS, name, size=size, **options)


def make(name: str, size: int = FRAME_SIZE, **options: Any) -> Encoder:
    """A memoryless encoder with the frame encoder; identical at every call."""
    config = PretrainConfig.of("smoke", method="curl", frame_encoder=name, **options)
    torch.manual_seed(0)
    return build_objective(config, 2, None, observation=(CHANNELS, size)).encoder


def pictures(count: int, size: int = FRAME_SIZE) -> Tensor:
    """Random images (count, C, size, size) uint8; identical at every call."""
    shape = (count, CHANNELS, size, size)
    return torch.randint(0, 256, shape, generator=torch.Generator().manual_seed(0), dtype=torch.uint8)


def features_have_one_shape(name: str, **options: Any) -> None:
    """Frame encoders map images (..., C, S, S), uint8 or float in [0, 255], to finite float32 features (...,
    feature_dim)."""
    encoder, size = make(name, **options), options["size"]
    frame, width, obs = encoder.frame, encoder.config.feature_dim, pictures(6, size)
    assert isinstance(frame, FrameEncoder)
    with torch.no_grad():
        flat, windows, floats = frame(obs), frame(obs.view(2, 3, *obs.shape[1:])), frame(obs.float())
    for z, shape in ((flat, (6, width)), (windows, (2, 3, width)), (floats, (6, width))):
        claim((tuple(z.shape), z.dtype) == (shape, torch.float32), f"{tuple(z.shape)} {z.dtype}")
        claim(z.isfinite().all(), "some are not finite")
    claim_close(windows.flatten(0, 1), flat, "windows give other features than a batch", 1e-5)
    claim_close(floats, flat, "float images give other features than uint8", 1e-5)


def images_are_not_mixed(name: str, **options: Any) -> None:
    """The features of an image depend on that image alone, not on the rest of the batch, in train and eval mode."""
    obs = pictures(3, options["size"]).float().requires_grad_()
    for training in (False, True):
        features = make(name, **options).frame.train(training)(obs)
        (gradient,) = torch.autograd.grad(weighted_sum(features[1]), obs)
        reached = gradient.flatten(1).abs().amax(1) > 0
        claim(reached.tolist() == [False, True, False], f"features of image 1 have gradients to {reached.tolist()}")
    uneven = pictures(3, options["size"]) // torch.tensor([1, 2, 8])[:, None, None, None]
    with torch.no_grad():  # what gradients do not show, such as detached statistics of the batch
        frame = make(name, **options).frame.eval()
        claim_close(frame(uneven)[1], frame(uneven[1:2])[0], "image 1 has other features in a batch than alone", 1e-5)


def gradients_reach_all_parameters(name: str, **options: Any) -> None:
    """A loss on the features has a gradient to every parameter with `requires_grad`."""
    frame = make(name, **options).frame
    weighted_sum(frame(pictures(3, options["size"]))).backward()
    claim_gradients((key, value) for key, value in frame.named_parameters() if value.requires_grad)


def a_seed_decides_everything(name: str, **options: Any) -> None:
    """The torch seed determines the weights, and the features of an image are deterministic."""
    one, other, obs = make(name, **options), make(name, **options), pictures(2, options["size"])
    claim_equal(one.state_dict(), other.state_dict(), "these differ from build to build")
    for training in (True, False):
        with torch.no_grad():
            first, second = (one.train(training).frame(obs) for _ in range(2))
        claim(torch.equal(first, second), f"features differ between calls, training {training}")


def a_folder_gives_back_the_encoder(name: str, **options: Any) -> None:
    """Saving and loading an encoder preserves its options and features."""
    encoder, obs = make(name, **options).eval(), pictures(2, options["size"])
    with torch.no_grad():
        claim(torch.equal(reloaded(encoder).frame(obs), encoder.frame(obs)), "its features differ")


CHECKS: tuple[Check, ...] = (
    a_seed_decides_everything,
    features_have_one_shape,
    images_are_not_mixed,
    gradients_reach_all_parameters,
    a_folder_gives_back_the_encoder,
)

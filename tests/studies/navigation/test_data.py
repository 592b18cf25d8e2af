"""What a model is shown of a maze."""

import torch

from vd4rl_pomdp.envs.mazes import MAZES
from vd4rl_pomdp.studies.navigation.collect import SAMPLES, sample_observations
from vd4rl_pomdp.studies.navigation.pictures import to_grey50, to_rgb50


def test_grey_quarters_are_area_averages_of_the_luminance():
    pictures = torch.randint(0, 256, (3, 3, 100, 100), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    luma = (pictures.double() * torch.tensor([0.299, 0.587, 0.114])[:, None, None]).sum(1)
    expected = luma.view(3, 50, 2, 50, 2).mean((2, 4))
    assert (to_grey50(pictures)[:, 0].double() - expected).abs().max() <= 0.51


def test_colours_survive_at_half_the_size():
    pictures = torch.zeros(2, 3, 100, 100, dtype=torch.uint8)
    pictures[0, 2, ::2] = 201
    pictures[1, 0, :, :50] = 7
    small = to_rgb50(pictures)
    assert small.shape == (2, 3, 50, 50)
    assert (small[0, 2] == 101).all()
    assert (small[1, 0, :, :25] == 7).all()
    assert int((small > 0).sum()) == 2500 + 1250


def test_sample_observations_are_of_different_moments_and_mazes():
    samples = sample_observations()
    assert list(samples) == [*MAZES, "three_curtains, grey50", "three_curtains, exogenous textures"]
    assert [len(pictures) for pictures in samples.values()] == [SAMPLES] * 11
    assert all(len({picture.tobytes() for picture in pictures}) > 1 for pictures in samples.values())
    assert len({pictures.tobytes() for pictures in samples.values()}) == 11

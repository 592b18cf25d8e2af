import torch

from vd4rl_pomdp.navigation.observations import to_grey50


def test_grey_quarters_are_area_averages_of_the_luminance():
    pictures = torch.randint(0, 256, (3, 3, 100, 100), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    luma = (pictures.double() * torch.tensor([0.299, 0.587, 0.114])[:, None, None]).sum(1)
    expected = luma.view(3, 50, 2, 50, 2).mean((2, 4))
    assert (to_grey50(pictures)[:, 0].double() - expected).abs().max() <= 0.51

import pytest
import torch

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.nn.frame import StateFrame, make_frame_encoder


def test_state_of_another_width_is_rejected():
    frame = StateFrame(17)
    assert frame(torch.zeros(2, 17, 1, 1)).shape == (2, 17)
    with pytest.raises(UserError, match="reads states of 17 coordinates, the task's have 18: pretrain the reference"):
        frame(torch.zeros(2, 18, 1, 1))
    for channels in (9, 17):
        with pytest.raises(UserError, match=r"reads simulator states \(..., 17, 1, 1\), not images \(2, \d+, 84, 84\)"):
            frame(torch.zeros(2, channels, 84, 84))


@pytest.mark.parametrize("size", [84, 83])
def test_nature_half_averages_two_by_two_pixels(size: int):
    encoder = make_frame_encoder("nature_half", 1, size, {"feature_dim": 8}).double()
    picture = torch.randint(0, 128, (1, 1, size, size)).double() * 2
    moved = picture.clone()
    moved[..., 10, 20:22] += torch.tensor([1.0, -1.0])
    torch.testing.assert_close(encoder(moved), encoder(picture))
    picture.requires_grad_()
    encoder.convolutions(picture).square().sum().backward()
    assert picture.grad is not None
    assert picture.grad[0, 0].count_nonzero() == size**2
    assert encoder.map_shape == (64, 7, 7)

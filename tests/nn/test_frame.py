import pytest
import torch

from vd4rl_pomdp.errors import UserError
from vd4rl_pomdp.nn.frame import StateFrame


def test_a_state_of_another_width_is_refused_in_a_line():
    frame = StateFrame(17)
    assert frame(torch.zeros(2, 17, 1, 1)).shape == (2, 17)
    with pytest.raises(UserError, match="reads states of 17 coordinates, the task's have 18: pretrain the reference"):
        frame(torch.zeros(2, 18, 1, 1))

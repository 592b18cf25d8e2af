import torch

from vd4rl_pomdp.core.buffers import FrameBuffers


def test_memory_is_lent_again_only_when_no_tensor_uses_it():
    buffers = FrameBuffers()
    first = buffers.take((2, 3, 84, 84))
    address = first.data_ptr()
    part = first.view(-1)[5:9]
    del first
    assert buffers.take((2, 3, 84, 84)).data_ptr() != address, "a view of the first block is alive"
    del part
    assert address in {tensor.data_ptr() for tensor in [buffers.take((2, 3, 84, 84)) for _ in range(2)]}


def test_a_batch_of_another_size_gets_its_own_memory():
    buffers = FrameBuffers()
    shapes = [tuple(buffers.take((count, 3, 84, 84)).shape) for count in (3, 1, 2, 3, 0, 5, 4)]
    assert shapes == [(count, 3, 84, 84) for count in (3, 1, 2, 3, 0, 5, 4)]


def test_many_living_batches_never_share_memory():
    buffers = FrameBuffers()
    held = [buffers.take((1, 3, 84, 84)).fill_(i) for i in range(9)]
    assert [int(tensor.float().mean()) for tensor in held] == list(range(9))
    assert len({tensor.data_ptr() for tensor in held}) == 9
    assert held[0].dtype == torch.uint8

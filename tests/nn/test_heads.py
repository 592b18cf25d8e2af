"""Heads and action targets match their formulas."""

import subprocess
import sys

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from vd4rl_pomdp.nn.action_target import BinsTarget, KMeansTarget, MSETarget
from vd4rl_pomdp.nn.heads import PairHead, all_pairs, info_nce

ROWS, MAX_K = 5, 3


def test_all_pairs_are_limited_by_window_and_max_k():
    expected = {(t, k) for t in range(ROWS) for k in range(1, ROWS) if t + k < ROWS and k <= MAX_K}
    pairs = [tuple(pair) for pair in all_pairs(ROWS, MAX_K).tolist()]
    assert set(pairs) == expected
    assert len(pairs) == len(expected)


def test_pair_head_depends_on_two_rows_and_their_gap():
    torch.manual_seed(0)
    net, past, future = PairHead(4, 6, MAX_K, 2, 8, True), torch.randn(3, ROWS, 4), torch.randn(3, ROWS, 6)
    pairs = all_pairs(ROWS, MAX_K)
    out = net(past, future, pairs)
    for p, (t, k) in enumerate(pairs.tolist()):
        single = net.rest(net.past(past[:, t]) + net.future(future[:, t + k]) + net.k.weight[k])
        torch.testing.assert_close(out[:, p], single)


def test_info_nce_mask_equals_removing_rows():
    generator = torch.Generator().manual_seed(0)
    scores, real = torch.randn(3, 6, 6, generator=generator), torch.tensor([True, False, True, True, False, True])
    group = torch.tensor([0, 0, 0, 1, 1, 1])
    for groups in (None, group):
        expected = info_nce(scores[:, real][:, :, real], None if groups is None else groups[real])
        torch.testing.assert_close(info_nce(scores, groups, real), expected)


def test_k_means_is_fitted_without_importing_sklearn():
    pytest.importorskip("sklearn")
    actions = np.random.default_rng(0).uniform(-1, 1, (300, 2)).astype(np.float32)
    program = f"""
import sys, numpy as np, pretrain.train
from vd4rl_pomdp.nn.action_target import KMeansTarget
actions = np.frombuffer(bytes.fromhex("{actions.tobytes().hex()}"), np.float32).reshape(-1, 2)
print(KMeansTarget(actions, 5, 3).centers.numpy().tobytes().hex())
print({{"sklearn", "scipy", "pandas", "matplotlib", "mujoco"}} & set(sys.modules))
"""
    centers = KMeansTarget(actions, 5, 3).centers.numpy().tobytes().hex()
    printed = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert printed.split() == [centers, "set()"]
    failing = "import sys; sys.executable = '/nowhere'" + program  # without a subprocess it is fitted in this process
    printed = subprocess.run([sys.executable, "-c", failing], capture_output=True, text=True, check=True).stdout
    assert printed.split()[0] == centers


def test_k_means_target_is_the_nearest_centre():
    generator = torch.Generator().manual_seed(0)
    spots = torch.tensor([[-0.8, -0.8], [0.8, -0.8], [0.0, 0.8]])
    actions = spots.repeat(50, 1) + 0.05 * torch.randn(150, 2, generator=generator)
    target = KMeansTarget(actions.numpy(), 3, seed=0)
    found = torch.cdist(spots, target.centers)
    assert found.min(1).values.max() < 0.05, "the centres are those of the three clusters"
    code = found.argmin(1).repeat(50)
    sure = 50.0 * F.one_hot(code, 3)
    assert target.loss(sure, actions).max() < 1e-6, "the own cluster is the correct class"
    assert target.loss(-sure, actions).min() > 10
    torch.testing.assert_close(target.loss(torch.zeros(150, 3), actions), torch.full((150,), 3.0).log())


def test_bins_divide_each_dimension_equally():
    target = BinsTarget(2, 4)
    action = torch.tensor([[-1.0, -0.51], [-0.49, 0.01], [0.49, 0.51], [1.0, 3.0]])
    code = torch.tensor([[0, 0], [1, 2], [2, 3], [3, 3]])
    sure = 50.0 * F.one_hot(code, 4).flatten(1)
    assert target.loss(sure, action).max() < 1e-6
    half = sure.clone()
    half[:, 4:] = 0  # uniform over the bins of the second dimension
    torch.testing.assert_close(target.loss(half, action), torch.full((4,), 4.0).log() / 2)


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_mse_is_a_mean_and_normalised_mse_ignores_length(scale: float):
    prediction, action = torch.tensor([[3.0, 4.0]]), torch.tensor([[0.0, 1.0]])
    assert MSETarget(2, normalise=False).loss(prediction, action).item() == pytest.approx((9 + 9) / 2)
    normalised = MSETarget(2, normalise=True).loss(scale * prediction, 3 * scale * action).item()
    assert normalised == pytest.approx(1 - 4 / 5), "of unit vectors: (2 - 2 cos) / 2"


def test_k_means_is_seeded():
    actions = torch.rand(
        300, 4, generator=torch.Generator().manual_seed(0)
    ).numpy()  # one cluster, so the solution depends on the seed
    first, second = (KMeansTarget(actions, 8, seed=1).centers for _ in range(2))
    assert torch.equal(first, second)
    assert not torch.equal(first, KMeansTarget(actions, 8, seed=2).centers)

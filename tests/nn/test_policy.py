"""The network on representations."""

import numpy as np
import torch

from vd4rl_pomdp.nn.policy import Standardise


def test_policy_statistics_are_those_of_the_features():
    features = torch.randn(2, 500, 3) * torch.tensor([1.0, 5.0, 0.1]) + 2
    standardise = Standardise(3)
    standardise.fit(features)
    flat = standardise(features).reshape(-1, 3).numpy()
    assert np.allclose(flat.mean(0), 0, atol=1e-4)
    assert np.allclose(flat.std(0), 1, atol=0.02)

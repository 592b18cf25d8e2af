"""Updates match the papers' formulas, on small networks."""

import pytest
import torch

from finetune.algorithms import ALGORITHMS, Algorithm
from finetune.algorithms.bc import BC, noise_at
from finetune.features import FeatureBatch
from vd4rl_pomdp.core.streams import RandomStream
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.testing.algorithms import ACTIONS, DIM, batch


def make(kind: type) -> Algorithm:
    """An algorithm whose policy standardises its features."""
    torch.manual_seed(0)
    options = kind.options.fill({"gamma": 0.9, "alpha": 1.5})
    policy = Policy(DIM, ACTIONS, 16)
    policy.standardise.fit(batch().z)
    return kind(policy, options, 1e-3, 40, RandomStream(torch.Generator().manual_seed(0)))


def test_noise_decays_linearly_and_by_the_middle_of_short_trainings():
    """Else actions near a bound are pushed to it, because clipped noise biases the cloned mean."""
    found = [noise_at(updates, 10**6) for updates in (0, 62_500, 125_000, 10**6)]
    assert found == [noise_at(updates, 40) for updates in (0, 10, 20, 40)] == pytest.approx([1.0, 0.55, 0.1, 0.1])


def test_policies_standardise_representations():
    policy, given = make(BC).policy, batch()
    mean, std = given.z.mean(0), given.z.std(0, correction=0)
    torch.testing.assert_close(policy(given.z), policy.from_standardised((given.z - mean) / std), atol=1e-3, rtol=1e-3)


def test_value_based_algorithms_prefer_the_better_action():
    """One state, two actions, and only the rarer one is rewarded. BC chooses the mean action."""
    chosen = {}
    for name, build in ALGORITHMS.items():
        torch.manual_seed(0)
        policy, options = Policy(2, 1, 32), build.options.fill({"alpha": 25.0, "actor_bc": 0.04, "distillation": 0.1})
        algorithm = build(policy, options, 3e-3, 300, RandomStream(torch.Generator().manual_seed(0)))
        action = torch.where(torch.arange(64) % 4 == 0, 0.5, -0.5)[:, None]
        paid = (action[:, 0] > 0).float()
        batch = FeatureBatch(torch.zeros(64, 2), action, paid, torch.zeros(64), torch.zeros(64, 2), action)
        for _ in range(300):
            algorithm.update(batch)
        chosen[name] = policy(torch.zeros(1, 2)).item()
    assert chosen["bc"] == pytest.approx(-0.25, abs=0.02)
    assert all(chosen[name] > 0.2 for name in ("td3_bc", "rebrac", "drqv2_bc", "fql")), chosen
    assert chosen["iql"] > 0.1


@pytest.mark.parametrize("name", ["td3_bc", "rebrac", "drqv2_bc", "iql", "fql", "bc"])
def test_bf16_affects_only_matrix_products(name):
    full, half = make(ALGORITHMS[name]), make(ALGORITHMS[name])
    for seed in range(4):
        exact = full.update(batch(seed))
        with torch.autocast("cpu", torch.bfloat16, cache_enabled=False):
            rough = half.update(batch(seed))
        assert {value.dtype for value in rough.values()} == {torch.float32}
        for key, value in exact.items():
            torch.testing.assert_close(rough[key], value, atol=0.03, rtol=0.05)
    assert any(not torch.equal(rough[key], exact[key]) for key in exact), "products are rounded"
    assert {p.dtype for p in half.policy.parameters()} == {torch.float32}

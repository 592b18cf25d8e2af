"""Updates match the papers' formulas, on small networks."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from finetune.algorithms import ALGORITHMS, Algorithm
from finetune.algorithms.bc import BC, noise_at
from finetune.algorithms.drqv2_bc import DrQv2BC
from finetune.algorithms.iql import IQL
from finetune.algorithms.td3_bc import TwinCritic
from finetune.features import FeatureBatch
from vd4rl_pomdp.core.streams import RandomStream
from vd4rl_pomdp.nn.heads import ExactLinear, mlp
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.testing.algorithms import ACTIONS, DIM, SIZE, batch


def make(kind: type, learning_rate: float = 1e-3) -> Algorithm:
    """An algorithm whose policy standardises its features."""
    torch.manual_seed(0)
    options = kind.options.fill({"gamma": 0.9, "alpha": 1.5})
    policy = Policy(DIM, ACTIONS, 16)
    policy.standardise.fit(batch().z)
    return kind(policy, options, learning_rate, 40, RandomStream(torch.Generator().manual_seed(0)))


def test_drqv2_noise_decays_linearly_to_its_minimum():
    found = [noise_at(updates, 10**6) for updates in (0, 125_000, 250_000, 10**6)]
    assert found == pytest.approx([1.0, 0.55, 0.1, 0.1])


@pytest.mark.parametrize("kind", [BC, DrQv2BC])
def test_noise_schedule_ends_by_the_middle_of_short_trainings(monkeypatch, kind):
    """Else actions near a bound are pushed to it, because clipped noise biases the cloned mean."""
    stds = []
    module = sys.modules[kind.__module__]
    monkeypatch.setattr(module, "noise_at", lambda *args: stds.append(noise_at(*args)) or stds[-1])
    algorithm = make(kind)  # of 40 updates
    for number in range(40):
        algorithm.update(batch(number))
    per_update = stds[:: len(stds) // 40]
    assert per_update[:21:10] == pytest.approx([1.0, 0.55, 0.1])
    assert per_update[20:] == pytest.approx([0.1] * 20)


def numbers(algorithm: IQL, given: FeatureBatch) -> dict[str, np.ndarray]:
    """The quantities of IQL's equations: outputs of its networks for a batch."""
    with torch.no_grad():
        z, next_z = algorithm.policy.standardise(given.z), algorithm.policy.standardise(given.next_z)
        found = {
            "q": torch.stack(algorithm.critic(z, given.action)),
            "target_q": torch.stack(algorithm.target_critic(z, given.action)),
            "v": algorithm.value(z)[:, 0],
            "next_v": algorithm.value(next_z)[:, 0],
            "mean": algorithm.policy(given.z),
            "std": algorithm.gaussian.log_std.exp(),
        }
    given_numbers = {"action": given.action, "reward": given.reward, "discount": given.discount}
    return {name: value.double().numpy() for name, value in (found | given_numbers).items()}


def make_iql(temperature: float = 3.0) -> tuple[IQL, FeatureBatch]:
    """An IQL with zero learning rate, whose target networks and standard deviations are perturbed."""
    algorithm = make(IQL, learning_rate=0.0)
    algorithm.settings = replace(algorithm.settings, expectile=0.7, temperature=temperature)
    with torch.no_grad():
        for parameter in (*algorithm.target_critic.parameters(), *algorithm.gaussian.parameters()):
            parameter.add_(0.5 * torch.randn_like(parameter))
    algorithm.tau = 0.0
    return algorithm, batch()


def test_iql_losses_match_the_papers_equations():
    """Equations 5 (value), 6 (critics) and 7 (actor), with the minimum target value and the clipped weight."""
    algorithm, given = make_iql(temperature=8.0)
    n = numbers(algorithm, given)
    found = algorithm.update(given)
    target = n["reward"] + 0.9 * n["discount"] * n["next_v"]
    assert found["critic_loss"].item() == pytest.approx(((n["q"] - target) ** 2).mean(1).sum(), rel=1e-5)
    error = n["target_q"].min(0) - n["v"]
    value_loss = np.mean([(0.7 if u > 0 else 0.3) * u * u for u in error])
    assert found["value_loss"].item() == pytest.approx(value_loss, rel=1e-5)
    weight = np.minimum(np.exp(8.0 * error), 100.0)
    assert 0 < (weight == 100.0).sum() < SIZE, "some weights are clipped"
    density = np.exp(-((n["action"] - n["mean"]) ** 2) / (2 * n["std"] ** 2)) / (np.sqrt(2 * np.pi) * n["std"])
    assert found["actor_loss"].item() == pytest.approx(-(weight * np.log(density.prod(1))).mean(), rel=1e-4)
    assert found["weight"].item() == pytest.approx(weight.mean(), rel=1e-5)
    assert found["advantage"].item() == pytest.approx(error.mean(), rel=1e-4)


def test_iql_actor_gradient_ignores_the_weight():
    algorithm, given = make_iql()
    n = numbers(algorithm, given)
    algorithm.update(given)
    weight = torch.tensor(np.minimum(np.exp(3.0 * (n["target_q"].min(0) - n["v"])), 100.0)).float()
    log_std = algorithm.gaussian.log_std.detach().clone().requires_grad_()
    error = (given.action - algorithm.policy(given.z)) / log_std.exp()
    loss = (weight[:, None] * (error.square() / 2 + log_std)).sum(1).mean()
    expected = torch.autograd.grad(loss, [*algorithm.policy.net.parameters(), log_std])
    mine = [p.grad for p in (*algorithm.policy.net.parameters(), algorithm.gaussian.log_std)]
    for one, other in zip(mine, expected, strict=True):
        torch.testing.assert_close(one, other)
    assert all(p.grad is None for p in algorithm.target_critic.parameters())


def test_iql_log_std_is_clipped():
    algorithm, given = make_iql()
    for given_log_std, bound in ((-9.0, -5.0), (9.0, 2.0)):
        with torch.no_grad():
            algorithm.gaussian.log_std.fill_(given_log_std)
        likelihood = algorithm.gaussian(given.action, given.action)
        torch.testing.assert_close(likelihood, torch.full((SIZE,), -ACTIONS * (bound + 0.5 * np.log(2 * np.pi))))


def test_iql_target_critic_moves_before_the_value_update():
    """The authors' cycle is value, actor, critics, target: what follows the target's step is the value's."""
    algorithm, given = make_iql()
    algorithm.tau = 1.0
    z = algorithm.policy.standardise(given.z)
    with torch.no_grad():
        error = torch.minimum(*algorithm.critic(z, given.action)) - algorithm.value(z)[:, 0]
    assert algorithm.update(given)["advantage"].item() == pytest.approx(error.mean().item(), rel=1e-4)


def test_iql_actor_has_cosine_learning_rate():
    algorithm = make(IQL)
    rates = []
    for updates in (0, 10, 20, 30, 40, 50):  # of 40
        algorithm.updates = updates
        algorithm.update(batch())
        rates.append(algorithm.policy_optimiser.param_groups[0]["lr"] / 1e-3)
    assert rates == pytest.approx([1.0, (1 + 0.5**0.5) / 2, 0.5, (1 - 0.5**0.5) / 2, 0.0, 0.0])
    assert algorithm.critic_optimiser.param_groups[0]["lr"] == algorithm.value_optimiser.param_groups[0]["lr"] == 1e-3


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


def test_critic_outputs_keep_fp32_precision_in_bf16():
    """In bf16 values above 256 would be even numbers."""
    critic = TwinCritic(lambda: mlp(DIM + ACTIONS, 16, 1, last=ExactLinear))
    with torch.no_grad():
        critic.first[-1].bias.fill_(257.0)
        critic.first[-1].weight.zero_()
        with torch.autocast("cpu", torch.bfloat16):
            value, _ = critic(batch().z, batch().action)
    assert value.unique().tolist() == [257.0]

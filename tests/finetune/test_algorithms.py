"""Updates are what the papers' formulas say, on networks small enough to write the formulas out."""

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
    """An algorithm whose features need to be standardised."""
    torch.manual_seed(0)
    options = kind.options.fill({"gamma": 0.9, "alpha": 1.5})
    policy = Policy(DIM, ACTIONS, 16)
    policy.standardise.fit(batch().z)
    return kind(policy, options, learning_rate, 40, RandomStream(torch.Generator().manual_seed(0)))


def test_drqv2s_noise_decays_linearly_and_then_stays():
    found = [noise_at(updates, 10**6) for updates in (0, 125_000, 250_000, 10**6)]
    assert found == pytest.approx([1.0, 0.55, 0.1, 0.1])


@pytest.mark.parametrize("kind", [BC, DrQv2BC])
def test_noise_has_fallen_by_the_middle_of_a_training_shorter_than_v_d4rls(monkeypatch, kind):
    """Else a clone near a bound is pushed to it: what the data's mean action is held against has the noise cut off."""
    stds = []
    module = sys.modules[kind.__module__]
    monkeypatch.setattr(module, "noise_at", lambda *told: stds.append(noise_at(*told)) or stds[-1])
    algorithm = make(kind)  # of 40 updates
    for number in range(40):
        algorithm.update(batch(number))
    per_update = stds[:: len(stds) // 40]
    assert per_update[:21:10] == pytest.approx([1.0, 0.55, 0.1])
    assert per_update[20:] == pytest.approx([0.1] * 20)


def numbers(algorithm: IQL, given: FeatureBatch) -> dict[str, np.ndarray]:
    """What IQL's equations are about: the values that its networks give to a batch."""
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
    """An IQL whose networks and deviations differ from their targets and from each other, and do not learn."""
    algorithm = make(IQL, learning_rate=0.0)
    algorithm.settings = replace(algorithm.settings, expectile=0.7, temperature=temperature)
    with torch.no_grad():
        for parameter in (*algorithm.target_critic.parameters(), *algorithm.gaussian.parameters()):
            parameter.add_(0.5 * torch.randn_like(parameter))
    algorithm.tau = 0.0
    return algorithm, batch()


def test_iqls_losses_are_those_of_the_papers_equations():
    """Equations 5 (value), 6 (critics) and 7 (actor), with the smaller target value and the authors' clipped weight."""
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


def test_iqls_actor_follows_the_weighted_likelihood_and_no_gradient_of_the_weight():
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


def test_iqls_deviations_stay_within_the_authors_bounds():
    algorithm, given = make_iql()
    for given_log_std, bound in ((-9.0, -5.0), (9.0, 2.0)):
        with torch.no_grad():
            algorithm.gaussian.log_std.fill_(given_log_std)
        likelihood = algorithm.gaussian(given.action, given.action)
        torch.testing.assert_close(likelihood, torch.full((SIZE,), -ACTIONS * (bound + 0.5 * np.log(2 * np.pi))))


def test_iqls_target_critic_creeps_before_the_value_reads_it():
    """The authors' cycle is value, actor, critics, target: what follows the target's step is the value's."""
    algorithm, given = make_iql()
    algorithm.tau = 1.0
    z = algorithm.policy.standardise(given.z)
    with torch.no_grad():
        error = torch.minimum(*algorithm.critic(z, given.action)) - algorithm.value(z)[:, 0]
    assert algorithm.update(given)["advantage"].item() == pytest.approx(error.mean().item(), rel=1e-4)


def test_iqls_actor_learns_ever_more_slowly():
    algorithm = make(IQL)
    rates = []
    for updates in (0, 10, 20, 30, 40, 50):  # of 40
        algorithm.updates = updates
        algorithm.update(batch())
        rates.append(algorithm.policy_optimiser.param_groups[0]["lr"] / 1e-3)
    assert rates == pytest.approx([1.0, (1 + 0.5**0.5) / 2, 0.5, (1 - 0.5**0.5) / 2, 0.0, 0.0])
    assert algorithm.critic_optimiser.param_groups[0]["lr"] == algorithm.value_optimiser.param_groups[0]["lr"] == 1e-3


def test_policies_read_standardised_representations():
    policy, given = make(BC).policy, batch()
    mean, std = given.z.mean(0), given.z.std(0, correction=0)
    torch.testing.assert_close(policy(given.z), policy.from_standardised((given.z - mean) / std), atol=1e-3, rtol=1e-3)


def test_what_reads_rewards_finds_the_better_action_and_bc_the_common_one():
    """One state, two actions: the rarer one is paid. What learns values must lean to it, BC to their mean."""
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
def test_bf16_halves_the_digits_of_matrix_products_and_nothing_else(name):
    full, half = make(ALGORITHMS[name]), make(ALGORITHMS[name])
    for seed in range(4):
        exact = full.update(batch(seed))
        with torch.autocast("cpu", torch.bfloat16, cache_enabled=False):
            rough = half.update(batch(seed))
        assert {value.dtype for value in rough.values()} == {torch.float32}
        for key, value in exact.items():
            torch.testing.assert_close(rough[key], value, atol=0.03, rtol=0.05)
    assert any(not torch.equal(rough[key], exact[key]) for key in exact), "the products were rounded"
    assert {p.dtype for p in half.policy.parameters()} == {torch.float32}


def test_outputs_are_differences_of_full_precision_also_in_bf16():
    """Values of 256 and more, a bf16 number's digits, would else be even."""
    critic = TwinCritic(lambda: mlp(DIM + ACTIONS, 16, 1, last=ExactLinear))
    with torch.no_grad():
        critic.first[-1].bias.fill_(257.0)
        critic.first[-1].weight.zero_()
        with torch.autocast("cpu", torch.bfloat16):
            value, _ = critic(batch().z, batch().action)
    assert value.unique().tolist() == [257.0]

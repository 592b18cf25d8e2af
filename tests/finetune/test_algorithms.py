"""Updates are what the papers' formulas say, on networks small enough to write the formulas out."""

import copy
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F

from finetune.algorithms import ALGORITHMS, Loss, drqv2_bc, td3_bc
from finetune.algorithms.bc import BC
from finetune.algorithms.drqv2_bc import DrQv2BC
from finetune.algorithms.td3_bc import TD3BC
from finetune.features import FeatureBatch
from vd4rl_pomdp.nn.policy import Policy

DIM, ACTIONS, SIZE = 3, 2, 32


def make(kind: type, learning_rate: float = 1e-3, seed: int = 0) -> TD3BC:
    """An algorithm whose targets are far from its networks and whose features need to be standardised."""
    torch.manual_seed(seed)
    options = kind.options.fill({"gamma": 0.9, "alpha": 1.5})
    policy = Policy(DIM, ACTIONS, 16)
    policy.standardise.fit(batch().z)
    algorithm = kind(policy, options, learning_rate, torch.Generator().manual_seed(seed))
    if isinstance(algorithm, TD3BC):
        with torch.no_grad():
            for target in (algorithm.target_policy.net, algorithm.target_critic):
                for parameter in target.parameters():
                    parameter.add_(0.2 * torch.randn_like(parameter))
    return algorithm


def batch(seed: int = 0) -> FeatureBatch:
    """Transitions of which every other one ends its episode for good."""
    g = torch.Generator().manual_seed(seed)
    z, next_z = (5 + 3 * torch.randn(SIZE, DIM, generator=g) for _ in range(2))
    action = torch.rand(SIZE, ACTIONS, generator=g) * 2 - 1
    return FeatureBatch(z, action, torch.randn(SIZE, generator=g), torch.arange(SIZE) % 2 * 0.8, next_z)


@pytest.fixture
def silent(monkeypatch):
    """No noise on any action."""
    monkeypatch.setattr(td3_bc, "TARGET_NOISE", 0.0)
    monkeypatch.setattr(drqv2_bc, "NOISE_START", 0.0)
    monkeypatch.setattr(drqv2_bc, "NOISE_END", 0.0)


@pytest.mark.parametrize("kind", [TD3BC, DrQv2BC])
def test_critics_learn_the_reward_and_the_smaller_discounted_value_of_the_next_action(silent, kind):
    """y = r + gamma d min_i Q'_i(z', a'), a' by the target policy in TD3 and by the present one in DrQ-v2."""
    algorithm, given = make(kind), batch()
    acting = algorithm.target_policy if kind is TD3BC else algorithm.policy
    with torch.no_grad():
        standard, next_standard = algorithm.policy.standardise(given.z), algorithm.policy.standardise(given.next_z)
        following = torch.cat([next_standard, acting.from_standardised(next_standard)], -1)
        values = [q(following)[:, 0] for q in (algorithm.target_critic.first, algorithm.target_critic.second)]
        target = given.reward + 0.9 * given.discount * torch.stack(values).amin(0)
    before = [[p.clone() for p in q.parameters()] for q in (algorithm.critic.first, algorithm.critic.second)]
    both = torch.cat([standard, given.action], -1)
    errors = [F.mse_loss(q(both)[:, 0], target) for q in (algorithm.critic.first, algorithm.critic.second)]
    assert algorithm.update(given)["critic_loss"].item() == pytest.approx(sum(errors).item(), rel=1e-5)
    for old, q in zip(before, (algorithm.critic.first, algorithm.critic.second), strict=True):
        assert all((p != o).any() for o, p in zip(old, q.parameters(), strict=True)), "both critics learn"


@pytest.mark.parametrize(("kind", "clip"), [(TD3BC, 0.5), (DrQv2BC, 0.3)])
def test_noise_on_the_next_action_is_clipped_and_so_is_the_action(monkeypatch, kind, clip):
    monkeypatch.setattr(td3_bc, "TARGET_NOISE", 1e6)
    monkeypatch.setattr(drqv2_bc, "NOISE_START", 1e6)
    algorithm, given, seen = make(kind), batch(), []
    real = algorithm.target_critic.forward
    algorithm.target_critic.forward = lambda z, action: (seen.append(action), real(z, action))[1]
    acting = algorithm.target_policy if kind is TD3BC else algorithm.policy
    mean = acting(given.next_z).detach()
    algorithm.update(given)
    up, down = ((mean + side).clamp(-1, 1) for side in (clip, -clip))
    assert (torch.isclose(seen[0], up) | torch.isclose(seen[0], down)).all()
    assert not torch.isclose(seen[0], up).all()
    assert not torch.isclose(seen[0], down).all()


@pytest.mark.parametrize("kind", [TD3BC, DrQv2BC])
def test_the_actor_maximises_the_value_in_units_of_its_own_size_beside_cloning(silent, kind):
    """-lambda Q(z, pi(z)) + (pi(z) - a)^2, lambda = alpha / mean |Q| a number; TD3 takes Q_1, DrQ-v2 the smaller Q."""
    algorithm, given = make(kind, learning_rate=0.0), batch()
    for _ in range(algorithm.policy_delay):
        metrics = algorithm.update(given)
    found = [p.grad.clone() for p in algorithm.policy.net.parameters()]

    chosen = algorithm.policy(given.z)
    both = torch.cat([algorithm.policy.standardise(given.z), chosen], -1)
    values = torch.stack([algorithm.critic.first(both), algorithm.critic.second(both)])
    value = values[0] if kind is TD3BC else values.amin(0)
    loss = F.mse_loss(chosen, given.action) - 1.5 / value.abs().mean().item() * value.mean()
    assert metrics["actor_loss"].item() == pytest.approx(loss.item(), rel=1e-5)
    assert metrics["bc_loss"].item() == pytest.approx(F.mse_loss(chosen, given.action).item(), rel=1e-5)
    expected = torch.autograd.grad(loss, list(algorithm.policy.net.parameters()))
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize(("kind", "delay", "tau"), [(TD3BC, 2, 0.005), (DrQv2BC, 1, 0.01)])
def test_actor_and_targets_move_at_every_so_many_updates_and_targets_slowly(kind, delay, tau):
    algorithm = make(kind)
    pairs = [(algorithm.critic, algorithm.target_critic), (algorithm.policy.net, algorithm.target_policy.net)]
    for number in range(1, 5):
        actor = [p.clone() for p in algorithm.policy.net.parameters()]
        old = [[p.clone() for p in target.parameters()] for _, target in pairs]
        algorithm.update(batch(number))
        moved = [(a != b).any().item() for a, b in zip(actor, algorithm.policy.net.parameters(), strict=True)]
        assert moved == [number % delay == 0] * len(moved)
        for (online, target), before in zip(pairs, old, strict=True):
            for p, q, was in zip(online.parameters(), target.parameters(), before, strict=True):
                torch.testing.assert_close(q, was.lerp(p, tau) if number % delay == 0 else was)


def test_drqv2s_noise_decays_linearly_and_then_stays():
    algorithm = make(DrQv2BC)
    found = []
    for updates in (0, 125_000, 250_000, 10**6):
        algorithm.updates = updates
        found.append(algorithm.noise)
    assert found == pytest.approx([1.0, 0.55, 0.1, 0.1])


def test_cloning_is_the_squared_error_of_the_policys_action():
    algorithm, given = make(BC), batch()
    expected = F.mse_loss(algorithm.policy(given.z), given.action).item()
    assert algorithm.update(given)["bc_loss"].item() == pytest.approx(expected)
    assert algorithm.update(given)["bc_loss"].item() < expected


@pytest.mark.parametrize("name", ALGORITHMS)
def test_an_algorithm_that_goes_on_elsewhere_takes_the_same_steps(name):
    one, other = (make(ALGORITHMS[name], seed=seed) for seed in (0, 1))
    for number in range(3):
        one.update(batch(number))
    other.load_state_dict(copy.deepcopy(one.state_dict()))
    if name != "bc":
        other.generator.set_state(one.generator.get_state())
    for number in range(3, 6):
        here, there = one.update(batch(number)), other.update(batch(number))
        assert {k: v.item() for k, v in here.items()} == {k: v.item() for k, v in there.items()}


def test_policies_read_standardised_representations():
    policy, given = make(BC).policy, batch()
    mean, std = given.z.mean(0), given.z.std(0, correction=0)
    torch.testing.assert_close(policy(given.z), policy.from_standardised((given.z - mean) / std), atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize("kind", [BC, TD3BC, DrQv2BC])
def test_an_encoder_is_trained_by_the_first_loss_and_by_no_other(kind):
    """V-D4RL's references train the encoder by the critic's loss (bc: by cloning); the actor's gradient stops at z."""
    torch.manual_seed(0)
    encoder, given = torch.nn.Linear(DIM, DIM), batch()
    optimiser = torch.optim.SGD(encoder.parameters(), lr=1.0)
    algorithm, twin = (make(kind, learning_rate=0.0) for _ in range(2))
    alone = next(twin.losses(replace(given, z=encoder(given.z)))).value
    expected = torch.autograd.grad(alone, list(encoder.parameters()))
    before = [p.clone() for p in encoder.parameters()]
    for number in range(2):  # the second update of TD3+BC trains the actor, too
        moved = encoder.weight.clone()
        algorithm.update(replace(given, z=encoder(given.z)), optimiser)
        assert not torch.equal(encoder.weight, moved)
        if number == 0:
            for old, now, grad in zip(before, encoder.parameters(), expected, strict=True):
                torch.testing.assert_close(now, old - grad)


def test_an_update_steps_along_each_loss_before_the_next_is_computed():
    """What an algorithm of one's own may count on."""
    weight = torch.nn.Parameter(torch.zeros(()))
    steps = torch.optim.SGD([weight], lr=1.0)
    seen = []

    class Twice(BC):
        def losses(self, batch):
            for _ in range(2):
                seen.append(weight.item())
                yield Loss(weight * 1.0, steps, {f"loss{len(seen)}": weight.detach().clone()})

    algorithm = make(Twice)
    assert [v.item() for v in algorithm.update(batch()).values()] == [0.0, -1.0]
    assert seen == [0.0, -1.0]

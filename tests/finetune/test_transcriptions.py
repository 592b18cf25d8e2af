"""Twenty updates reproduce the weights of the authors' update rules, transcribed here in float64."""

import copy
import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from finetune.algorithms import ALGORITHMS, Algorithm
from finetune.algorithms.fql import FQL
from finetune.algorithms.td3_bc import TD3BC
from finetune.config import FinetuneConfig
from finetune.end_to_end import EndToEnd
from finetune.features import FeatureBatch
from vd4rl_pomdp.core.streams import RandomStream
from vd4rl_pomdp.core.types import Transitions
from vd4rl_pomdp.nn.policy import Policy

DIM, ACTIONS, SIZE, UPDATES, PIXELS = 3, 2, 64, 20, 12
BEGUN = {"drqv2_bc": 124_990, "bc": 124_990, "td3_bc": 0, "rebrac": 0, "iql": 275_000, "fql": 0}
"""Initial update count, so that V-D4RL's noise schedule reaches its minimum at the tenth update here, and IQL's cosine
falls fastest."""


@pytest.fixture(autouse=True)
def _in_float64(monkeypatch):
    torch.set_default_dtype(torch.float64)
    monkeypatch.setattr(Tensor, "float", Tensor.double)
    yield
    torch.set_default_dtype(torch.float32)


def batch(number: int) -> FeatureBatch:
    g = torch.Generator().manual_seed(number)
    z, next_z = (torch.randn(SIZE, DIM, generator=g) for _ in range(2))
    action = torch.rand(SIZE, ACTIONS, generator=g) * 2 - 1
    reward, discount = torch.randn(SIZE, generator=g), torch.rand(SIZE, generator=g)
    return FeatureBatch(z, action, reward, discount, next_z, torch.rand(SIZE, ACTIONS, generator=g) * 2 - 1)


def started(name: str) -> TD3BC:
    """An algorithm whose policy chooses many actions near the bounds, so clipping matters."""
    torch.manual_seed(0)
    policy = Policy(DIM, ACTIONS, 16)
    with torch.no_grad():
        policy.net[-1].weight.mul_(30)
    settings = {"gamma": 0.9, "alpha": 1.5, "actor_bc": 0.3, "critic_bc": 0.7, "distillation": 2.0}
    settings |= {"temperature": 8.0}
    options = ALGORITHMS[name].options.fill(settings)
    algorithm = ALGORITHMS[name](policy, options, 1e-3, 550_000, RandomStream(torch.Generator().manual_seed(7)))
    algorithm.updates = BEGUN[name]
    return algorithm


class Nets:
    """Copies of an algorithm's networks, each with plain Adam, and the same stream of noise."""

    def __init__(self, algorithm: TD3BC) -> None:
        self.actor = copy.deepcopy(algorithm.policy.net)
        self.actor_steps = torch.optim.Adam(self.actor.parameters(), lr=1e-3)
        self.noise = torch.Generator().manual_seed(7)
        if isinstance(algorithm, TD3BC):
            self.critics = nn.ModuleList(
                [copy.deepcopy(algorithm.critic.first), copy.deepcopy(algorithm.critic.second)]
            )
            self.critic_steps = torch.optim.Adam(self.critics.parameters(), lr=1e-3)
            self.target_critics, self.target_actor = copy.deepcopy(self.critics), copy.deepcopy(self.actor)

    def normal(self) -> Tensor:
        return torch.randn(SIZE, ACTIONS, generator=self.noise)

    def learn_values(self, b: FeatureBatch, next_action: Tensor, penalty: Tensor | float = 0.0) -> None:
        with torch.no_grad():
            following = torch.cat([b.next_z, next_action], 1)
            q1, q2 = (q(following)[:, 0] for q in self.target_critics)
            target = b.reward + 0.9 * b.discount * (torch.min(q1, q2) - penalty)
        values = [q(torch.cat([b.z, b.action], 1))[:, 0] for q in self.critics]
        loss = sum(((q - target) ** 2).mean() for q in values)
        self.critic_steps.zero_grad()
        loss.backward()
        self.critic_steps.step()

    def improve(self, loss: Tensor) -> None:
        self.actor_steps.zero_grad()
        loss.backward()
        self.actor_steps.step()


def follow(target: nn.Module, online: nn.Module, tau: float) -> None:
    for p, q in zip(online.parameters(), target.parameters(), strict=True):
        q.data.copy_(tau * p.data + (1 - tau) * q.data)


def truncated(mean: Tensor, std: float, noise: Tensor) -> Tensor:
    """A sample of V-D4RL's truncated normal: the value is clipped, the gradient is not."""
    x = mean + torch.clamp(noise * std, -0.3, 0.3)
    cut = torch.clamp(x, -1.0 + 1e-6, 1.0 - 1e-6)
    return x - x.detach() + cut.detach()


def scheduled(step: int) -> float:
    mix = min(max(2 * step / 250_000, 0.0), 1.0)  # an update in every second step
    return (1.0 - mix) * 1.0 + mix * 0.1


def drqv2_bc(nets: Nets, b: FeatureBatch, step: int) -> None:
    std = scheduled(step)
    with torch.no_grad():
        next_action = truncated(torch.tanh(nets.actor(b.next_z)), std, nets.normal())
    nets.learn_values(b, next_action)
    z = b.z.detach()  # of the encoder before this update's step
    action = truncated(torch.tanh(nets.actor(z)), std, nets.normal())
    q1, q2 = (q(torch.cat([z, action], 1))[:, 0] for q in nets.critics)
    q = torch.min(q1, q2)
    nets.improve(-q.mean() * 1.5 / q.detach().abs().mean() + ((action - b.action) ** 2).mean())
    follow(nets.target_critics, nets.critics, 0.01)


def bc(nets: Nets, b: FeatureBatch, step: int) -> None:
    action = truncated(torch.tanh(nets.actor(b.z)), scheduled(step), nets.normal())
    nets.improve(((action - b.action) ** 2).mean())


def td3_bc(nets: Nets, b: FeatureBatch, step: int) -> None:
    with torch.no_grad():
        noise = (nets.normal() * 0.2).clamp(-0.5, 0.5)
        next_action = (torch.tanh(nets.target_actor(b.next_z)) + noise).clamp(-1, 1)
    nets.learn_values(b, next_action)
    if (step + 1) % 2:
        return
    action = torch.tanh(nets.actor(b.z))
    q = nets.critics[0](torch.cat([b.z, action], 1))
    nets.improve(-1.5 / q.abs().mean().detach() * q.mean() + ((action - b.action) ** 2).mean())
    follow(nets.target_critics, nets.critics, 0.005)
    follow(nets.target_actor, nets.actor, 0.005)


def rebrac(nets: Nets, b: FeatureBatch, step: int) -> None:
    with torch.no_grad():
        noise = (nets.normal() * 0.2).clamp(-0.5, 0.5)
        next_action = (torch.tanh(nets.target_actor(b.next_z)) + noise).clamp(-1, 1)
    nets.learn_values(b, next_action, 0.7 * ((next_action - b.next_action) ** 2).sum(1))
    if (step + 1) % 2:
        return
    action = torch.tanh(nets.actor(b.z))
    q = nets.critics[0](torch.cat([b.z, action], 1))
    nets.improve(-q.mean() / q.abs().mean().detach() + 0.3 * ((action - b.action) ** 2).mean())
    follow(nets.target_critics, nets.critics, 0.005)
    follow(nets.target_actor, nets.actor, 0.005)


@pytest.mark.parametrize("theirs", [drqv2_bc, bc, td3_bc, rebrac])
def test_updates_reproduce_the_authors_weights(theirs: Callable):
    name = theirs.__name__
    algorithm = started(name)
    nets = Nets(algorithm)
    near = torch.tanh(nets.actor(batch(0).z)).abs() > 0.7  # where the noise may reach beyond a bound
    assert 0.2 < near.double().mean() < 0.9, "many actions are near a bound, and not all"
    for number in range(UPDATES):
        algorithm.update(batch(number))
        theirs(nets, batch(number), BEGUN[name] + number)
    check_equal_weights(algorithm, nets)


def check_equal_weights(algorithm: Algorithm, nets: Nets) -> None:
    pairs = [(algorithm.policy.net, nets.actor)]
    if isinstance(algorithm, TD3BC):
        pairs += [(algorithm.critic.first, nets.critics[0]), (algorithm.target_critic.second, nets.target_critics[1])]
    for mine, their in pairs:
        check_equal(mine, their)


def check_equal(mine: nn.Module, their: nn.Module) -> None:
    for p, q in zip(mine.parameters(), their.parameters(), strict=True):
        torch.testing.assert_close(p, q, atol=1e-12, rtol=1e-12)


@pytest.mark.parametrize("outside", [-9.0, 9.0])
def test_iql_updates_reproduce_the_authors_weights(outside: float):
    """Equations 5 to 7 of the paper, in the authors' cycle begun at the critics; one log std is beyond its bounds."""
    algorithm = started("iql")
    with torch.no_grad():
        algorithm.gaussian.log_std.copy_(torch.tensor([outside, 0.3]))
        for p in algorithm.target_critic.parameters():
            p.add_(0.5 * torch.randn_like(p))
    ours = [algorithm.policy.net, algorithm.value, algorithm.critic, algorithm.target_critic]
    theirs = actor, value, critic, target_critic = [copy.deepcopy(module) for module in ours]
    spread = algorithm.gaussian.log_std.detach().clone().requires_grad_()
    critic_steps, value_steps = (torch.optim.Adam(net.parameters(), lr=1e-3) for net in (critic, value))
    actor_steps = torch.optim.Adam([*actor.parameters(), spread])

    def descend(steps: torch.optim.Adam, loss: Tensor) -> None:
        steps.zero_grad()
        loss.backward()
        steps.step()

    weights = []
    for number in range(UPDATES):
        b = batch(number)
        algorithm.update(b)
        both = torch.cat([b.z, b.action], 1)
        target = (b.reward + 0.9 * b.discount * value(b.next_z)[:, 0]).detach()
        descend(critic_steps, sum(((q(both)[:, 0] - target) ** 2).mean() for q in critic.children()))
        follow(target_critic, critic, 0.005)
        q = torch.min(*(q(both)[:, 0] for q in target_critic.children())).detach()
        error = q - value(b.z)[:, 0]
        descend(value_steps, (torch.where(error > 0, 0.7, 0.3) * error**2).mean())
        weights.append((8.0 * (q - value(b.z)[:, 0])).exp().clamp(max=100.0).detach())
        log_std = spread.clamp(-5.0, 2.0)
        distance = (b.action - torch.tanh(actor(b.z))) / log_std.exp()
        log_density = -(distance**2 / 2 + log_std + math.log(2 * math.pi) / 2).sum(1)
        actor_steps.param_groups[0]["lr"] = 1e-3 * (1 + math.cos(math.pi * (275_000 + number) / 550_000)) / 2
        descend(actor_steps, -(weights[-1] * log_density).mean())
    assert 0 < (torch.stack(weights) == 100.0).double().mean() < 0.9, "some weights are clipped"
    for mine, their in zip(ours, theirs, strict=True):
        check_equal(mine, their)
    torch.testing.assert_close(algorithm.gaussian.log_std, spread, atol=1e-12, rtol=1e-12)


def gelu(x: Tensor) -> Tensor:
    return 0.5 * x * (1 + torch.tanh((2 / torch.pi) ** 0.5 * (x + 0.044715 * x**3)))


def layered(weights: list[Tensor], x: Tensor, last: Callable, norm: bool = False) -> Tensor:
    """An MLP with GELU; `norm` adds layer normalisation after each hidden layer."""
    while len(weights) > 2:
        weight, bias, *weights = weights
        x = gelu(x @ weight.T + bias)
        if norm:
            scale, shift, *weights = weights
            x = (x - x.mean(1, keepdim=True)) / (x.var(1, correction=0, keepdim=True) + 1e-6).sqrt() * scale + shift
    return last(x @ weights[0].T + weights[1])


class FlowNets:
    """Copies of FQL's weights and its networks, whose input is the concatenation of state, action and time."""

    def __init__(self, algorithm: FQL) -> None:
        def copies(module: nn.Module) -> list[Tensor]:
            return [p.detach().clone().requires_grad_() for p in module.parameters()]

        self.policy, self.flow = copies(algorithm.policy.net), copies(algorithm.flow)
        self.noise, self.critics = copies(algorithm.noise_in), [copies(q) for q in algorithm.critic.children()]
        self.targets = [[p.detach() for p in copies(q)] for q in algorithm.target_critic.children()]
        self.actors = [*self.policy, *self.noise, *self.flow]
        self.adam = torch.optim.Adam([*self.actors, *self.critics[0], *self.critics[1]], lr=1e-3)

    def mu(self, z: Tensor, noise: Tensor) -> Tensor:
        w0, b0, w1, b1, w2, b2 = self.policy
        hidden = torch.relu(torch.cat([z, noise], 1) @ torch.cat([w0, self.noise[0]], 1).T + b0)
        return torch.tanh(torch.relu(hidden @ w1.T + b1) @ w2.T + b2)

    def velocity(self, z: Tensor, x: Tensor, t: Tensor) -> Tensor:
        state, bias, moving, *deeper = self.flow
        return layered([torch.cat([state, moving], 1), bias, *deeper], torch.cat([z, x, t], 1), lambda x: x)

    def value(self, critics: list[list[Tensor]], z: Tensor, action: Tensor) -> Tensor:
        both = [layered(q, torch.cat([z, action], 1), lambda x: x[:, 0], norm=True) for q in critics]
        return torch.stack(both)

    def update(self, b: FeatureBatch, next_noise: Tensor, x0: Tensor, noise: Tensor, t: Tensor) -> None:
        with torch.no_grad():
            next_value = self.value(self.targets, b.next_z, self.mu(b.next_z, next_noise)).mean(0)
            target = b.reward + 0.9 * b.discount * next_value
            cloned = noise
            for step in range(10):
                cloned = cloned + 0.1 * self.velocity(b.z, cloned, torch.full((SIZE, 1), 0.1 * step))
            cloned = cloned.clamp(-1, 1)
        bellman = ((self.value(self.critics, b.z, b.action) - target) ** 2).mean()
        flow = ((self.velocity(b.z, (1 - t) * x0 + t * b.action, t) - (b.action - x0)) ** 2).mean()
        action = self.mu(b.z, noise)
        q = self.value(self.critics, b.z, action).mean(0)
        policy = 2.0 * ((action - cloned) ** 2).mean() - q.mean() / q.abs().mean().detach()
        for parameters, loss in (([*self.critics[0], *self.critics[1]], bellman), (self.actors, flow + policy)):
            for p, gradient in zip(parameters, torch.autograd.grad(loss, parameters, retain_graph=True), strict=True):
                p.grad = gradient
        self.adam.step()
        for target_critic, critic in zip(self.targets, self.critics, strict=True):
            for p, q in zip(target_critic, critic, strict=True):
                p.copy_(0.005 * q.detach() + 0.995 * p)


def test_fql_updates_reproduce_the_authors_weights():
    """One step on a joint loss; each network receives only the gradient of its own loss (Park et al., algorithm 1)."""
    algorithm = started("fql")
    nets, drawn = FlowNets(algorithm), torch.Generator().manual_seed(7)
    for number in range(UPDATES):
        algorithm.update(batch(number))
        noises = [torch.randn(SIZE, ACTIONS, generator=drawn) for _ in range(3)]
        nets.update(batch(number), *noises, torch.rand(SIZE, 1, generator=drawn))
    ours = [algorithm.policy.net, algorithm.noise_in, algorithm.flow]
    ours += [*algorithm.critic.children(), *algorithm.target_critic.children()]
    theirs = [nets.policy, nets.noise, nets.flow, *nets.critics, *nets.targets]
    for module, weights in zip(ours, theirs, strict=True):
        for p, q in zip(module.parameters(), weights, strict=True):
            torch.testing.assert_close(p, q, atol=1e-12, rtol=1e-12)


class Eye(nn.Module):
    """The frame encoder of a memoryless end-to-end method."""

    def __init__(self) -> None:
        super().__init__()
        self.frame = nn.Sequential(nn.Linear(PIXELS, DIM), nn.LayerNorm(DIM), nn.Tanh())


def transitions(number: int) -> Transitions:
    g, b = torch.Generator().manual_seed(100 + number), batch(number)
    obs, next_obs = (torch.randn(SIZE, PIXELS, generator=g) for _ in range(2))
    keys = torch.zeros(SIZE, dtype=torch.int64)
    return Transitions(obs, b.action, b.reward, b.discount, next_obs, keys, keys, b.next_action)


@pytest.mark.parametrize("theirs", [drqv2_bc, bc])
def test_end_to_end_updates_reproduce_the_authors_encoder(theirs: Callable):
    """V-D4RL updates its encoder on the critics' loss (bc on its only loss), before the actor's step."""
    name = theirs.__name__
    algorithm, encoder = started(name), Eye()
    nets, eye = Nets(algorithm), copy.deepcopy(encoder.frame)
    (nets.actor_steps if name == "bc" else nets.critic_steps).add_param_group({"params": eye.parameters()})
    mine = EndToEnd(algorithm, encoder, FinetuneConfig(learning_rate=1e-3, precision="fp32"))
    for number in range(UPDATES):
        t = transitions(number)
        mine.update(t)
        features = FeatureBatch(eye(t.obs), t.action, t.reward, t.discount, eye(t.next_obs).detach(), t.next_action)
        theirs(nets, features, BEGUN[name] + number)
    check_equal_weights(algorithm, nets)
    check_equal(encoder.frame, eye)

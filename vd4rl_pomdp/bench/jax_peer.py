"""TD3+BC in JAX with the networks, batches and options of `finetune.algorithms.TD3BC`, for comparison.

Compiled as a whole, many updates per call (`lax.scan`), as in fast JAX code (JAX-CORL, github.com/nissymori/JAX-CORL).
JAX comes with the extra `policy`, so this module is imported only where needed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array
from torch import Tensor, nn

from finetune.algorithms.td3_bc import NOISE_CLIP, TARGET_NOISE, TD3BC

Net = list[tuple[Array, Array]]
"""Weights (inputs, outputs) and biases of the layers of an MLP."""


class Learnt(NamedTuple):
    """Everything that an update changes."""

    policy: Net
    critics: tuple[Net, Net]
    target_policy: Net
    target_critics: tuple[Net, Net]
    policy_adam: optax.OptState
    critic_adam: optax.OptState


class Table(NamedTuple):
    """The data: M transitions, and N features in V views."""

    features: Array
    """(V, N, D)."""
    first: Array
    """(V, M): feature index of each transition's start."""
    last: Array
    """(V, M): feature index of each transition's end."""
    action: Array
    """(M, A)."""
    reward: Array
    """(M,)."""
    discount: Array
    """(M,)."""
    mean: Array
    """(D,): mean of the features."""
    std: Array
    """(D,): standard deviation of the features."""


class BatchDraws(NamedTuple):
    """Random numbers of U updates."""

    transition: Array
    """(U, B): transition indices."""
    view: Array
    """(U, B): view indices."""
    noise: Array
    """(U, B, A), standard normal: target policy smoothing noise."""


def learnt_by(algorithm: TD3BC) -> Learnt:
    """The initial weights of an algorithm."""
    policy, target_policy = net(algorithm.policy.net), net(algorithm.target_policy.net)
    critics, targets = ((net(twin.first), net(twin.second)) for twin in (algorithm.critic, algorithm.target_critic))
    adam = optax.adam(algorithm.learning_rate)
    return Learnt(policy, critics, target_policy, targets, adam.init(policy), adam.init(critics))


def net(module: nn.Sequential) -> Net:
    """A copy of the layers of an MLP."""
    return [(as_jax(layer.weight).T, as_jax(layer.bias)) for layer in module if isinstance(layer, nn.Linear)]


def as_jax(tensor: Tensor) -> Array:
    """A copy of a tensor on JAX's device."""
    return jnp.array(tensor.detach().cpu().numpy())


def draw(key: Array, table: Table, updates: int, batch_size: int) -> BatchDraws:
    """Draw the random numbers of many updates at once."""
    index, view, noise = jax.random.split(key, 3)
    shape = updates, batch_size
    return BatchDraws(
        jax.random.randint(index, shape, 0, len(table.action)),
        jax.random.randint(view, shape, 0, len(table.features)),
        jax.random.normal(noise, (*shape, table.action.shape[-1])),
    )


def make_updates(algorithm: TD3BC) -> Callable[[Learnt, Table, BatchDraws], tuple[Learnt, dict[str, Array]]]:
    """A function, not compiled yet, that makes U updates with an algorithm's options.

    U is even: actor and targets are updated in every second update. The function returns the new parameters and the
    losses: `critic_loss` (U / 2, 2) and `actor_loss` (U / 2,).
    """
    gamma, alpha, tau = algorithm.settings.gamma, algorithm.settings.alpha, algorithm.tau
    optimiser = optax.adam(algorithm.learning_rate)

    def critic_loss(critics: tuple[Net, Net], learnt: Learnt, table: Table, draws: BatchDraws) -> Array:
        z, action, next_z = batch(table, draws)
        noise = jnp.clip(draws.noise * TARGET_NOISE, -NOISE_CLIP, NOISE_CLIP)
        next_action = jnp.clip(jnp.tanh(forward(learnt.target_policy, next_z)) + noise, -1, 1)
        value = jnp.minimum(*values(learnt.target_critics, next_z, next_action))
        target = table.reward[draws.transition] + gamma * table.discount[draws.transition] * value
        return sum(((q - target) ** 2).mean() for q in values(critics, z, action))

    def actor_loss(policy: Net, learnt: Learnt, table: Table, draws: BatchDraws) -> Array:
        z, action, _ = batch(table, draws)
        chosen = jnp.tanh(forward(policy, z))
        value = forward(learnt.critics[0], jnp.concatenate([z, chosen], -1))[:, 0]
        weight = alpha / jax.lax.stop_gradient(jnp.abs(value).mean())
        return ((chosen - action) ** 2).mean() - weight * value.mean()

    def pair(learnt: Learnt, table: Table, draws: BatchDraws) -> tuple[Learnt, dict[str, Array]]:
        losses = []
        for turn in range(2):
            drawn = BatchDraws(*(numbers[turn] for numbers in draws))
            loss, gradient = jax.value_and_grad(critic_loss)(learnt.critics, learnt, table, drawn)
            step, adam = optimiser.update(gradient, learnt.critic_adam)
            learnt = learnt._replace(critics=optax.apply_updates(learnt.critics, step), critic_adam=adam)
            losses.append(loss)
        loss, gradient = jax.value_and_grad(actor_loss)(learnt.policy, learnt, table, drawn)
        step, adam = optimiser.update(gradient, learnt.policy_adam)
        policy = optax.apply_updates(learnt.policy, step)
        learnt = learnt._replace(policy=policy, policy_adam=adam)
        moved = [
            jax.tree.map(lambda old, new: old + tau * (new - old), *both)
            for both in ((learnt.target_policy, policy), (learnt.target_critics, learnt.critics))
        ]
        learnt = learnt._replace(target_policy=moved[0], target_critics=moved[1])
        return learnt, {"critic_loss": jnp.stack(losses), "actor_loss": loss}

    def updates(learnt: Learnt, table: Table, draws: BatchDraws) -> tuple[Learnt, dict[str, Array]]:
        pairs = jax.tree.map(lambda numbers: numbers.reshape(-1, 2, *numbers.shape[1:]), draws)
        return jax.lax.scan(lambda learnt, drawn: pair(learnt, table, drawn), learnt, pairs)

    return updates


def batch(table: Table, draws: BatchDraws) -> tuple[Array, Array, Array]:
    """Standardised representations (B, D) at the start, actions (B, A), representations at the end."""
    ends = (table.features[draws.view, end[draws.view, draws.transition]] for end in (table.first, table.last))
    z, next_z = ((feature.astype(jnp.float32) - table.mean) / table.std for feature in ends)
    return z, table.action[draws.transition], next_z


def forward(layers: Net, x: Array) -> Array:
    """Outputs of an MLP."""
    for weight, bias in layers[:-1]:
        x = jax.nn.relu(x @ weight + bias)
    weight, bias = layers[-1]
    return x @ weight + bias


def values(critics: tuple[Net, Net], z: Array, action: Array) -> tuple[Array, Array]:
    """Values of both critics, (B,) each."""
    both = jnp.concatenate([z, action], -1)
    return forward(critics[0], both)[:, 0], forward(critics[1], both)[:, 0]

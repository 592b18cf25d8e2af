"""What every fine-tuning algorithm must satisfy, run over ALGORITHMS."""

import copy
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any

import pytest
import torch
from torch import Tensor

from finetune.algorithms import ALGORITHMS, Algorithm, Loss
from finetune.features import FeatureBatch
from vd4rl_pomdp.nn.policy import Policy

DIM, ACTIONS, SIZE = 3, 2, 32
UPDATES = 4
"""More than any algorithm needs to step along each of its losses twice."""


def batch(number: int = 0) -> FeatureBatch:
    """Transitions of which every other one ends its episode for good."""
    g = torch.Generator().manual_seed(number)
    z, next_z = (5 + 3 * torch.randn(SIZE, DIM, generator=g) for _ in range(2))
    action = torch.rand(SIZE, ACTIONS, generator=g) * 2 - 1
    return FeatureBatch(z, action, torch.randn(SIZE, generator=g), torch.arange(SIZE) % 2 * 0.8, next_z)


def make(name: str, seed: int = 0) -> Algorithm:
    torch.manual_seed(seed)
    policy = Policy(DIM, ACTIONS, 16)
    policy.standardise.fit(batch().z)
    kind = ALGORITHMS[name]
    return kind(policy, kind.options(), 1e-3, 40, torch.Generator().manual_seed(seed))


def tensors(state: Any, path: str = "") -> dict[str, Tensor]:
    """Copies of all tensors of a nested state, by path."""
    if isinstance(state, Tensor):
        return {path: state.detach().clone()}
    items = state.items() if isinstance(state, dict) else enumerate(state) if isinstance(state, list | tuple) else ()
    return {k: v for key, value in items for k, v in tensors(value, f"{path}/{key}").items()}


def networks(algorithm: Algorithm) -> dict[str, Tensor]:
    """Copies of all parameters and buffers, by part and name."""
    return tensors({n: p.state_dict() for n, p in algorithm.parts().items() if isinstance(p, torch.nn.Module)})


def optimised(optimiser: torch.optim.Optimizer) -> list[Tensor]:
    return [p for group in optimiser.param_groups for p in group["params"]]


@dataclass
class Step:
    """One loss of an update, and the networks before and after the step along it."""

    loss: Loss
    reached: list[Tensor | None]
    """Gradients of the loss: of its optimiser's parameters, then of the representations."""
    before: dict[str, Tensor]
    after: dict[str, Tensor]


def watched(algorithm: Algorithm, given: FeatureBatch) -> list[Step]:
    """Make an update and tell its steps."""
    z = given.z.requires_grad_()
    steps, losses = [], algorithm.losses

    def watching(features: FeatureBatch) -> Iterator[Loss]:
        for loss in losses(features):
            asked = [*optimised(loss.optimiser), z]
            reached = torch.autograd.grad(loss.value, asked, retain_graph=True, allow_unused=True)
            before = networks(algorithm)
            yield loss
            steps.append(Step(loss, list(reached), before, networks(algorithm)))

    algorithm.losses = watching
    algorithm.update(given)
    del algorithm.losses
    return steps


def moved(before: dict[str, Tensor], after: dict[str, Tensor]) -> set[str]:
    return {name for name in before if not torch.equal(before[name], after[name])}


def names_of(algorithm: Algorithm, optimiser: torch.optim.Optimizer) -> set[str]:
    """Names, in `networks`, of the parameters that an optimiser steps."""
    mine = {id(p) for p in optimised(optimiser)}
    modules = {n: p for n, p in algorithm.parts().items() if isinstance(p, torch.nn.Module)}
    return {f"/{part}/{name}" for part, m in modules.items() for name, p in m.named_parameters() if id(p) in mine}


@pytest.mark.parametrize("name", ALGORITHMS)
def test_losses_are_finite_scalars_and_logs_are_detached_ones(name):
    algorithm = make(name)
    for number in range(UPDATES):
        steps = watched(algorithm, batch(number))
        assert steps
        logged = [key for step in steps for key in step.loss.logs]
        assert len(logged) == len(set(logged)) > 0, "no loss overwrites another's numbers"
        for step in steps:
            assert step.loss.value.shape == ()
            assert step.loss.value.isfinite()
            for value in step.loss.logs.values():
                assert (value.shape, value.requires_grad, value.grad_fn) == ((), False, None)
                assert value.isfinite()


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_loss_reaches_all_that_its_optimiser_steps_and_the_step_moves_nothing_else(name):
    algorithm = make(name)
    policy_moved: set[str] = set()
    for number in range(UPDATES):
        for step in watched(algorithm, batch(number)):
            mine = names_of(algorithm, step.loss.optimiser)
            assert len(mine) == len(optimised(step.loss.optimiser)), "all it steps belongs to a part, and is saved"
            assert all(grad is not None and grad.any() for grad in step.reached[:-1])
            changed = moved(step.before, step.after)
            assert changed == mine
            policy_moved |= {key for key in changed if key.startswith("/policy/")}
    assert policy_moved == {f"/policy/net.{key}" for key in algorithm.policy.net.state_dict()}


@pytest.mark.parametrize("name", ALGORITHMS)
def test_the_first_loss_alone_reaches_the_representations(name):
    """It is the one that trains an encoder, where there is no frozen stage."""
    algorithm = make(name)
    for number in range(UPDATES):
        first, *others = watched(algorithm, batch(number))
        assert first.reached[-1].any()
        assert all(step.reached[-1] is None for step in others)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_targets_creep_behind_their_networks_and_nothing_else_moves_by_itself(name):
    algorithm = make(name)
    with torch.no_grad():
        for part, module in algorithm.parts().items():
            if part.startswith("target_"):
                for parameter in module.parameters():
                    parameter.add_(0.5)
    crept = set()
    for number in range(UPDATES):
        before = networks(algorithm)
        steps = watched(algorithm, batch(number))
        after = networks(algorithm)
        stepped = {key for step in steps for key in moved(step.before, step.after)}
        by_itself = moved(before, after) - stepped
        assert all(key.startswith("/target_") for key in by_itself)
        for key in by_itself:
            online = after["/" + key.removeprefix("/target_")]
            torch.testing.assert_close(after[key], before[key].lerp(online, algorithm.tau))
        crept |= by_itself
    targets = {n for n in algorithm.parts() if n.startswith("target_")}
    assert {key.split("/")[1] for key in crept} == targets


@pytest.mark.parametrize("name", ALGORITHMS)
def test_an_algorithm_that_goes_on_elsewhere_takes_the_same_steps(name):
    one, other = (make(name, seed=seed) for seed in (0, 1))
    for number in range(3):
        one.update(batch(number))
    other.load_state_dict(copy.deepcopy(one.state_dict()))
    for number in range(3, 3 + UPDATES):
        here, there = one.update(batch(number)), other.update(batch(number))
        assert {k: v.item() for k, v in here.items()} == {k: v.item() for k, v in there.items()}
    here, there = tensors(one.state_dict()), tensors(other.state_dict())
    assert here.keys() == there.keys()
    assert all(torch.equal(here[key], there[key]) for key in here)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_updates_draw_from_the_generator_alone(name):
    one, other = make(name), make(name)
    for number in range(UPDATES):
        torch.manual_seed(number)
        here = one.update(batch(number))
        torch.manual_seed(1000 + number)
        there = other.update(batch(number))
        assert {k: v.item() for k, v in here.items()} == {k: v.item() for k, v in there.items()}


@pytest.mark.parametrize("name", ALGORITHMS)
def test_actions_of_the_policy_lie_within_their_bounds(name):
    algorithm = make(name)
    for number in range(UPDATES):
        algorithm.update(batch(number))
    action = algorithm.policy(1e3 * torch.randn(100, DIM))
    assert action.shape == (100, ACTIONS)
    assert action.abs().max() <= 1


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_batch_is_left_as_it_was(name):
    given = batch()
    make(name).update(given)
    for field in fields(FeatureBatch):
        assert torch.equal(getattr(given, field.name), getattr(batch(), field.name))

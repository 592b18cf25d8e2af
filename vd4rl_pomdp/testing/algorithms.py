"""What every fine-tuning algorithm must satisfy: its losses, what they move, its targets, state and draws."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.runs.checkpoint import pack, unpack
from vd4rl_pomdp.testing.contract import Check, claim, claim_close, run_checks, shown

if TYPE_CHECKING:
    from finetune.algorithms import Algorithm, Loss
    from finetune.features import FeatureBatch

DIM, ACTIONS, SIZE = 3, 2, 32
UPDATES = 4
"""Enough for an algorithm to step along each of its losses twice."""
_TARGET = "/target_"


def check_algorithm(name: str, **options: Any) -> None:
    """Check every promise of a fine-tuning algorithm.

    Args:
        name: of the algorithm in `finetune.algorithms.ALGORITHMS`.
        options: its options.

    Raises:
        AssertionError: a promise is broken; says which one, and by what.
        UserError: there is no such algorithm or option.
    """
    run_checks("algorithm", CHECKS, name, **options)


def batch(number: int = 0) -> FeatureBatch:
    """Transitions of which every other one ends its episode for good."""
    from finetune.features import FeatureBatch

    g = torch.Generator().manual_seed(number)
    z, next_z = (5 + 3 * torch.randn(SIZE, DIM, generator=g) for _ in range(2))
    action = torch.rand(SIZE, ACTIONS, generator=g) * 2 - 1
    return FeatureBatch(z, action, torch.randn(SIZE, generator=g), torch.arange(SIZE) % 2 * 0.8, next_z)


def make(name: str, seed: int = 0, **options: Any) -> Algorithm:
    """An algorithm with a small policy, the same for every seed."""
    from finetune.algorithms import ALGORITHMS
    from finetune.config import FinetuneConfig

    chosen = FinetuneConfig.of("smoke", algorithm=name, **options).options
    torch.manual_seed(seed)
    policy = Policy(DIM, ACTIONS, 16)
    policy.standardise.fit(batch().z)
    return ALGORITHMS.named(name)(policy, chosen, 1e-3, 40, torch.Generator().manual_seed(seed))


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
            asked = [*_optimised(loss.optimiser), z]
            reached = torch.autograd.grad(loss.value, asked, retain_graph=True, allow_unused=True)
            before = _networks(algorithm)
            yield loss
            steps.append(Step(loss, list(reached), before, _networks(algorithm)))

    algorithm.losses = watching  # type: ignore[method-assign, assignment]
    try:
        algorithm.update(given)
    except UserError as error:  # not the caller's slip, but a broken promise
        raise AssertionError(str(error)) from error
    del algorithm.losses
    return steps


def _tensors(state: Any, path: str = "") -> dict[str, Tensor]:
    """Copies of all tensors of a nested state, by path."""
    if isinstance(state, Tensor):
        return {path: state.detach().clone()}
    items = state.items() if isinstance(state, dict) else enumerate(state) if isinstance(state, list | tuple) else ()
    return {k: v for key, value in items for k, v in _tensors(value, f"{path}/{key}").items()}


def _modules(algorithm: Algorithm) -> dict[str, nn.Module]:
    return {name: part for name, part in algorithm.parts().items() if isinstance(part, nn.Module)}


def _networks(algorithm: Algorithm) -> dict[str, Tensor]:
    """Copies of all parameters and buffers, by part and name."""
    return _tensors({name: module.state_dict() for name, module in _modules(algorithm).items()})


def _optimised(optimiser: Optimizer) -> list[Tensor]:
    return [p for group in optimiser.param_groups for p in group["params"]]


def _moved(before: dict[str, Tensor], after: dict[str, Tensor]) -> set[str]:
    return {name for name in before if not torch.equal(before[name], after[name])}


def _names_of(algorithm: Algorithm, optimiser: Optimizer) -> set[str]:
    """Names, in `_networks`, of the parameters that an optimiser steps."""
    mine = {id(p) for p in _optimised(optimiser)}
    modules = _modules(algorithm)
    return {f"/{part}/{name}" for part, m in modules.items() for name, p in m.named_parameters() if id(p) in mine}


def _numbers(logs: dict[str, Tensor]) -> dict[str, float]:
    return {key: value.item() for key, value in logs.items()}


def losses_are_finite_scalars(name: str, **options: Any) -> None:
    """Every update has a loss; losses are finite scalars, and what is logged are detached ones under distinct names."""
    algorithm = make(name, **options)
    for number in range(UPDATES):
        steps = watched(algorithm, batch(number))
        logged = [key for step in steps for key in step.loss.logs]
        claim(logged, f"update {number} logs nothing")
        claim(len(logged) == len(set(logged)), f"two losses log under one name: {shown(logged)}")
        for step in steps:
            _claim_scalar("a loss", step.loss.value)
            for key, value in step.loss.logs.items():
                _claim_scalar(key, value)
                claim(not value.requires_grad and value.grad_fn is None, f"{key} is logged with its graph: detach it")


def _claim_scalar(what: str, value: Tensor) -> None:
    claim(value.shape == (), f"{what} has the shape {tuple(value.shape)}")
    claim(value.isfinite(), f"{what} is {value.item()}")


def a_loss_moves_what_its_optimiser_steps(name: str, **options: Any) -> None:
    """A loss reaches all that its optimiser steps, and the step moves nothing else; all of the policy's net moves."""
    algorithm = make(name, **options)
    policy_moved: set[str] = set()
    for number in range(UPDATES):
        for step in watched(algorithm, batch(number)):
            mine, stepped = _names_of(algorithm, step.loss.optimiser), _optimised(step.loss.optimiser)
            claim(len(mine) == len(stepped), f"of {len(stepped)} parameters that it steps parts() names {len(mine)}")
            reached = zip(stepped, step.reached[:-1], strict=True)
            missed = [tuple(p.shape) for p, gradient in reached if gradient is None or not gradient.any()]
            claim(missed == [], f"a loss has no gradient to parameters of the shapes {missed}")
            changed = _moved(step.before, step.after)
            claim(changed == mine, f"the step moved {shown(changed)}, its optimiser has {shown(mine)}")
            policy_moved |= {key for key in changed if key.startswith("/policy/")}
    still = {f"/policy/net.{key}" for key in algorithm.policy.net.state_dict()} ^ policy_moved
    claim(not still, f"within {UPDATES} updates of the policy these alone stood still, or should have: {shown(still)}")


def the_first_loss_alone_reaches_the_representations(name: str, **options: Any) -> None:
    """The first loss, which trains the encoder where none is frozen, has a gradient to `batch.z`, and no other has."""
    algorithm = make(name, **options)
    for number in range(UPDATES):
        first, *others = watched(algorithm, batch(number))
        gradient = first.reached[-1]
        claim(gradient is not None and gradient.any(), "the first loss has none")
        claim(all(step.reached[-1] is None for step in others), "a later one has: detach `batch.z` for it")


def targets_creep_and_nothing_else_moves_by_itself(name: str, **options: Any) -> None:
    """Parts called `target_x` move by the share `tau` of the way to x; nothing else moves but by steps along losses."""
    algorithm = make(name, **options)
    targets = {part: module for part, module in _modules(algorithm).items() if f"/{part}".startswith(_TARGET)}
    with torch.no_grad():
        for parameter in (p for module in targets.values() for p in module.parameters()):
            parameter.add_(0.5)
    crept = set()
    for number in range(UPDATES):
        before = _networks(algorithm)
        steps = watched(algorithm, batch(number))
        after = _networks(algorithm)
        by_itself = _moved(before, after) - {key for step in steps for key in _moved(step.before, step.after)}
        for key in by_itself:
            claim(key.startswith(_TARGET), f"{key} moved with no step along a loss")
            online = after["/" + key.removeprefix(_TARGET)]
            tau = getattr(algorithm, "tau")  # noqa: B009 (algorithms without targets have none)
            claim_close(after[key], before[key].lerp(online, tau), f"{key} did not move by tau = {tau}")
        crept |= {key.split("/")[1] for key in by_itself}
    claim(crept == targets.keys(), f"of the targets {shown(targets)} moved {shown(crept)}")


def an_algorithm_that_goes_on_elsewhere_takes_the_same_steps(name: str, **options: Any) -> None:
    """An algorithm that takes over another's state takes the other's steps, to the bit."""
    one, other = (make(name, seed=seed, **options) for seed in (0, 1))
    for number in range(3):
        one.update(batch(number))
    other.load_state_dict(_kept(one.state_dict()))
    for number in range(3, 3 + UPDATES):
        here, there = _numbers(one.update(batch(number))), _numbers(other.update(batch(number)))
        claim(here == there, f"update {number} logs {here} and {there}")
    here_state, there_state = _tensors(one.state_dict()), _tensors(other.state_dict())
    claim(here_state.keys() == there_state.keys(), f"their states hold {shown(here_state)} and {shown(there_state)}")
    differing = [key for key in here_state if not torch.equal(here_state[key], there_state[key])]
    claim(differing == [], f"these differ at the end: {shown(differing)}")


def _kept(state: dict[str, Any]) -> dict[str, Any]:
    """A state as a checkpoint gives it back."""
    try:
        return unpack(pack(state))
    except UserError as error:
        raise AssertionError(str(error)) from error


def updates_draw_from_the_generator_alone(name: str, **options: Any) -> None:
    """Random numbers come from the generator that the algorithm was given, not from torch's own."""
    one, other = make(name, **options), make(name, **options)
    for number in range(UPDATES):
        torch.manual_seed(number)
        here = _numbers(one.update(batch(number)))
        torch.manual_seed(1000 + number)
        there = _numbers(other.update(batch(number)))
        claim(here == there, f"after other seeds of torch, update {number} logs {here} and {there}")


def actions_lie_within_their_bounds(name: str, **options: Any) -> None:
    """The policy's actions lie in [-1, 1], however far a representation is from those of the training."""
    algorithm = make(name, **options)
    for number in range(UPDATES):
        algorithm.update(batch(number))
    action = algorithm.policy(1e3 * torch.randn(100, DIM, generator=torch.Generator().manual_seed(0)))
    claim(action.shape == (100, ACTIONS), f"actions have the shape {tuple(action.shape)}")
    claim(action.abs().max() <= 1, f"one has the size {action.abs().max().item()}")


def a_batch_is_left_as_it_was(name: str, **options: Any) -> None:
    """An update changes nothing in the batch that it is given."""
    from finetune.features import FeatureBatch

    given = batch()
    make(name, **options).update(given)
    changed = [f.name for f in fields(FeatureBatch) if not torch.equal(given[f.name], batch()[f.name])]
    claim(changed == [], f"it changed {shown(changed)}")


CHECKS: tuple[Check, ...] = (
    losses_are_finite_scalars,
    a_loss_moves_what_its_optimiser_steps,
    the_first_loss_alone_reaches_the_representations,
    targets_creep_and_nothing_else_moves_by_itself,
    an_algorithm_that_goes_on_elsewhere_takes_the_same_steps,
    updates_draw_from_the_generator_alone,
    actions_lie_within_their_bounds,
    a_batch_is_left_as_it_was,
)

"""Conformance checks of fine-tuning algorithms: losses, parameter updates, target networks, resuming, stacking."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from finetune.algorithms import ALGORITHMS, Algorithm, Loss
from finetune.config import FinetuneConfig
from finetune.features import FeatureBatch
from finetune.stack import Stack
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import check_options
from vd4rl_pomdp.core.streams import RandomStream
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.runs.checkpoint import pack, unpack
from vd4rl_pomdp.runs.metrics import Means
from vd4rl_pomdp.testing.contract import Check, claim, claim_close, claim_equal, listed, run_checks

DIM, ACTIONS, SIZE = 3, 2, 32
UPDATES = 4
"""Enough that an algorithm with delayed updates optimises each of its losses twice."""


def check_algorithm(name: str, **options: Any) -> None:
    """Run all checks on a fine-tuning algorithm of `finetune.algorithms.ALGORITHMS`."""
    check_options(FinetuneConfig.of("smoke", algorithm=name, **options))
    run_checks("algorithm", CHECKS, name, **options)


def batch(number: int = 0) -> FeatureBatch:
    """Random transitions; every other one is terminal."""
    g = torch.Generator().manual_seed(number)
    z, next_z = (5 + 3 * torch.randn(SIZE, DIM, generator=g) for _ in range(2))
    action = torch.rand(SIZE, ACTIONS, generator=g) * 2 - 1
    reward, next_action = torch.randn(SIZE, generator=g), torch.rand(SIZE, ACTIONS, generator=g) * 2 - 1
    return FeatureBatch(z, action, reward, torch.arange(SIZE) % 2 * 0.8, next_z, next_action)


def make(name: str, seed: int = 0, **options: Any) -> Algorithm:
    """An algorithm with a small policy; identical for equal seeds."""
    chosen = FinetuneConfig.of("smoke", algorithm=name, **options).options
    torch.manual_seed(seed)
    policy = Policy(DIM, ACTIONS, 16)
    policy.standardise.fit(batch().z)
    algorithm = ALGORITHMS.named(name)(policy, chosen, 1e-3, 40, RandomStream(torch.Generator().manual_seed(seed)))
    claim(algorithm.policy is policy, "`policy` is not the one that it was given: train that")
    return algorithm


@dataclass
class Step:
    """One optimiser step of an update, with the networks before and after it."""

    loss: Loss
    optimiser: Optimizer
    reached: list[Tensor | None]
    """Gradients of the loss with respect to the optimiser's parameters, then to the representations."""
    before: dict[str, Tensor]
    after: dict[str, Tensor]


def watched(algorithm: Algorithm, transitions: FeatureBatch) -> tuple[list[Step], dict[str, Tensor]]:
    """Run one update; returns its optimiser steps and its logs."""
    z = transitions.z.requires_grad_()
    steps: list[Step] = []
    step = algorithm.step

    def watching(loss: Loss, *optimisers: Optimizer) -> None:
        inputs = [*_optimised(optimisers[0]), z]
        reached = torch.autograd.grad(loss.value, inputs, retain_graph=True, allow_unused=True)
        before = _networks(algorithm)
        step(loss, *optimisers)
        steps.append(Step(loss, optimisers[0], list(reached), before, _networks(algorithm)))

    algorithm.step = watching  # type: ignore[method-assign]
    logs = algorithm.update(transitions)
    del algorithm.step
    claim(steps, "an update makes no optimiser step")
    return steps, logs


def tensors_of(state: Any, path: str = "") -> dict[str, Tensor]:
    """Copies of all tensors in nested dicts and lists, by path."""
    if isinstance(state, Tensor):
        return {path: state.detach().clone()}
    items = state.items() if isinstance(state, dict) else enumerate(state) if isinstance(state, list | tuple) else ()
    return {k: v for key, value in items for k, v in tensors_of(value, f"{path}/{key}").items()}


def _modules(algorithm: Algorithm) -> dict[str, nn.Module]:
    return {name: part for name, part in algorithm.parts().items() if isinstance(part, nn.Module)}


def _networks(algorithm: Algorithm) -> dict[str, Tensor]:
    """Copies of all parameters and buffers, by part and name."""
    return tensors_of({name: module.state_dict() for name, module in _modules(algorithm).items()})


def _optimised(optimiser: Optimizer) -> list[Tensor]:
    return [p for group in optimiser.param_groups for p in group["params"]]


def _moved(before: dict[str, Tensor], after: dict[str, Tensor]) -> set[str]:
    return {name for name in before if not torch.equal(before[name], after[name])}


def losses_are_finite_scalars(name: str, **options: Any) -> None:
    """Losses are finite scalars; an update returns all their logs as detached scalars with distinct names, none of
    them reserved."""
    algorithm = make(name, **options)
    for number in range(UPDATES):
        steps, logs = watched(algorithm, batch(number))
        logged = [key for step in steps for key in step.loss.logs]
        claim(logged, f"update {number} logs nothing")
        claim(sorted(logged) == sorted(logs), f"its losses log {listed(logged)}, the update returns {listed(logs)}")
        Means().add(logs)
        for key, value in {**{f"loss {i}": step.loss.value.detach() for i, step in enumerate(steps)}, **logs}.items():
            claim(value.shape == (), f"{key} has the shape {tuple(value.shape)}")
            claim(value.isfinite(), f"{key} is {value.item()}")
            claim(not value.requires_grad, f"{key} is logged with its graph: detach it")


def a_loss_moves_what_its_optimiser_steps(name: str, **options: Any) -> None:
    """A loss has a gradient to all parameters of its optimiser; its step changes only those; all of the policy is
    trained."""
    algorithm = make(name, **options)
    policy_moved: set[str] = set()
    for number in range(UPDATES):
        for step in watched(algorithm, batch(number))[0]:
            stepped = _optimised(step.optimiser)
            ids = {id(p) for p in stepped}
            modules = _modules(algorithm)
            mine = {f"/{part}/{key}" for part, m in modules.items() for key, p in m.named_parameters() if id(p) in ids}
            claim(len(mine) == len(stepped), f"parts() names {len(mine)} of its optimiser's {len(stepped)} parameters")
            reached = zip(stepped, step.reached[:-1], strict=True)
            missed = [tuple(p.shape) for p, gradient in reached if gradient is None or not gradient.any()]
            claim(missed == [], f"a loss has no gradient to parameters of the shapes {missed}")
            changed = _moved(step.before, step.after)
            claim(changed == mine, f"the step moved {listed(changed)}, its optimiser has {listed(mine)}")
            policy_moved |= {key for key in changed if key.startswith("/policy/")}
    still = {f"/policy/net.{key}" for key in algorithm.policy.net.state_dict()} ^ policy_moved
    claim(not still, f"after {UPDATES} updates, these were not trained, or should not have been: {listed(still)}")


def only_the_first_loss_reaches_the_representations(name: str, **options: Any) -> None:
    """Only the first loss, which trains an encoder that is not frozen, has a gradient to `batch.z`.

    The encoder's optimiser steps along it.
    """
    algorithm = make(name, **options)
    for number in range(UPDATES):
        (first, *others), _ = watched(algorithm, batch(number))
        gradient = first.reached[-1]
        claim(gradient is not None and gradient.any(), "the first loss has none")
        claim(all(step.reached[-1] is None for step in others), "a later one has: detach `batch.z` for it")
    scale = nn.Parameter(torch.ones(()))
    transitions = batch()
    algorithm.update(transitions.replace(z=transitions.z * scale), torch.optim.SGD([scale], lr=1e-3))
    claim(scale.item() != 1, "the encoder's optimiser takes no step: pass it to `minimise` with the first loss")


def targets_move_by_tau_and_nothing_else_moves_by_itself(name: str, **options: Any) -> None:
    """A `target_x` moves towards x by a factor `tau` per update; everything else changes only by optimiser steps, and
    does unless it needs no gradient."""
    algorithm = make(name, **options)
    targets = {part: module for part, module in _modules(algorithm).items() if part.startswith("target_")}
    with torch.no_grad():
        for parameter in (p for module in targets.values() for p in module.parameters()):
            parameter.add_(0.5)  # targets start as copies, so their first moves would be too small to detect
    crept, begun = set(), _networks(algorithm)
    for number in range(UPDATES):
        before = _networks(algorithm)
        steps, _ = watched(algorithm, batch(number))
        after = _networks(algorithm)
        by_itself = _moved(before, after) - {key for step in steps for key in _moved(step.before, step.after)}
        for key in by_itself:
            claim(key.startswith("/target_"), f"{key} moved with no step along a loss")
            online = after["/" + key.removeprefix("/target_")]
            tau = getattr(algorithm, "tau")  # noqa: B009 (algorithms without targets have none)
            claim_close(after[key], before[key].lerp(online, tau), f"{key} did not move by tau = {tau}")
        crept |= {key.split("/")[1] for key in by_itself}
    claim(crept == targets.keys(), f"the targets are {listed(targets)}, but {listed(crept)} moved")
    moved = {key.split("/")[1] for key in _moved(begun, _networks(algorithm))}
    trainable = {part for part, m in _modules(algorithm).items() if any(p.requires_grad for p in m.parameters())}
    claim(not (still := trainable - moved), f"{listed(still)} never moves")


def nothing_is_bootstrapped_where_the_discount_is_zero(name: str, **options: Any) -> None:
    """Losses do not depend on `next_z` and `next_action` where `discount` is 0: the task has ended there."""
    one, other = (make(name, **options) for _ in range(2))
    for number in range(UPDATES):
        transitions = batch(number)
        ended = (transitions.discount == 0)[:, None]
        beyond = {key: transitions[key] + ended for key in ("next_z", "next_action")}
        both = [watched(one, transitions)[0], watched(other, transitions.replace(**beyond))[0]]
        values = [[step.loss.value.item() for step in steps] for steps in both]
        claim(values[0] == values[1], f"with other rows beyond the end the losses are {values[1]}, not {values[0]}")


def a_resumed_algorithm_takes_the_same_steps(name: str, **options: Any) -> None:
    """After loading a state dict, an algorithm takes bit-identical steps, independent of torch's global random
    state."""
    one, other = (make(name, seed=seed, **options) for seed in (0, 1))
    for number in range(3):
        one.update(batch(number))
    other.load_state_dict(unpack(pack(one.state_dict())))  # serialised as in a checkpoint
    for number in range(3, 3 + UPDATES):
        logs = []
        for seed, algorithm in enumerate((one, other)):
            torch.manual_seed(seed)
            logs.append({key: value.item() for key, value in algorithm.update(batch(number)).items()})
        claim(logs[0] == logs[1], f"update {number} logs {logs[0]} and {logs[1]}: keep all in parts, draw from draws")
    claim_equal(tensors_of(one.state_dict()), tensors_of(other.state_dict()), "these differ at the end")


def permuted(algorithm: Algorithm, seed: int) -> Algorithm:
    """Make an algorithm permute the rows of every batch: the same mathematics, summed in another order."""

    def each(function: Callable[..., Any], data: FeatureBatch, *tensors: Tensor) -> Any:
        order = torch.randperm(len(data.z), generator=torch.Generator().manual_seed(seed)).to(data.z.device)
        result = function(data.replace(**{name: data[name][order] for name in data}), *(t[order] for t in tensors))
        return result if isinstance(result, Loss) else result[order.argsort()]

    algorithm.each = each  # type: ignore[method-assign, assignment]
    return algorithm


def farther_than_rounding(
    found: Mapping[str, Tensor],
    single: Callable[[Callable[[Algorithm], Algorithm]], Mapping[str, Tensor]],
) -> list[str]:
    """Tensors that differ from a single run's by more than rounding explains, and by how much.

    `single` repeats a single run; its argument modifies the algorithm before the first step. The tolerance is four
    times the largest change by three other summation orders or float32's epsilon.
    """
    expected = single(lambda algorithm: algorithm)
    others = [single(lambda algorithm, seed=seed: permuted(algorithm, seed)) for seed in range(3)]  # type: ignore[misc]
    claim(found.keys() == expected.keys(), f"they have {listed(found)}, a single run {listed(expected)}")
    far = []
    for name, value in expected.items():
        value = value.double()
        digit = torch.finfo(torch.float32).eps * value.abs().max()
        bound = 4 * torch.stack([digit, *((other[name].double() - value).abs().max() for other in others)]).max()
        apart = (found[name].double() - value).abs().max()
        if not apart <= bound:
            far.append(f"{name} by {apart:.2g}, which rounding explains up to {bound:.2g}")
    return far


def course(algorithm: Algorithm, logs: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Final state tensors, and the series of each logged scalar as one tensor."""
    series: dict[str, list[Tensor]] = {}
    for row in logs:
        for key, value in row.items():
            series.setdefault(key, []).append(value)
    return tensors_of(algorithm.state_dict()) | {key: torch.stack(values) for key, values in series.items()}


def stacks_take_the_steps_of_single_runs(name: str, **options: Any) -> None:
    """Each run in a stack takes the same steps as it does alone, up to rounding."""
    seeds, updates = range(3), 5 * UPDATES
    runs = [make(name, seed, **options) for seed in seeds]
    whole = Stack(runs)
    logs = []
    for number in range(updates):
        data = [batch(seed * updates + number) for seed in seeds]
        try:
            logs.append(whole.update(FeatureBatch(**{key: torch.stack([b[key] for b in data]) for key in data[0]})))
        except (UserError, RuntimeError) as error:
            claim(False, f"an update of three stacked runs fails: {error}")
    for seed, run in zip(seeds, runs, strict=True):

        def single(change: Callable[[Algorithm], Algorithm], seed: int = seed) -> dict[str, Tensor]:
            one = change(make(name, seed, **options))
            return course(one, [one.update(batch(seed * updates + number)) for number in range(updates)])

        whole.settle(seed)
        found = course(run, [{key: value[seed] for key, value in row.items()} for row in logs])
        far = farther_than_rounding(found, single)
        claim(not far, f"a stacked run differs from a single one: {listed(far)}")


def actions_lie_within_their_bounds(name: str, **options: Any) -> None:
    """Actions lie in [-1, 1], even for representations far outside the training distribution."""
    algorithm = make(name, **options)
    for number in range(UPDATES):
        algorithm.update(batch(number))
    action = algorithm.policy(1e3 * torch.randn(100, DIM, generator=torch.Generator().manual_seed(0)))
    claim(action.shape == (100, ACTIONS), f"actions have the shape {tuple(action.shape)}")
    claim(action.abs().max() <= 1, f"one has the size {action.abs().max().item()}")


def a_batch_is_left_as_it_was(name: str, **options: Any) -> None:
    """An update does not modify its batch."""
    algorithm = make(name, **options)
    for number in range(UPDATES):
        transitions = batch(number)
        algorithm.update(transitions)
        claim_equal(dict(**transitions), dict(**batch(number)), "it changed")


CHECKS: tuple[Check, ...] = (
    a_batch_is_left_as_it_was,
    losses_are_finite_scalars,
    a_loss_moves_what_its_optimiser_steps,
    only_the_first_loss_reaches_the_representations,
    targets_move_by_tau_and_nothing_else_moves_by_itself,
    a_resumed_algorithm_takes_the_same_steps,
    nothing_is_bootstrapped_where_the_discount_is_zero,
    stacks_take_the_steps_of_single_runs,
    actions_lie_within_their_bounds,
)

"""All registered algorithms satisfy the contract of algorithms; violations are caught."""

import copy

import numpy as np
import pytest
import torch

from finetune.algorithms import ALGORITHMS, BC, TD3BC, Loss
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.testing import algorithms as checks
from vd4rl_pomdp.testing import check_algorithm, check_corruption
from vd4rl_pomdp.testing.contract import run_check


@pytest.mark.parametrize("check", checks.CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("name", ALGORITHMS)
def test_algorithm_conforms(name, check):
    run_check("algorithm", check, name)


def test_checks_do_not_change_global_generators():
    torch.manual_seed(3)
    np.random.seed(3)  # noqa: NPY002
    expected = torch.rand(2), np.random.rand(2)  # noqa: NPY002
    torch.manual_seed(3)
    np.random.seed(3)  # noqa: NPY002
    check_algorithm("bc")
    check_corruption("patch")
    assert torch.equal(torch.rand(2), expected[0])
    np.testing.assert_array_equal(np.random.rand(2), expected[1])  # noqa: NPY002


class Idle(BC):
    def update(self, batch, *encoder):
        return {"bc_loss": torch.zeros(())}


class Attached(BC):
    def cloning_loss(self, batch, noise):
        value = super().cloning_loss(batch, noise).value
        return Loss(value, {"bc_loss": value})


class Overwriting(TD3BC):
    def actor_loss(self, batch):
        value = super().actor_loss(batch).value
        return Loss(value, {"critic_loss": value.detach()})


class Half(BC):
    """Trains only the last layer of its policy."""

    def __init__(self, policy, options, learning_rate, updates, generator):
        super().__init__(policy, options, learning_rate, updates, generator)
        self.optimiser = torch.optim.Adam(policy.net[-1].parameters(), lr=learning_rate)


class Other(BC):
    def __init__(self, policy, *arguments):
        super().__init__(copy.deepcopy(policy), *arguments)


class Frozen(BC):
    def update(self, batch, *encoder):
        return super().update(batch)


class Twice(TD3BC):
    """Its second loss also has gradients to the representations."""

    def actor_loss(self, batch):
        value, logs = super().actor_loss(batch)
        return Loss(value + self.policy(batch.z).square().mean(), logs)


class Jumping(TD3BC):
    """Moves its targets twice per update."""

    def move_targets(self):
        super().move_targets()
        super().move_targets()


class Renamed(TD3BC):
    """Has targets of other names, which never move."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.critic_target, self.policy_target = self.target_critic, self.target_policy
        del self.target_critic, self.target_policy

    def _next_value(self, batch, next_z, chosen):
        return torch.minimum(*self.critic_target(next_z, chosen)), {}

    def _next_action(self, next_z, noise):
        return (self.policy_target.from_standardised(next_z) + noise).clamp(-1, 1)

    def move_targets(self):
        pass


class Fixed(TD3BC):
    """Has a network that stays as it is."""

    def __init__(self, policy, *arguments):
        super().__init__(policy, *arguments)
        self.prior = torch.nn.Linear(2, 2).requires_grad_(False)


class Endless(TD3BC):
    """Bootstraps beyond the end of the task."""

    def critic_loss(self, batch, noise):
        return super().critic_loss(batch.replace(discount=torch.ones_like(batch.discount)), noise)


class Forgetful(TD3BC):
    """Does not restore the number of updates, which determines when the actor is updated."""

    def load_state_dict(self, state):
        super().load_state_dict(state | {"updates": 0})


class Drawing(BC):
    def cloning_loss(self, batch, noise):
        return super().cloning_loss(batch.replace(z=batch.z + torch.randn(batch.z.shape)), noise)


class Late(BC):
    """Draws within its loss, where a stack has one run's batch but the streams of all runs."""

    def cloning_loss(self, batch, noise):
        return super().cloning_loss(batch, self.draws.normal(*batch.action.shape))


class Reading(BC):
    """Has control flow that depends on values, which differ between stacked runs."""

    def cloning_loss(self, batch, noise):
        return super().cloning_loss(batch, noise if batch.reward.sum() > 0 else -noise)


class Mixing(BC):
    """Computes a batch mean outside of its losses, which mixes stacked runs."""

    def update(self, batch, *encoder):
        return super().update(batch.replace(action=batch.action - batch.action.mean()), *encoder)


class Unbounded(BC):
    def __init__(self, policy, *arguments):
        policy.from_standardised = lambda z: policy.net(z)
        super().__init__(policy, *arguments)


class Writing(BC):
    """Changes its batch, in the second update."""

    def cloning_loss(self, batch, noise):
        if self.updates:
            batch.reward.mul_(2)
        return super().cloning_loss(batch, noise)


class Bootstrapping(TD3BC):
    """Draws from torch's global generator."""

    def next_noise(self, batch):
        return torch.randn_like(batch.action)


MUTANTS = [
    (Idle, checks.losses_are_finite_scalars, "an update makes no optimiser step"),
    (Attached, checks.losses_are_finite_scalars, "bc_loss is logged with its graph"),
    (Overwriting, checks.losses_are_finite_scalars, "its losses log critic_loss, critic_loss, q, the update"),
    (Half, checks.a_loss_moves_what_its_optimiser_steps, "not trained, or should not have been: /policy/net.0"),
    (Other, checks.a_loss_moves_what_its_optimiser_steps, "`policy` is not the one that it was given"),
    (Frozen, checks.only_the_first_loss_reaches_the_representations, "the encoder's optimiser takes no step"),
    (Twice, checks.only_the_first_loss_reaches_the_representations, "a later one has"),
    (Jumping, checks.targets_move_by_tau_and_nothing_else_moves_by_itself, "did not move by tau"),
    (Renamed, checks.targets_move_by_tau_and_nothing_else_moves_by_itself, "critic_target, policy_target never moves"),
    (Endless, checks.nothing_is_bootstrapped_where_the_discount_is_zero, "with other rows beyond the end"),
    (Forgetful, checks.a_resumed_algorithm_takes_the_same_steps, "update 3 logs"),
    (Drawing, checks.a_resumed_algorithm_takes_the_same_steps, "update 3 logs"),
    (Late, checks.stacks_take_the_steps_of_single_runs, "first dimension must be that of the batch"),
    (Reading, checks.stacks_take_the_steps_of_single_runs, "runs of Reading cannot be stacked .*data-dependent"),
    (Mixing, checks.stacks_take_the_steps_of_single_runs, "a stacked run differs from a single one: .*bc_loss by"),
    (Unbounded, checks.actions_lie_within_their_bounds, "one has the size"),
    (Writing, checks.a_batch_is_left_as_it_was, "it changed: reward"),
]


def test_the_first_failure_names_the_cause():
    """Global randomness and changed batches also break later checks."""
    ALGORITHMS.register("drawing", Bootstrapping)
    with pytest.raises(AssertionError, match="draw from draws"):
        check_algorithm("drawing")
    ALGORITHMS.register("writing", Writing)
    with pytest.raises(AssertionError, match="it changed: reward"):
        check_algorithm("writing")


@pytest.mark.parametrize(("kind", "check", "reason"), MUTANTS, ids=lambda value: getattr(value, "__name__", ""))
def test_nonconforming_algorithms_are_caught(kind, check, reason):
    ALGORITHMS.register("mine", kind)
    with pytest.raises(AssertionError, match=f"algorithm 'mine' violates its contract(.|\n)*{reason}"):
        run_check("algorithm", check, "mine")


def test_fixed_networks_conform():
    ALGORITHMS.register("mine", Fixed)
    check_algorithm("mine")


def test_check_algorithm_accepts_options():
    check_algorithm("iql", expectile=0.9)
    with pytest.raises(UserError, match="--expectile is not read by the algorithm bc"):
        check_algorithm("bc", expectile=0.9)
    with pytest.raises(UserError, match="unknown algorithm 'mine'"):
        check_algorithm("mine")

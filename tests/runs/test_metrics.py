"""Means of a row: what counts, over which steps, and where a state comes back."""

import math

import pytest
import torch

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.runs.checkpoint import pack, unpack
from vd4rl_pomdp.runs.metrics import Means

STEPS = [{"loss": 0.1, "actor": 1.0}, {"loss": 0.2}, {"loss": 0.6, "actor": 4.0}, {"loss": 0.7}]


def logs(step: dict[str, float]) -> dict[str, torch.Tensor]:
    return {name: torch.tensor(value) for name, value in step.items()}


def test_a_scalar_counts_the_steps_that_gave_it_and_each_row_begins_anew():
    means = Means()
    for step in STEPS[:3]:
        means.add(logs(step))
    assert means.take() == pytest.approx({"loss": 0.3, "actor": 2.5})
    means.add(logs(STEPS[3]))
    assert means.take() == pytest.approx({"loss": 0.7})
    assert means.take() == {}


@pytest.mark.parametrize("name", ["step", "eval/return/none"])
def test_a_scalar_has_no_name_that_is_anothers(name):
    with pytest.raises(UserError, match=f"is called '{name}', as something else is in metrics.jsonl"):
        Means().add(logs({"loss": 1.0, name: 2.0}))


@pytest.mark.parametrize("cut", range(len(STEPS)))
def test_a_checkpoint_between_two_rows_changes_no_bit(cut):
    whole, before, after = Means(), Means(), Means()
    for step in STEPS:
        whole.add(logs(step))
    for step in STEPS[:cut]:
        before.add(logs(step))
    after.load_state_dict(unpack(pack({"means": before.state_dict()}))["means"])
    for step in STEPS[cut:]:
        after.add(logs(step))
    assert list(after.take().items()) == list(whole.take().items())


def test_a_tensor_that_changes_later_keeps_the_number_that_was_added():
    means, weight = Means(), torch.nn.Parameter(torch.tensor(1.0))
    means.add({"weight": weight})
    with torch.no_grad():
        weight.fill_(9.0)
    assert not any(total.requires_grad for total, _ in means.state_dict().values()), "no graph is kept alive"
    assert means.take() == {"weight": 1.0}


def test_many_numbers_of_half_precision_are_summed_in_single():
    means = Means()
    for _ in range(1000):
        means.add({"loss": torch.tensor(1.0, dtype=torch.bfloat16)})
    assert means.take() == {"loss": 1.0}


def test_one_step_that_gives_no_number_is_seen_in_the_mean():
    means = Means()
    for value in (1.0, float("nan"), 1.0):
        means.add({"loss": torch.tensor(value)})
    assert math.isnan(means.take()["loss"])


def test_adding_reads_no_value():
    """A meta tensor has none: reading it, which would wait for a GPU, raises."""
    means = Means()
    for _ in range(2):
        means.add({"loss": torch.zeros((), device="meta")})
    with pytest.raises((NotImplementedError, RuntimeError)):
        means.take()

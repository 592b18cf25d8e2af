"""Methods that coincide for some settings have equal outputs, to 1e-6."""

import pytest
import torch

from vd4rl_pomdp.testing.methods import ROWS, batch, build


def assert_same_logits(first: torch.nn.Module, second: torch.nn.Module) -> None:
    second.load_state_dict(first.state_dict())
    window = batch()
    real = first.pairs(ROWS).sum(1) < window.length[:, None]
    found = first.action_logits(window)[real]
    torch.testing.assert_close(found, second.action_logits(window)[real], atol=1e-6, rtol=1e-6)


def test_acro_with_k_1_equals_one_step_inverse():
    assert_same_logits(build("acro", max_k=1), build("one_step_inverse"))


@pytest.mark.parametrize("actions", ["", "+a"])
def test_fj_with_past_covering_the_window_equals_ah(actions: str):
    assert_same_logits(build(f"fj{actions}", m=ROWS), build(f"ah{actions}"))


@pytest.mark.parametrize("actions", ["", "+a"])
def test_mik_with_bounded_past_has_the_past_of_fj(actions: str):
    mik, fj = build(f"mik{actions}", m=2), build(f"fj{actions}", m=2)
    fj.encoder.load_state_dict(mik.encoder.state_dict())
    window = batch()
    torch.testing.assert_close(mik.representations(window)[0], fj.representations(window)[0], atol=1e-6, rtol=1e-6)


def test_mik_with_long_future_equals_mik():
    assert_same_logits(build("mik+a", n=ROWS), build("mik+a"))


def test_no_history_equals_acro():
    assert_same_logits(build("acro"), build("no_history"))


def test_losses_of_unscored_gaps_are_not_logged():
    """A logged zero would look like a gap whose action is visible."""
    objective = build("acro")
    every = objective.pairs(ROWS)
    objective.pairs = lambda rows: every[every[:, 1] % 2 == 0]
    logs = objective.loss(batch(), 0.0)[1]
    scored = {name: value for name, value in logs.items() if name.startswith("loss_k")}
    assert scored.keys() == {"loss_k02"}, "of gaps 1 to 3"
    assert all(value > 0 for value in scored.values())

"""Objectives that see more or less than they declare are caught by gradients and by changed inputs.

`test_visible_sets.py` compares this project's objectives with the paper's sets, `test_methods.py` with their
declarations, and `test_frame_encoders.py` checks that frame encoders do not mix images.
"""

from collections.abc import Callable

import pytest
import torch

from vd4rl_pomdp.core.types import Windows
from vd4rl_pomdp.nn.objective import InverseObjective
from vd4rl_pomdp.nn.visibility import declared, dependence, response, wrong_pairs
from vd4rl_pomdp.testing.methods import ROWS, claim_visibility
from vd4rl_pomdp.testing.methods import build_inverse as inverse


def test_wrong_pair_is_described():
    objective = inverse("acro")
    objective.visible = lambda t, k, rows: ({t, t + k}, {t})
    message = (
        "the prediction of a_0 from rows 0 and 1 has gradients to rows [0, 1] and actions []; changes with rows [0, 1] "
        "and actions []; is declared to see rows [0, 1] and actions [0] (15 pairs are wrong)"
    )
    with pytest.raises(AssertionError) as caught:
        claim_visibility(objective, [ROWS], ROWS)
    assert str(caught.value) == message


@pytest.mark.parametrize(
    ("method", "options"), [("mik+a", {}), ("mik+a", {"m": 2, "n": 2}), ("mik", {}), ("ah+a", {}), ("fj+a", {"m": 1})]
)
def test_integrator_sees_one_observation_and_later_actions(method, options):
    objective = inverse(method, history="integrator", **options)
    claim_visibility(objective, [ROWS, ROWS, 4], ROWS)
    first = max(0, 4 - options.get("m", ROWS))
    assert objective.past_visible(4) == ({first}, set(range(first, 4)) if method.endswith("+a") else set())


@pytest.mark.parametrize("row", [0, 1])
def test_extra_frame_in_the_future_is_caught(row: int):
    """The visible rows stay equal; only the visible frames differ."""
    objective = inverse("mik+a", future_frames="newest")
    blanked = objective._blanked
    objective._blanked = lambda obs: [obs if row == i else blank for i, blank in enumerate(blanked(obs))]
    assert wrong_pairs(objective, [ROWS]) == []
    largest = ROWS - 1 - row  # the row after the last one is not in the window
    assert {k for _, _, k in wrong_pairs(objective, [ROWS], frames=True)} == {*range(2, largest + 1)}


def shift_states(objective: InverseObjective, which: tuple[int, ...]) -> None:
    """Shift the past (0) or future (1) representations by one row."""
    real = objective.representations
    objective.representations = lambda w: tuple(r.roll(1, 1) if i in which else r for i, r in enumerate(real(w)))


@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("method", ["mik", "mik+a", "fj", "acro"])
def test_each_end_of_a_pair_is_checked(method: str, which: int):
    objective = inverse(method, **({"m": 1} if method == "fj" else {}))
    shift_states(objective, (which,))
    assert wrong_pairs(objective, [ROWS])


@pytest.mark.parametrize("method", ["ah+a", "fj+a", "mik+a"])
def test_shifted_and_unseen_actions_are_caught(method: str):
    for change in (lambda a: a.roll(-1, 1), lambda a: a * 0):
        objective = inverse(method, **({"m": 1} if method == "fj+a" else {}))
        encode = objective.encoder.from_features
        objective.encoder.from_features = lambda f, a, change=change, encode=encode: encode(f, change(a))
        assert wrong_pairs(objective, [ROWS])


@pytest.mark.parametrize("method", ["fj", "fj+a"])
@pytest.mark.parametrize("error", [-1, 1])
def test_windows_off_by_one_row_are_caught(method: str, error: int):
    objective = inverse(method, m=2)
    declared_by = inverse(method, m=2 + error)
    objective.past_visible = declared_by.past_visible
    assert wrong_pairs(objective, [ROWS])


def test_further_visibility_mutants_are_caught():
    mixing = inverse("acro")
    frame = mixing.encoder.frame.forward
    mixing.encoder.frame.forward = lambda obs: (z := frame(obs)) - z.mean(1, keepdim=True)
    assert wrong_pairs(mixing, [ROWS]), "normalising over time"

    across = inverse("acro")
    frame_across = across.encoder.frame.forward
    across.encoder.frame.forward = lambda obs: (z := frame_across(obs)) - z.mean(0, keepdim=True)
    with pytest.raises(ValueError, match="another window"):
        wrong_pairs(across, [ROWS, ROWS])


def leak(objective: InverseObjective, what: Callable[[Windows], torch.Tensor]) -> None:
    """Add something (B, T, 1) to the past representations."""
    real = objective.representations
    objective.representations = lambda w: ((both := real(w))[0] + what(w), both[1])


@pytest.mark.parametrize(
    "what",
    [
        lambda w: w.action.detach().mean(-1, keepdim=True),
        lambda w: (w.action[..., :1] > 0).double(),
        lambda w: w.obs.flatten(2)[..., :1].round().roll(-1, 1),
    ],
    ids=["detached action", "compared action", "rounded next picture"],
)
def test_leaks_without_gradient_are_caught(what: Callable[[Windows], torch.Tensor]):
    objective = inverse("mik+a")
    leak(objective, what)
    blind = dependence(objective, [ROWS])
    assert all(seen == declared(objective, t, k, ROWS, True) for (_, t, k), seen in blind.items())
    assert wrong_pairs(objective, [ROWS])


def test_detached_leak_between_windows_is_caught():
    objective = inverse("acro")
    leak(objective, lambda w: w.action.detach().mean((0, 1)).mean() + torch.zeros(()))
    with pytest.raises(ValueError, match="another window"):
        response(objective, [ROWS, ROWS])


def test_declared_row_without_gradient_is_caught():
    objective = inverse("ah")
    encode = objective.encoder.from_features
    objective.encoder.from_features = lambda f, a: encode(torch.cat([f[:, :1].detach(), f[:, 1:]], 1), a)
    assert response(objective, [ROWS]) == response(inverse("ah"), [ROWS])
    assert wrong_pairs(objective, [ROWS])


def test_random_predictions_must_be_repeatable():
    objective = inverse("acro")
    objective.head.rest.insert(0, torch.nn.Dropout(0.5))
    with pytest.raises(ValueError, match="put the objective into eval mode"):
        wrong_pairs(objective, [ROWS])
    assert wrong_pairs(objective.eval(), [ROWS]) == []

"""What an action logit depends on is exactly what its objective declares: shown by gradients, for every method."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pretrain.config import PRESETS
from pretrain.objectives import METHODS, build_objective
from vd4rl_pomdp.nn.action_target import make_action_target
from vd4rl_pomdp.objective import InverseObjective
from vd4rl_pomdp.types import Windows

ROWS, MAX_K, ACTIONS = 6, 4, 2


def inverse(method: str, **changes: object) -> InverseObjective:
    torch.manual_seed(0)
    config = replace(PRESETS["smoke"], method=method, max_k=MAX_K, feature_dim=6, hidden_dim=5, head_dim=8, **changes)
    actions = torch.rand(50, ACTIONS) * 2 - 1
    target = make_action_target("kmeans", actions.numpy(), 4, 0)
    objective = build_objective(config, actions, target).double()
    if not isinstance(objective, InverseObjective):
        pytest.skip(f"{method} predicts no actions")
    return objective


def differentiable_window(lengths: list[int], seed: int = 0) -> tuple[Windows, torch.Tensor, torch.Tensor]:
    """A window whose frames and actions a_0..a_{T-1} carry gradients; observations are tiny for speed."""
    g = torch.Generator().manual_seed(seed)
    batch = len(lengths)
    obs = (torch.rand(batch, ROWS, 9, 84, 84, generator=g, dtype=torch.float64) * 255).requires_grad_()
    actions = (torch.rand(batch, ROWS, ACTIONS, generator=g, dtype=torch.float64) - 0.5).requires_grad_()
    length = torch.tensor(lengths)
    has_action = torch.arange(ROWS) < length[:, None] - 1
    has_action[0] = torch.arange(ROWS) < length[0]  # the first window ends inside its episode
    action = actions * has_action[..., None]
    prev_action = torch.cat([torch.zeros(batch, 1, ACTIONS, dtype=torch.float64), action[:, :-1]], 1)
    window = Windows(obs, prev_action, action, has_action, length, torch.zeros(batch, ROWS, dtype=torch.int64))
    return window, obs, actions


def dependence(objective: InverseObjective, lengths: list[int]) -> dict[tuple[int, int, int], tuple[set, set]]:
    """(window, t, k) -> observation rows and action indices with a gradient, for all real pairs."""
    window, obs, actions = differentiable_window(lengths)
    logits = objective.action_logits(window)
    found = {}
    weights = torch.randn(logits.shape[-1], generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    for p, (t, k) in enumerate(objective.pairs(ROWS).tolist()):
        for b, length in enumerate(lengths):
            if t + k >= length:
                continue
            grads = torch.autograd.grad(
                (logits[b, p] * weights).sum(), (obs, actions), retain_graph=True, allow_unused=True
            )
            seen = [
                set() if g is None else set(torch.nonzero(g[b].flatten(1).abs().amax(1))[:, 0].tolist()) for g in grads
            ]
            others = [g is not None and bool(g[torch.arange(len(lengths)) != b].any()) for g in grads]
            assert not any(others), "one window's logits depend on another window"
            found[b, t, k] = (seen[0], seen[1])
    return found


def declared(objective: InverseObjective, t: int, k: int, length: int, last_action: bool) -> tuple[set, set]:
    rows, actions = objective.visible(t, k, length)
    return rows, {a for a in actions if a < length - 1 or last_action}


def wrong_pairs(objective: InverseObjective, lengths: list[int]) -> list[tuple[int, int, int]]:
    return [
        (b, t, k)
        for (b, t, k), seen in dependence(objective, lengths).items()
        if seen != declared(objective, t, k, lengths[b], last_action=b == 0)
    ]


CASES = [(name, {}) for name, method in METHODS.items() if method.trained] + [
    ("mik+a", {"literal_future": True}),
    ("acro", {"history": "gru"}),
]


@pytest.mark.parametrize("mode", ["train", "eval"])
@pytest.mark.parametrize(("method", "changes"), CASES)
def test_dependence_is_what_is_declared(method: str, changes: dict, mode: str):
    objective = inverse(method, **changes).train(mode == "train")
    assert wrong_pairs(objective, [ROWS, ROWS, 4]) == []


def test_mik_a_never_sees_the_masked_actions():
    objective = inverse("mik+a")
    for (_, t, k), (_, actions) in dependence(objective, [ROWS]).items():
        assert actions.isdisjoint(range(t, t + k))


def test_the_literal_future_leaks_the_target_at_k_1():
    seen = dependence(inverse("mik+a", literal_future=True), [ROWS])
    assert all(t in actions for (_, t, k), (_, actions) in seen.items() if k == 1)


def test_mutants_are_caught():
    shifted = inverse("mik+a")
    real = shifted._future_rows
    shifted._future_rows = lambda f, w: real(f, w.replace(action=w.prev_action))
    assert wrong_pairs(shifted, [ROWS])

    early = inverse("mik+a")
    encode = early.encoder.from_features
    early.encoder.from_features = lambda f, a: encode(f, a.roll(-1, 1))
    assert wrong_pairs(early, [ROWS])

    mixing = inverse("acro")
    frame = mixing.encoder.frame.forward
    mixing.encoder.frame.forward = lambda obs: (z := frame(obs)) - z.mean(1, keepdim=True)
    assert wrong_pairs(mixing, [ROWS])

    blind = inverse("mik+a")
    encode_blind = blind.encoder.from_features
    blind.encoder.from_features = lambda f, a: encode_blind(f, a * 0)
    assert wrong_pairs(blind, [ROWS]), "an objective that does not see what it declares must be caught too"


def test_padding_changes_no_loss():
    objective = inverse("mik+a")
    window, _, _ = differentiable_window([4, 4])
    window = window.replace(has_action=torch.arange(ROWS).expand(2, -1) < 3)
    loss, _ = objective.loss(window, 0.0)
    noisy = window.replace(obs=window.obs.detach().clone(), action=window.action.detach().clone())
    noisy.obs[:, 4:], noisy.action[:, 4:] = 255.0, 7.0
    torch.testing.assert_close(objective.loss(noisy, 0.0)[0], loss)


def test_losses_per_k_average_to_the_loss():
    objective = inverse("acro")
    window, _, _ = differentiable_window([ROWS, ROWS])
    loss, logs = objective.loss(window, 0.0)
    counts = np.array([ROWS - k for k in range(1, MAX_K + 1)])
    per_k = np.array([float(logs[f"loss_k{k:02d}"]) for k in range(1, MAX_K + 1)])
    assert np.average(per_k, weights=counts) == pytest.approx(loss.item(), rel=1e-6)

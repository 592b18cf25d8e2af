"""Every method of the registry keeps the contracts: losses, gradients, state, padding, streaming, resumption."""

import copy

import pytest
import torch

from pretrain.build import build_objective, build_target
from pretrain.config import PretrainConfig
from pretrain.objectives import METHODS
from vd4rl_pomdp.nn.action_target import ACTION_TARGETS
from vd4rl_pomdp.objective import InverseObjective, Objective
from vd4rl_pomdp.types import Windows

ROWS, ACTIONS = 6, 2
TRAINED = [name for name, method in METHODS.items() if method.trained]


def build(method: str, **changes: object) -> Objective:
    torch.manual_seed(0)
    small = {"max_k": 3, "feature_dim": 8, "hidden_dim": 7, "head_dim": 8}
    config = PretrainConfig.of("smoke", method=method, **changes).with_known(**(small | changes))
    actions = torch.rand(50, ACTIONS) * 2 - 1
    target = build_target(config, actions.numpy())
    return build_objective(config, actions.shape[1], target, state_dim=5)


def batch(lengths: tuple[int, ...] = (ROWS, ROWS, 4), seed: int = 0, state: bool = False) -> Windows:
    g = torch.Generator().manual_seed(seed)
    shape = (5, 1, 1) if state else (9, 4, 4)
    obs = torch.randint(0, 256, (len(lengths), ROWS, *shape), generator=g, dtype=torch.uint8)
    if not state:  # blocks of 21 pixels, which a shift leaves recognisable
        obs = obs.repeat_interleave(21, -1).repeat_interleave(21, -2)
    length = torch.tensor(lengths)
    has_action = torch.arange(ROWS) < length[:, None] - 1
    action = (torch.rand(len(lengths), ROWS, ACTIONS, generator=g) * 2 - 1) * has_action[..., None]
    prev_action = torch.cat([torch.zeros_like(action[:, :1]), action[:, :-1]], 1)
    key = torch.arange(len(lengths) * ROWS).view(len(lengths), ROWS)
    return Windows(obs, prev_action, action, has_action, length, key)


@pytest.mark.parametrize("method", TRAINED)
def test_loss_is_a_finite_scalar_that_moves_every_part_of_the_encoder(method: str):
    objective = build(method)
    loss, logs = objective.loss(batch(), 0.0)
    assert loss.shape == ()
    assert torch.isfinite(loss)
    assert all(value.numel() == 1 and not value.requires_grad for value in logs.values())
    assert torch.equal(logs["loss"], loss.detach())
    loss.backward()
    still = [n for n, p in objective.encoder.named_parameters() if p.grad is None or not p.grad.any()]
    assert still == []


@pytest.mark.parametrize("method", TRAINED)
def test_a_step_on_one_batch_lowers_its_loss(method: str):
    objective, window = build(method, **({"max_k": 1} if method == "driml" else {})), batch()
    optimiser = torch.optim.Adam(objective.parameters(), lr=1e-3)
    losses = []
    for _ in range(30):
        loss, _ = objective.loss(window, 0.0)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        objective.after_step()
        losses.append(loss.item())
    assert sum(losses[-5:]) < 0.97 * sum(losses[:5])


@pytest.mark.parametrize("method", TRAINED)
def test_state_dict_holds_all_that_a_loss_depends_on(method: str):
    objective, window = build(method), batch()
    objective.loss(window, 0.0)
    other = build(method)
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.add_(0.1)
    other.load_state_dict(objective.state_dict())
    assert objective.loss(window, 0.0)[0].item() == other.loss(window, 0.0)[0].item()


@pytest.mark.parametrize("method", TRAINED)
def test_padding_changes_no_loss(method: str):
    objective, window = build(method), batch((4, 4, 4))
    noisy = window.replace(obs=window.obs.clone(), action=window.action.clone(), prev_action=window.prev_action.clone())
    noisy.obs[:, 4:], noisy.action[:, 4:], noisy.prev_action[:, 5:] = 255, 7.0, 7.0
    again = copy.deepcopy(objective)
    torch.testing.assert_close(again.loss(noisy, 0.0)[0], objective.loss(window, 0.0)[0])


@pytest.mark.parametrize("method", METHODS)
def test_streaming_and_batch_encodings_agree(method: str):
    encoder = build(method).encoder.eval()
    window = batch((ROWS, ROWS), state=METHODS[method].reads_state)
    with torch.no_grad():
        whole = encoder.encode(window)
        state, rows = encoder.initial_state(2), []
        for t in range(ROWS):
            z, state = encoder.step(window.obs[:, t], window.prev_action[:, t], state)
            rows.append(z)
    torch.testing.assert_close(torch.stack(rows, 1), whole, atol=1e-5, rtol=1e-5)
    assert whole.shape == (2, ROWS, encoder.dim)


INVERSE = [name for name in TRAINED if isinstance(build(name), InverseObjective)]


@pytest.mark.parametrize("target", ACTION_TARGETS)
@pytest.mark.parametrize("method", INVERSE)
def test_every_inverse_method_takes_every_action_target(method: str, target: str):
    loss, _ = build(method, action_target=target).loss(batch(), 0.0)
    assert torch.isfinite(loss)


@pytest.mark.parametrize("method", INVERSE)
def test_options_add_their_terms(method: str):
    plain = build(method)
    rich = build(method, self_prediction=0.5, l2_states=0.1, k_embedding=False)
    loss, logs = rich.loss(batch(), 0.25)
    expected = logs["action_loss"] + 0.5 * logs["self_prediction"] + 0.1 * 0.75 * logs["l2_states"]
    torch.testing.assert_close(loss.detach(), expected)
    assert rich.head.k is None
    assert plain.head.k is not None


@pytest.mark.parametrize("method", INVERSE)
def test_the_loss_is_that_of_the_first_action_after_each_pairs_earlier_state(method: str):
    """-log P(a_t | ...), averaged over all real pairs (t, t+k) of the batch: here one by one, and for each k."""
    objective, window = build(method), batch()
    logits = objective.action_logits(window)
    alone: dict[int, list[torch.Tensor]] = {}
    for p, (t, k) in enumerate(objective.pairs(ROWS).tolist()):
        for b, length in enumerate(window.length.tolist()):
            if t + k < length:
                alone.setdefault(k, []).append(objective.target.loss(logits[b, p], window.action[b, t]))
    loss, logs = objective.loss(window, 0.0)
    torch.testing.assert_close(loss, torch.stack([value for values in alone.values() for value in values]).mean())
    for k, values in alone.items():
        torch.testing.assert_close(logs[f"loss_k{k:02d}"], torch.stack(values).mean().detach())


def test_self_prediction_moves_the_prediction_and_never_its_target():
    """||sg(s_{t+k}) - g(s_t, k)||^2: a window's last state is nothing but a target, so no gradient may reach it."""
    objective, window = build("mik+a", self_prediction=1.0), batch((ROWS, ROWS))
    past, future = (x.detach().requires_grad_() for x in objective.representations(window))
    loss, logs = objective.loss_of(past, future, window, 0.0)
    loss.backward()
    assert (past.grad.abs().amax((0, 2)) > 0).tolist() == [True] * (ROWS - 1) + [False]

    errors = []
    for t, k in objective.pairs(ROWS).tolist():
        asked = torch.cat([past[:, t], torch.full((2, 1), k / objective.options.max_k)], dim=-1)
        errors.append((objective.predictor(asked) - past[:, t + k]).square().mean())
    torch.testing.assert_close(logs["self_prediction"], torch.stack(errors).mean().detach())


def test_inverse_methods_are_those_of_the_papers():
    expected = {"no_history", "ah", "ah+a", "fj", "fj+a", "mik", "mik+a", "acro", "one_step_inverse"}
    assert set(INVERSE) == expected

"""The baselines on finite problems whose answers are known."""

import copy
import math

import pytest
import torch

from baselines.acdf import ACDF, ACDFOptions
from baselines.curl import CURL
from baselines.driml import DRIML, DRIMLOptions
from baselines.homer import HOMER, HOMEROptions
from baselines.smwm import SMWM, SMWMOptions
from vd4rl_pomdp.core.options import Options
from vd4rl_pomdp.core.types import Windows
from vd4rl_pomdp.nn.action_target import MSETarget
from vd4rl_pomdp.nn.encoder import Encoder, EncoderConfig
from vd4rl_pomdp.nn.heads import info_nce, share_found

STATES = 4


def encoder(dim: int = 16) -> Encoder:
    torch.manual_seed(0)
    return Encoder(EncoderConfig(1, "flat", dim, channels=STATES, size=1))


def finite_windows(batch: int, rows: int, noise: float, g: torch.Generator) -> tuple[Windows, torch.Tensor]:
    """Walks on a ring of 4 states: a step of a_t in {-1, 1}, or a jump to a uniform state with probability `noise`."""
    state = torch.zeros(batch, rows, dtype=torch.int64)
    state[:, 0] = torch.randint(STATES, (batch,), generator=g)
    action = torch.randint(2, (batch, rows, 1), generator=g) * 2.0 - 1
    for t in range(rows - 1):
        jump = torch.rand(batch, generator=g) < noise
        there = torch.randint(STATES, (batch,), generator=g)
        state[:, t + 1] = torch.where(jump, there, (state[:, t] + action[:, t, 0].long()) % STATES)
    obs = (torch.nn.functional.one_hot(state, STATES) * 255).to(torch.uint8)[..., None, None]
    prev = torch.cat([torch.zeros(batch, 1, 1), action[:, :-1]], 1)
    length = torch.full((batch,), rows)
    known = torch.ones(batch, rows, dtype=torch.bool)
    return Windows(obs, prev, action, known, length, torch.zeros(batch, rows, dtype=torch.int64)), state


def train(objective: torch.nn.Module, steps: int, noise: float, batch: int = 64, rows: int = 4) -> float:
    """Train on fresh walks and return the mean loss of the last tenth."""
    g = torch.Generator().manual_seed(0)
    optimiser = torch.optim.Adam(objective.parameters(), lr=3e-3)
    losses = []
    for _ in range(steps):
        loss, _ = objective.loss(finite_windows(batch, rows, noise, g)[0], 0.0)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        objective.after_step()
        losses.append(loss.item())
    return sum(losses[-steps // 10 :]) / (steps // 10)


@pytest.mark.parametrize("codes", [0, 8])
def test_homer_classifier_is_the_bayes_posterior(codes: int):
    noise = 0.5
    objective = HOMER(encoder(), None, HOMEROptions(codes), 0)
    train(objective, 700, noise)
    objective.eval()
    eye = (torch.eye(STATES) * 255).to(torch.uint8)[:, :, None, None]
    with torch.no_grad():
        z = objective.encoder.frame(eye)
        for state in range(STATES):
            for action in (-1, 1):
                action_column = torch.full((STATES, 1), float(action))
                found = torch.sigmoid(objective.logits(z[state].expand(STATES, -1), action_column, z))
                real = torch.full((STATES,), noise / STATES)
                real[(state + action) % STATES] += 1 - noise
                posterior = real / (real + 1 / STATES)
                torch.testing.assert_close(found, posterior, atol=0.08, rtol=0)


def test_homer_imposters_are_uniform_over_next_states():
    objective, given = HOMER(encoder(), None, HOMEROptions(0), 0), []
    window, _ = finite_windows(4, 3, 0.0, torch.Generator().manual_seed(0))
    window = window.replace(obs=torch.randint(0, 256, window.obs.shape, dtype=torch.uint8))
    real = objective.logits
    objective.logits = lambda *both: (given.append(both), real(*both))[1]
    for _ in range(200):
        objective.loss(window, 0.0)
    following = given[0][2]
    assert len(following) == 8
    assert all(torch.equal(a, b) for a, b in zip(given[0][:2], given[1][:2], strict=True)), "the same (o_t, a_t)"
    drawn = torch.stack([(other[2][:, None] == following[None]).all(-1).int() for other in given[1::2]])
    assert (drawn.sum(2) == 1).all(), "each imposter is one of the next states"
    assert ((drawn.float().mean(0) - 1 / 8).abs() < 0.11).all()


def test_share_found_counts_anchors_above_all_negatives():
    scores = torch.tensor([[1.0, 2.0, 0.0], [0.0, 1.0, 0.0], [2.0, 0.0, 1.0]])
    assert share_found(scores).item() == pytest.approx(1 / 3)
    assert share_found(scores, torch.tensor([0, 0, 1])).item() == pytest.approx(2 / 3), "row 1 is no negative of row 0"


def test_info_nce_excludes_candidates_of_the_same_group():
    scores = torch.zeros(6, 6)
    assert info_nce(scores, torch.arange(6)).item() == pytest.approx(math.log(6))
    assert info_nce(scores, torch.tensor([0, 0, 0, 1, 1, 1])).item() == pytest.approx(math.log(4))
    assert info_nce(scores[None].expand(5, -1, -1), torch.arange(6)).item() == pytest.approx(math.log(6))
    assert torch.isfinite(info_nce(torch.eye(6) * 1e30, torch.arange(6))), "large scores do not overflow"
    assert info_nce(scores).item() == pytest.approx(math.log(6)), "without groups all others are negatives"
    assert info_nce(torch.arange(6.0).expand(6, 6)).item() == pytest.approx(
        math.log(sum(math.exp(j) for j in range(6))) - 2.5
    )


def test_driml_reaches_the_optimal_loss_only_with_actions():
    """With k = 1 and no noise the optimal loss is log(number of copies of the true next state)."""
    rows, batch = 2, 64
    g = torch.Generator().manual_seed(9)
    following = [finite_windows(batch, rows, 0.0, g)[1][:, 1] for _ in range(20)]
    copies = torch.stack([(s[:, None] == s[None, :]).sum(1).float().log().mean() for s in following]).mean().item()
    reached = train(DRIML(encoder(), None, DRIMLOptions(1), 0), 400, 0.0, batch, rows)
    assert reached == pytest.approx(copies, rel=0.03)

    blind = DRIML(encoder(), None, DRIMLOptions(1), 0)
    scores = blind._scores
    blind._scores = lambda term, now, action, later: scores(term, now, action * 0, later)
    assert train(blind, 400, 0.0, batch, rows) > copies + 0.5 * math.log(2)


@pytest.mark.parametrize("seed", range(4))
def test_driml_anchors_are_state_and_action(seed: int):
    """psi(s_t, a_t) against phi(s_{t+k}): in windows of T rows only a_0..a_{T-1-k} affect the loss."""
    rows, objective = 4, DRIML(encoder(), None, DRIMLOptions(3), seed)
    window, _ = finite_windows(8, rows, 0.0, torch.Generator().manual_seed(0))
    plain, logs = copy.deepcopy(objective).loss(window, 0.0)
    counts = []
    for t in range(rows):
        other = window.replace(action=window.action.clone())
        other.action[:, t] = torch.linspace(-3, 3, 8)[:, None]
        counts.append(copy.deepcopy(objective).loss(other, 0.0)[0].item() != plain.item())
    assert counts == [t + logs["k"].item() < rows for t in range(rows)]


def test_driml_draws_gaps_uniformly():
    objective, (window, _) = (
        DRIML(encoder(), None, DRIMLOptions(3), 0),
        finite_windows(2, 4, 0.0, torch.Generator().manual_seed(0)),
    )
    with torch.no_grad():
        drawn = torch.stack([objective.loss(window, 0.0)[1]["k"] for _ in range(300)])
    assert torch.bincount(drawn.long(), minlength=4).tolist() == pytest.approx([0, 100, 100, 100], abs=30)


@pytest.mark.parametrize("term", ["gg", "gl", "lg", "ll"])
def test_driml_terms_have_separate_projections(term: str):
    objective, (window, _) = (
        DRIML(encoder(), None, DRIMLOptions(1), 0),
        finite_windows(4, 3, 0.0, torch.Generator().manual_seed(0)),
    )
    plain = objective.loss(window, 0.0)[1]
    with torch.no_grad():
        for projections in (objective.anchors, objective.candidates):
            projections[term][-1].weight.normal_()
    changed = objective.loss(window, 0.0)[1]
    assert {name for name in plain if plain[name] != changed[name]} == {f"loss_{term}", "loss"}


def test_driml_scores_are_clipped_and_negatives_are_all_others():
    """With the score 20 for all candidates except 18 for the positive, the loss reveals the number of negatives."""
    objective, (window, _) = (
        DRIML(encoder(), None, DRIMLOptions(1), 0),
        finite_windows(4, 6, 0.0, torch.Generator().manual_seed(0)),
    )
    seen = []
    real = objective._scores
    objective._scores = lambda *given: seen.append(real(*given)) or seen[-1]
    for module in (*objective.anchors.values(), *objective.candidates.values()):
        with torch.no_grad():
            module[-1].bias.fill_(100.0)
    objective.loss(window, 0.0)
    for scores in seen:
        assert scores.shape[1:] == (20, 20), "anchors and candidates are those of all windows"
        assert 19.9 < scores.min() <= scores.max() <= 20
    objective._scores = lambda *given: torch.full((1, 20, 20), 20.0) - 2 * torch.eye(20)
    expected = math.log(19 * math.exp(2.0) + 1)
    assert objective.loss(window, 0.0)[0].item() == pytest.approx(expected), "rows of the same window are negatives"


def test_curl_encodes_two_random_shifts():
    torch.manual_seed(0)
    objective = CURL(Encoder(EncoderConfig(1, "nature", 8)), None, Options(), 0)
    window, _ = finite_windows(4, 2, 0.0, torch.Generator().manual_seed(0))
    window = window.replace(obs=torch.randint(0, 256, (4, 2, 9, 84, 84), dtype=torch.uint8))
    seen = {}
    for name in ("encoder", "momentum_encoder"):
        frame = getattr(objective, name).frame
        frame.register_forward_pre_hook(lambda module, given, name=name: seen.update({name: given[0].clone()}))
    objective.loss(window, 0.0)
    for one, other in (
        (seen["encoder"], seen["momentum_encoder"]),
        *((window.obs, shifted) for shifted in seen.values()),
    ):
        same = (one == other).flatten(2).float().mean(2)
        assert (same < 0.05).float().mean() > 0.8, "most rows have different shifts"
        assert (one.flatten(2).float().mean(2) - other.flatten(2).float().mean(2)).abs().max() < 2, "same observation"


def test_curl_reaches_the_optimal_loss():
    """With four distinct observations the optimal loss is log(number of copies among the candidates)."""
    rows, batch = 1, 64
    g = torch.Generator().manual_seed(9)
    states = [finite_windows(batch, rows, 0.0, g)[1][:, 0] for _ in range(20)]
    copies = torch.stack([(s[:, None] == s[None, :]).sum(1).float().log().mean() for s in states]).mean().item()
    assert train(CURL(encoder(), None, Options(), 0), 400, 0.0, batch, rows) == pytest.approx(copies, rel=0.03)


def with_forward_model(kind: type, weight: float) -> torch.nn.Module:
    """An objective with fixed initial weights and the given weight of the forward loss."""
    options = ACDFOptions(max_k=1, forward_weight=weight) if kind is ACDF else SMWMOptions(forward_weight=weight)
    return kind(encoder(), MSETarget(1, False), options, 0)


@pytest.mark.parametrize("kind", [ACDF, SMWM])
def test_latent_forward_models_learn_a_ring_without_collapse(kind: type):
    """Without noise two states determine the action, and state and action the next state."""
    objective = with_forward_model(kind, 1.0)
    assert train(objective, 400, 0.0) < 0.02
    with torch.no_grad():
        states = objective.encoder.frame((torch.eye(STATES) * 255).to(torch.uint8)[:, :, None, None])
    apart = torch.cdist(states, states)[~torch.eye(STATES, dtype=torch.bool)]
    assert apart.min() > 0.5, "constant states would be easiest to predict"


@pytest.mark.parametrize("kind", [ACDF, SMWM])
def test_forward_loss_is_the_mean_error_over_real_rows(kind: type):
    objective, (window, _) = with_forward_model(kind, 0.5), finite_windows(3, 4, 0.0, torch.Generator().manual_seed(0))
    window = window.replace(length=torch.tensor([4, 2, 3]))
    loss, logs = objective.loss(window, 0.0)
    states = objective.encoder.encode(window)
    errors = [
        (objective.forward_model(torch.cat([states[b, t], window.action[b, t]])) - states[b, t + 1]).square().mean()
        for b, length in enumerate(window.length.tolist())
        for t in range(length - 1)
    ]
    torch.testing.assert_close(logs["forward_loss"], torch.stack(errors).mean().detach())
    torch.testing.assert_close(loss.detach(), logs["action_loss"] + 0.5 * logs["forward_loss"])


def test_gradients_of_forward_losses_of_acdf_and_smwm():
    window, _ = finite_windows(2, 4, 0.0, torch.Generator().manual_seed(0))
    for kind, expected in (
        (ACDF, [[True, True, True, False], *[[False] * 4] * 4, [True, True, True, False]]),
        (SMWM, [[True] * 4] * 6),
    ):
        pair, moved = [with_forward_model(kind, weight) for weight in (0.0, 1.0)], []
        for _ in range(6):
            grads = []
            for objective in pair:
                states = objective.encoder.encode(window).detach().requires_grad_()
                objective.representations = lambda w, states=states: (states, states)
                (grad,) = torch.autograd.grad(objective.loss(window, 0.0)[0], states)
                objective.after_step()
                del objective.representations
                grads.append(grad)
            moved.append(((grads[1] - grads[0]).abs().amax((0, 2)) > 1e-7).tolist())
        assert moved == expected, kind

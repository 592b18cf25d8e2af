"""The baselines on finite problems whose answers are known."""

import math

import pytest
import torch

from baselines import CURL, DRIML, HOMER
from vd4rl_pomdp.nn.contrastive import info_nce
from vd4rl_pomdp.nn.encoder import Encoder, EncoderConfig
from vd4rl_pomdp.types import Windows

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
    """Train on fresh walks; mean loss of the last tenth."""
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
def test_homers_classifier_is_the_bayes_posterior(codes: int):
    noise = 0.5
    objective = HOMER(encoder(), codes, seed=0)
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


def test_info_nce_of_independent_views_is_log_n_and_of_equal_views_far_less():
    g = torch.Generator().manual_seed(0)
    n, last = 32, {}
    for name in ("independent", "equal"):
        torch.manual_seed(0)
        bilinear = torch.randn(6, 6).mul_(0.3).requires_grad_()
        optimiser, losses = torch.optim.Adam([bilinear], lr=0.02), []
        for _ in range(300):
            first = torch.randn(n, 6, generator=g)
            second = first if name == "equal" else torch.randn(n, 6, generator=g)
            loss = info_nce(first @ bilinear @ second.T, torch.arange(n))
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            losses.append(loss.item())
        last[name] = sum(losses[-50:]) / 50
    assert last["independent"] == pytest.approx(math.log(n), abs=0.03)
    assert last["equal"] < 0.3 * math.log(n)


def test_candidates_of_the_anchors_own_group_are_no_negatives():
    scores = torch.zeros(6, 6)
    assert info_nce(scores, torch.arange(6)).item() == pytest.approx(math.log(6))
    assert info_nce(scores, torch.tensor([0, 0, 0, 1, 1, 1])).item() == pytest.approx(math.log(4))
    assert info_nce(scores[None].expand(5, -1, -1), torch.arange(6)).item() == pytest.approx(math.log(6))
    assert torch.isfinite(info_nce(torch.eye(6) * 1e30, torch.arange(6))), "large scores do not overflow"


def test_driml_reaches_the_loss_of_the_true_density_ratio_and_needs_the_action():
    """With k = 1 and no noise the best scores single out the true next state: the loss is log(its copies)."""
    rows, batch = 2, 64
    g = torch.Generator().manual_seed(9)
    following = [finite_windows(batch, rows, 0.0, g)[1][:, 1] for _ in range(20)]
    copies = torch.stack([(s[:, None] == s[None, :]).sum(1).float().log().mean() for s in following]).mean().item()
    reached = train(DRIML(encoder(), 1, seed=0), 400, 0.0, batch, rows)
    assert reached == pytest.approx(copies, rel=0.03)

    blind = DRIML(encoder(), 1, seed=0)
    anchor = blind._anchor
    blind._anchor = lambda name, features, action: anchor(name, features, action * 0)
    assert train(blind, 400, 0.0, batch, rows) > copies + 0.5 * math.log(2)


def test_driml_scores_places_against_the_same_place():
    torch.manual_seed(0)
    objective = DRIML(Encoder(EncoderConfig(1, "nature", 8)), 1, seed=0)
    obs = torch.randint(0, 256, (2, 3, 9, 84, 84), dtype=torch.uint8)
    maps = objective.encoder.frame.maps(obs)
    places = objective._places(maps)
    assert places.shape == (2, 3, 49, 64)
    torch.testing.assert_close(places[1, 2, 10], maps[1, 2, :, 1, 3])


def test_curls_momentum_encoder_follows_slowly_and_takes_no_gradient():
    objective = CURL(encoder(), seed=0)
    window, _ = finite_windows(8, 3, 0.0, torch.Generator().manual_seed(0))
    objective.loss(window, 0.0)[0].backward()
    assert all(p.grad is None for p in objective.momentum_encoder.parameters())
    assert objective.bilinear.grad.abs().sum() > 0
    slow = [p.clone() for p in objective.momentum_encoder.parameters()]
    with torch.no_grad():
        for p in objective.encoder.parameters():
            p.add_(1.0)
    objective.after_step()
    for before, after in zip(slow, objective.momentum_encoder.parameters(), strict=True):
        torch.testing.assert_close(after - before, torch.full_like(before, 0.05))


def test_curl_tells_states_apart_up_to_their_copies():
    """Four distinct observations: the best loss is log(copies of the own one among the candidates)."""
    rows, batch = 1, 64
    g = torch.Generator().manual_seed(9)
    states = [finite_windows(batch, rows, 0.0, g)[1][:, 0] for _ in range(20)]
    copies = torch.stack([(s[:, None] == s[None, :]).sum(1).float().log().mean() for s in states]).mean().item()
    assert train(CURL(encoder(), seed=0), 400, 0.0, batch, rows) == pytest.approx(copies, rel=0.03)

"""Supervised references: only the loss sees states, and the learned encoder predicts them."""

from pathlib import Path

import numpy as np
import pytest
import torch

from finetune.features import FrozenEncoder
from pretrain.objectives import METHODS
from pretrain.train import make_batches, make_objective
from pretrain.train import pretrain as run_pretrain
from tests.helpers_bad_input import rejection
from tests.helpers_data import fake_action, fake_rows, frame_identity, write_fake_set, write_rows
from tests.helpers_stages import smoke_pretrain
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.core.types import StateWindows, Windows
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import Dataset, WindowSampler, open_dataset
from vd4rl_pomdp.nn import load_encoder
from vd4rl_pomdp.nn.objective import Objective
from vd4rl_pomdp.nn.probes import probe_state
from vd4rl_pomdp.runs.metrics import read_metrics
from vd4rl_pomdp.testing import check_method
from vd4rl_pomdp.testing.methods import ROWS, build, windows

LAYOUT = TASKS.named("walker_walk").layout
METHOD_NAMES = ["supervised", "supervised+a", "supervised_picture", "integrator"]


@pytest.fixture
def with_states(tmp_path) -> Dataset:
    """A dataset with random states; one pose and one velocity coordinate are constant."""
    dataset = open_dataset(write_fake_set(tmp_path / "own" / "walker_walk" / "expert", [20, 20], physics_dim=18))
    dataset.physics = np.random.default_rng(0).normal(size=(40, 18)) * np.arange(1, 19) + 5
    dataset.physics[:, [3, 12]] = 2
    return dataset


def made(dataset: Dataset, tmp_path: Path, method: str, **changes: object) -> tuple[Objective, WindowSampler]:
    config = smoke_pretrain(dataset.path, tmp_path / "run", method=method, **changes)
    objective = make_objective(dataset, config)
    return objective, make_batches(dataset, config, objective)


@pytest.mark.parametrize("name", [*METHOD_NAMES, "mik+a"])
def test_windows_contain_states_only_for_supervised_methods(with_states, tmp_path, name):
    assert [name for name, method in METHODS.items() if method.regresses_state] == METHOD_NAMES
    window = made(with_states, tmp_path, name)[1].sample()
    if name not in METHOD_NAMES:
        assert type(window) is Windows
        return
    episode, t = window.key >> 20, window.key & 0xFFFFF
    state = LAYOUT.visible_state(with_states.physics[(20 * episode + t).numpy()])
    np.testing.assert_array_equal(window.state, state)


@pytest.mark.parametrize("name", METHOD_NAMES)
def test_states_affect_the_loss_but_not_the_representation(name):
    objective, window = build(name), windows(name)
    assert isinstance(window, StateWindows)
    tracked = window.replace(state=window.state.clone().requires_grad_())
    z = objective.encoder.encode(tracked)
    assert torch.autograd.grad(z.sum(), tracked.state, allow_unused=True, retain_graph=True) == (None,)
    assert torch.equal(z, objective.encoder.encode(window.replace(state=torch.full_like(window.state, 9.0))))
    (gradient,) = torch.autograd.grad(objective.loss(tracked, 0.0)[0], tracked.state)
    assert torch.equal(gradient.abs().amax(-1) > 0, window.real), "the loss uses states of all real rows only"


def test_supervised_method_conforms_with_other_encoders():
    check_method("supervised+a", frame_encoder="small", m=2, gru_layers=2)


def test_prediction_of_row_t_regresses_state_of_row_t():
    """A changed image in row t changes the predictions of rows t and later, and of no earlier row."""
    objective, window = build("supervised"), windows("supervised", (ROWS,))
    dark = window.replace(obs=window.obs.clone())
    dark.obs[:, 3] = 0

    def errors(window: Windows) -> torch.Tensor:
        told = window.replace(state=window.state.clone().requires_grad_())
        return torch.autograd.grad(objective.loss(told, 0.0)[0], told.state)[0]

    assert (errors(window) != errors(dark)).any(-1).tolist() == [[False] * 3 + [True] * 3]


def test_supervised_loss_of_the_mean_prediction_is_one(with_states, tmp_path):
    objective, batches = made(with_states, tmp_path, "supervised", window=20)
    torch.nn.init.zeros_(objective.head[-1].weight)
    torch.nn.init.zeros_(objective.head[-1].bias)
    whole = batches.view.windows([0, 1], 20)
    states = with_states.states().view(2, 20, -1)
    logs = objective.loss(StateWindows(**whole, state=states), 0.0)[1]
    assert objective.head[-1].out_features == 16, "18 coordinates, two of which are constant"
    assert {name: value.item() for name, value in logs.items()} == pytest.approx(
        {"loss": 1.0, "pose_loss": 1.0, "velocity_loss": 1.0}, rel=1e-4
    )
    moved = states.clone()
    moved[..., :9] += 3 * with_states.state_scale().std[:9]
    logs = objective.loss(StateWindows(**whole, state=moved), 0.0)[1]
    assert logs["pose_loss"].item() == pytest.approx(10, rel=1e-3)
    assert logs["velocity_loss"].item() == pytest.approx(1, rel=1e-3)
    assert logs["loss"].item() == pytest.approx((8 * 10 + 8) / 16, rel=1e-3)


def test_losses_ignore_states_of_held_out_episodes(tmp_path):
    dataset = open_dataset(write_fake_set(tmp_path / "own" / "walker_walk" / "expert", [9] * 11, physics_dim=18))
    dataset.physics = np.random.default_rng(0).normal(size=(99, 18))
    for method in METHOD_NAMES:
        objective, batches = made(dataset, tmp_path, method, hold_out=True, batch_size=40)
        window = batches.sample()
        held_out = (window.key >> 20) % 5 == 4
        assert 0 < held_out[:, 0].float().mean() < 1
        assert torch.equal(window.state.isnan().all(-1), held_out)
        tracked = window.replace(state=torch.where(held_out[..., None], torch.nan, window.state).requires_grad_())
        (gradient,) = torch.autograd.grad(objective.loss(tracked, 0.0)[0], tracked.state)
        assert torch.equal(gradient.abs().amax(-1) > 0, window.real & ~held_out)


def test_integrator_windows_reach_the_episode_end(tmp_path):
    """Half of the windows begin with an episode, and each shows only its first observation."""
    dataset = open_dataset(write_fake_set(tmp_path / "own" / "walker_walk" / "expert", [20, 12], physics_dim=18))
    dataset.physics = np.random.default_rng(0).normal(size=(32, 18))
    _, batches = made(dataset, tmp_path, "integrator", shift=0, corruption="none", batch_size=400)
    window = batches.sample()
    episode, t = window.key >> 20, window.key & 0xFFFFF
    last = torch.tensor([19, 11])[episode]
    assert torch.equal(t, torch.minimum(t[:, :1] + torch.arange(20), last))
    assert torch.equal(window.length, last[:, 0] + 1 - t[:, 0])
    assert torch.equal(window.has_action, t[:, :1] + torch.arange(20) < last)
    assert 0.4 < (t[:, 0] == 0).float().mean() < 0.65
    for b in range(4):
        stack = frame_identity(window.obs[b, 0])
        assert stack[-1].tolist() == [episode[b, 0], t[b, 0]]
        actions = [fake_action(int(episode[b, 0]), int(t[b, 0]) + i) for i in range(int(window.length[b]) - 1)]
        np.testing.assert_array_equal(window.action[b, : len(actions)], actions)
        np.testing.assert_array_equal(window.prev_action[b, 1 : len(actions) + 1], actions)
    assert not window.prev_action[:, 0].any()
    assert not window.prev_action[~window.real].any()
    assert not window.action[~window.has_action].any()
    assert torch.equal(window.obs, window.obs[:, :1].expand_as(window.obs))


def test_supervised_methods_reject_missing_or_constant_states(data, with_states, tmp_path):
    words = ["--preset", "smoke", "--data", str(data), "--out", str(tmp_path / "run")]
    assert "stores no simulator states" in rejection(["pretrain", "--method", "supervised+a", *words])
    assert not (tmp_path / "run").exists()
    with_states.physics[:] = 3
    with pytest.raises(UserError, match="states in this dataset are equal"):
        made(with_states, tmp_path, "supervised")


SIZE = 16


def bright_square(folder: Path, episodes: int = 25, rows: int = 30) -> Path:
    """A square that drifts over small images; two pose and two velocity coordinates hold its motion."""
    g = np.random.default_rng(0)
    rows_of = fake_rows([rows] * episodes, physics_dim=18)
    speed = g.uniform(-1.5, 1.5, (episodes, 1, 2))
    place = g.uniform(4, SIZE - 4, (episodes, 1, 2)) + speed * np.arange(rows)[:, None]
    low, span = 4, SIZE - 8
    folded = np.abs((place - low) % (2 * span) - span)  # bounces between the walls
    velocity = speed * -np.sign((place - low) % (2 * span) - span)
    rows_of["physics"][:] = 0
    rows_of["physics"][:, [0, 3]] = folded.reshape(-1, 2)
    rows_of["physics"][:, [9, 10]] = velocity.reshape(-1, 2)
    grid = np.arange(SIZE)
    near = np.exp(-((grid - low - folded.reshape(-1, 2)[..., None]) ** 2) / 8)
    picture = 40 + 200 * near[:, 0, :, None] * near[:, 1, None, :]
    rows_of["observation"] = np.repeat(picture[:, None], 3, 1).astype(np.uint8)
    return write_rows(folder, rows_of)


def test_supervised_training_improves_the_probe(tmp_path):
    data, found = bright_square(tmp_path / "walker_walk" / "expert"), {}
    dataset, hidden = open_dataset(data), {"corruption": "zero_frames", "zeroed_frames": 1}
    settings = hidden | {"frame_encoder": "flat", "hidden_dim": 64, "shift": 0, "window": 16, "batch_size": 8}
    for method, own in (("supervised", {"steps": 200, "learning_rate": 5e-3}), ("random", {"history": "gru"})):
        run = run_pretrain(smoke_pretrain(data, tmp_path / method, method=method, **settings, **own))
        frozen = FrozenEncoder(
            load_encoder(run.path / "encoder")[0], dataset, CorruptionConfig.of(**hidden), 0, "fp32", 0
        )
        z = torch.cat([frozen.episode(i, frozen.view(0)) for i in range(dataset.num_episodes)])
        found[method] = probe_state(z.numpy(), dataset.physics, dataset.episode.numpy(), LAYOUT)
    losses = [row["loss"] for row in read_metrics(tmp_path / "supervised" / "metrics.jsonl")]
    assert losses[-1] < 0.3 * losses[0]
    for probe in ("probe_pose", "probe_velocity"):
        assert found["supervised"][probe] < 0.6 * found["random"][probe]

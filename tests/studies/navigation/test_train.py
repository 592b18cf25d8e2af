import json
from pathlib import Path

import numpy as np
import pytest
import torch

from pretrain.objectives import METHODS, Method
from pretrain.train import Trainer
from tests.helpers_data import write_fake_set
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.nn import load_encoder
from vd4rl_pomdp.nn.frame import MixerLayer, make_frame_encoder
from vd4rl_pomdp.nn.objective import ActionOptions, InverseOptions, StateInverse
from vd4rl_pomdp.studies.navigation.config import NavigationConfig
from vd4rl_pomdp.studies.navigation.runs import METHOD_NAMES, OBJECTIVES
from vd4rl_pomdp.studies.navigation.train import (
    ErrorSums,
    MazeData,
    ProbedObjective,
    StateProbe,
    evaluate,
    learning_rate,
    make_trainer,
    refit,
    refitted_errors,
    train,
)


def smoke(data: Path, out: Path, **changes: object) -> NavigationConfig:
    given = {"data": data, "out": out, "steps": 8, "log_every": 2, "checkpoint_every": 4, "precision": "fp32"}
    return NavigationConfig.of("smoke", **(given | changes))


def trainer_of(config: NavigationConfig) -> tuple[Trainer, ProbedObjective]:
    return make_trainer(MazeData(config), config, torch.device("cpu"))


def results(out: Path) -> dict[tuple, float]:
    rows = json.loads((out / "results.json").read_text())["rows"]
    return {(r["measure"], r["split"], r["probe"], r["rows"], r["k"]): r["value"] for r in rows}


@pytest.fixture(scope="module")
def runs(maze_set, tmp_path_factory) -> dict[str, Path]:
    """A finished run of every method."""
    folder = tmp_path_factory.mktemp("runs")
    return {method: train(smoke(maze_set, folder / method, method=method)).path for method in METHOD_NAMES}


@pytest.mark.parametrize("method", METHOD_NAMES)
def test_paper_objectives_train_and_are_evaluated(runs, method):
    found = results(runs[method])
    for component in ("state", "position", "velocity"):
        assert found[f"{component}_error", "held_out", "refit", "all", 0] > 0
    assert (("action_loss", "held_out", "", "all", 0) in found) == (method in OBJECTIVES)
    encoder, card = load_encoder(runs[method] / "encoder")
    assert (card.method, card.task) == (method, "three_curtains")
    assert (encoder.config.channels, encoder.config.size) == (1, 50)
    assert encoder.config.history == ("none" if method in ("no_history", "supervised_picture") else "gru")
    lines = (runs[method] / "trajectory.csv").read_text().splitlines()
    assert len(lines) == 41


def test_results_cover_all_k_splits_and_hidden_rows(runs):
    found = results(runs["mik+a"])
    assert {k for measure, *_, k in found if measure == "action_loss"} == {0, 1, 2, 3}
    assert {(split, probe) for measure, split, probe, *_ in found if measure == "state_error"} == {
        ("training", "online"),
        ("training", "refit"),
        ("held_out", "online"),
        ("held_out", "refit"),
    }
    assert ("position_error", "training", "refit", "hidden", 0) in found
    averages = [json.loads(line) for line in (runs["mik+a"] / "metrics.jsonl").read_text().splitlines()]
    expected = np.mean([row["state"] for row in averages])  # average_last covers all eight steps
    assert found["state_error", "training", "online", "all", 0] == pytest.approx(expected)


def test_final_averages_do_not_depend_on_log_interval(maze_set, tmp_path):
    few = {"average_last": 5, "evaluation_windows": 2, "refit_windows": 2}
    intervals = (1, 2, 3, 100)
    for every in intervals:
        train(smoke(maze_set, tmp_path / str(every), log_every=every, **few))
    found = [results(tmp_path / str(every)) for every in intervals]
    for measure in (("state_error", "training", "online", "all", 0), ("action_loss", "training", "", "all", 0)):
        assert [one[measure] for one in found] == pytest.approx([found[0][measure]] * len(found))


class Doubled(StateInverse):
    """A user's method that overrides `loss`."""

    def loss(self, window, progress):
        loss, logs = super().loss(window, progress)
        return 2 * loss, logs | {"loss": 2 * loss.detach()}


def test_every_method_trains_its_own_loss_beside_the_probe(maze_set, tmp_path):
    with METHODS.isolated():
        METHODS.register("doubled", Method(Doubled, options=InverseOptions))
        data = window = None
        for method in (name for name, one in METHODS.items() if issubclass(one.options, ActionOptions)):
            config = smoke(maze_set, tmp_path / "run", method=method, action_target="mse")
            data = data or MazeData(config).on(torch.device("cpu"))
            window = window or data.windows(torch.tensor([0, 30]))
            probed = ProbedObjective(data, config)
            loss, logs = probed.loss(window, 0.0)
            own, named = probed.objective.loss(window, 0.0)
            assert {*logs} == {*named, "probe_loss"}, method
            torch.testing.assert_close(loss - logs["probe_loss"], own)


def test_probe_does_not_change_encoder_gradients(maze_set, tmp_path):
    trainer, probed = trainer_of(smoke(maze_set, tmp_path / "run"))
    window = trainer.batches.sample()
    past, future = probed.objective.representations(window)
    loss, _ = probed.objective.loss_of(past, future, window, 0.0)
    expected = torch.autograd.grad(loss, list(probed.objective.parameters()), retain_graph=True)
    with_probe = torch.autograd.grad(probed.loss(window, 0.0)[0], list(probed.objective.parameters()))
    for one, other in zip(expected, with_probe, strict=True):
        torch.testing.assert_close(one, other)
    probed.loss(window, 0.0)[0].backward()
    assert all(parameter.grad is not None for parameter in probed.probe.parameters())


def test_supervised_reference_has_no_action_loss(maze_set, tmp_path):
    trainer, probed = trainer_of(smoke(maze_set, tmp_path / "run", method="supervised+a"))
    loss, logs = probed.loss(trainer.batches.sample(), 0.0)
    loss.backward()
    assert set(logs) == {"loss"}
    assert all(p.grad is not None and p.grad.any() for p in probed.encoder.parameters())
    assert probed.encoder.config.use_actions
    assert not trainer_of(smoke(maze_set, tmp_path / "run", method="supervised"))[1].encoder.config.use_actions


def test_held_out_trajectories_are_not_sampled(maze_set, tmp_path):
    data = trainer_of(smoke(maze_set, tmp_path / "run"))[1].data
    assert data.first_held_out == 11
    for held_out in (False, True):
        for number in data.spread(10_000, held_out):
            episodes = data.windows(number).key >> 20
            assert ((episodes >= 11) == held_out).all()
    assert data.total - data.training == 40 - 16 + 1


def test_maze_windows_contain_the_states_of_their_rows(maze_set, tmp_path):
    data = trainer_of(smoke(maze_set, tmp_path / "run"))[1].data
    window = data.windows(torch.tensor([0, 30, 130]))
    raw = data.states[data.dataset.rows(window.key)] * data.std + data.mean
    for b, key in enumerate(window.key[:, 0].tolist()):
        start = int(data.dataset.episode_start[key >> 20]) + (key & (1 << 20) - 1)
        np.testing.assert_allclose(raw[b], data.dataset.physics[start : start + 16], atol=1e-4)
    training = data.states[: int(data.dataset.episode_start[11])]
    torch.testing.assert_close(training.mean(0), torch.zeros(4), atol=1e-4, rtol=0)
    torch.testing.assert_close(training.std(0), torch.ones(4), atol=1e-4, rtol=0)


def test_error_sums_handle_burn_in_hidden_rows_and_units():
    estimate = torch.tensor([9.0, 9, 1, 1, 4])[None, :, None] * torch.tensor([1.0, 1, 2, 2])
    errors, hidden = ErrorSums(), torch.tensor([[True, True, False, False, True]])
    errors.add(estimate, torch.zeros(1, 5, 4), hidden, burn_in=2)
    found = errors.both(torch.tensor([2.0, 1.0, 3.0, 0.5]))
    for name, expected in {"position": (200, 400), "velocity": (400, 800), "state": (300, 600)}.items():
        assert (found[name], found[f"{name}_hidden"]) == pytest.approx(expected)
    for name, expected in {"position": (300, 600), "velocity": (700, 1400), "state": (500, 1000)}.items():
        assert (found[f"raw_{name}"], found[f"raw_{name}_hidden"]) == pytest.approx(expected)
    errors = ErrorSums()
    errors.add(estimate, torch.zeros(1, 5, 4), torch.zeros_like(hidden), burn_in=0)
    assert "position_hidden" not in errors.both(torch.ones(4))


def test_refitted_probe_finds_only_encoded_information():
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(4000, 6, generator=generator)
    truth = torch.stack([features[:, 0], features[:, 1] * features[:, 2], features[:, 0].sin(), features[:, 5]], 1)
    truth[:, 3] = torch.randn(4000, generator=generator)  # not in the features
    probe = refit(features[:3000], truth[:3000], 400, 0)
    error = (probe(features[3000:]) - truth[3000:]).abs().mean(0)
    assert (error[:3] < 0.15).all()
    assert error[3] > 0.7
    assert isinstance(probe, StateProbe)


def test_learning_rate_schedule():
    config = NavigationConfig.of("cpu", steps=1000, warm_up=100)
    rates = [learning_rate(config, step) for step in range(1000)]
    assert rates[0] == pytest.approx(config.learning_rate / 100)
    assert int(np.argmax(rates)) in (99, 100)
    assert rates[-1] < 1e-5
    assert {learning_rate(NavigationConfig.of("paper"), step) for step in (0, 10, 10**5)} == {1e-4}
    assert learning_rate(NavigationConfig.of("paper", method="supervised"), 0) == pytest.approx(5e-5)


def test_exogenous_noise_is_added_to_observations(maze_set, tmp_path):
    for picture, shape in (("grey50", (1, 50, 50)), ("rgb50", (3, 50, 50)), ("rgb100", (3, 100, 100))):
        given = {"picture": picture, "frame_encoder": "nature"}
        configs = [smoke(maze_set, tmp_path, exogenous=noise, **given) for noise in ("none", "photographs")]
        clean, noisy = (MazeData(config).on(torch.device("cpu")) for config in configs)
        number = torch.tensor([0, 40])
        first, second = clean.windows(number), noisy.windows(number)
        assert first.obs.shape[-3:] == shape
        assert (second.obs.float() - first.obs.float()).abs().mean() > 5
        torch.testing.assert_close(second.obs, noisy.windows(number).obs)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"method": "mikado"}, "unknown method 'mikado'"),
        ({"method": "curl"}, "curl predicts no actions: choose one of no_history, ah"),
        ({"window": 41}, r"episode 0 has 40 rows, fewer than the window of 41"),
        ({"frame_encoder": "mixer", "picture": "grey50", "burn_in": 20}, "--burn-in 20 leaves no row"),
        ({"future_frames": "newest"}, "--future-frames newest blanks older frames of a stack, but observations here"),
        ({"steps": 0}, "--steps is 0"),
        ({"exogenous": "nowhere"}, "nowhere: no such folder"),
        ({"exogenous": "photographs", "exogenous_weight": 2.0}, "--exogenous-weight is 2.0"),
    ],
)
def test_invalid_navigation_settings_are_rejected(maze_set, tmp_path, changes, message):
    with pytest.raises(UserError, match=message):
        train(smoke(maze_set, tmp_path / "run", **changes))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("attributes", "lengths", "size", "physics_dim", "message"),
    [
        ({}, [20, 20], 100, 4, "names no maze"),
        ({"task": "walker_walk"}, [20, 20], 100, 4, "names no maze"),
        ({"task": "no_curtain"}, [20, 20], 84, 4, "has frames of 84 pixels, mazes of 100"),
        ({"task": "no_curtain"}, [20, 20], 100, 0, "holds no true states"),
        ({"task": "no_curtain"}, [40], 100, 4, "a single trajectory leaves none to hold out"),
        ({"task": "no_curtain"}, [1, 20, 20], 100, 4, "trajectory 0 is a single row, .*--shortest 2"),
    ],
)
def test_unsuitable_datasets_are_rejected(tmp_path, attributes, lengths, size, physics_dim, message):
    folder = tmp_path / "set"
    write_fake_set(folder, lengths, action_dim=2, physics_dim=physics_dim, noise=size, attributes=attributes)
    with pytest.raises(UserError, match=message):
        train(smoke(folder, tmp_path / "run"))


def test_mixer_and_paper_preset_match_the_paper():
    layers = [m for m in make_frame_encoder("mixer", 3, 100, {}).modules() if isinstance(m, MixerLayer)]
    assert len(layers) == 8
    assert layers[0].over_patches[0].in_features == 100
    with pytest.raises(UserError, match="84 is not a multiple"):
        make_frame_encoder("mixer", 9, 84, {})
    paper = NavigationConfig.of("paper")
    assert (paper.memory.gru_layers, paper.memory.hidden_dim, paper.batch_size, paper.window) == (2, 256, 16, 64)
    assert (paper.steps, paper.average_last, paper.learning_rate) == (200_000, 10_000, 1e-4)
    assert paper.options.target.codes == 20
    assert paper.frame_encoder == "mixer"


@pytest.fixture
def probed(maze_set) -> ProbedObjective:
    return trainer_of(smoke(maze_set, Path(), refit_steps=20))[1]


def shift_states(probed: ProbedObjective, held_out: bool) -> None:
    """Shift the true states of the training or held-out rows."""
    split = int(probed.data.dataset.episode_start[probed.data.first_held_out])
    probed.data.states[slice(split, None) if held_out else slice(split)] += 3


def test_refitted_probe_is_not_fitted_on_held_out_states(probed: ProbedObjective):
    probe, before = refitted_errors(probed)
    shift_states(probed, held_out=True)
    again, after = refitted_errors(probed)
    for one, other in zip(probe.parameters(), again.parameters(), strict=True):
        assert torch.equal(one, other)
    assert before["training"] == after["training"]
    assert after["held_out"]["state"] > before["held_out"]["state"] + 100


def test_online_probe_is_evaluated_on_held_out_states(probed: ProbedObjective):
    losses, before = evaluate(probed)
    shift_states(probed, held_out=False)
    assert evaluate(probed) == (losses, before)
    shift_states(probed, held_out=True)
    assert evaluate(probed)[1]["state"] > before["state"] + 100

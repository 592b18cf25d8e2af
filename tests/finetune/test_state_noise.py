"""State observations with noise of a probe's error: its size, and its keyed draws."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from finetune.evaluation import EVALUATION_SEED, Agent, EpisodeJob, evaluate
from finetune.features import ExactSampler, FrozenEncoder, encode_views
from finetune.histories import Histories
from pretrain.train import pretrain as run_pretrain
from tests.helpers_data import write_fake_set
from tests.helpers_stages import smoke_pretrain
from vd4rl_pomdp.core.options import NO_OPTIONS
from vd4rl_pomdp.core.state_scale import StateScale
from vd4rl_pomdp.core.streams import RandomStream
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.core.types import row_key
from vd4rl_pomdp.corruptions import CorruptionConfig, derive_keys
from vd4rl_pomdp.corruptions.keys import draw_normals
from vd4rl_pomdp.data import Dataset, open_dataset
from vd4rl_pomdp.envs.corrupted import CorruptedEnv
from vd4rl_pomdp.nn import load_encoder
from vd4rl_pomdp.nn.policy import Policy

WALKER = TASKS.named("walker_walk")
ROWS, POSE, VELOCITY = 400, 25.0, 40.0


@pytest.fixture(scope="module")
def with_states(tmp_path_factory) -> Iterator[Path]:
    """A dataset with random states of different scales; one pose coordinate is constant."""
    folder = tmp_path_factory.mktemp("states")
    path = write_fake_set(folder / "walker_walk" / "expert", [ROWS] * 5, physics_dim=18)
    physics = np.random.default_rng(0).normal(size=(5 * ROWS, 18)) * 10.0 ** np.arange(-2, 4).repeat(3) + 7
    physics[:, 3] = 2
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("vd4rl_pomdp.data.store.Store.physics", lambda self: physics.copy())
        yield path


def pretrained(data: Path, out: Path, **noise: float) -> Path:
    return run_pretrain(smoke_pretrain(data, out, method="state", **noise)).path / "encoder"


@pytest.fixture(scope="module")
def noisy(with_states, tmp_path_factory) -> Path:
    return pretrained(with_states, tmp_path_factory.mktemp("noisy") / "run", pose_noise=POSE, velocity_noise=VELOCITY)


@pytest.fixture(scope="module")
def plain(with_states, tmp_path_factory) -> Path:
    return pretrained(with_states, tmp_path_factory.mktemp("plain") / "run")


def frozen(encoder: Path, dataset: Dataset, mode: str = "resample") -> FrozenEncoder:
    corruption = CorruptionConfig.of("patch", corruption_mode=mode)
    return FrozenEncoder(load_encoder(encoder)[0], dataset, corruption, 4, "fp32", 0)


def percent(error: torch.Tensor, dataset: Dataset) -> np.ndarray:
    """Mean absolute errors (P,) in percent of each coordinate's standard deviation; constant ones must have error 0."""
    states = dataset.states().double().numpy()
    std, found = states.std(0), error.abs().double().numpy().mean(0)
    assert found[states.std(0) < 1e-6].tolist() == [0.0]
    return 100 * found[std > 1e-6] / std[std > 1e-6]


def test_state_noise_has_the_requested_probe_error(noisy, with_states):
    dataset = open_dataset(with_states)
    made = frozen(noisy, dataset)
    view = made.view(0)
    z = torch.cat([made.episode(i, view) for i in range(dataset.num_episodes)])
    found = percent(z - dataset.states(), dataset)
    np.testing.assert_allclose(found[:8], POSE, rtol=0.08)
    np.testing.assert_allclose(found[8:], VELOCITY, rtol=0.08)
    assert found[:8].mean() == pytest.approx(POSE, rel=0.03)
    assert found[8:].mean() == pytest.approx(VELOCITY, rel=0.03)

    sampler = ExactSampler(made, NO_OPTIONS, 500, 1, 0.99, RandomStream(torch.Generator().manual_seed(0)))
    rows = sampler._starts[torch.randint(len(sampler._starts), (500,), generator=torch.Generator().manual_seed(0))]
    batch = sampler.sample()
    for z, at in ((batch.z, rows), (batch.next_z, rows + 1)):
        assert percent(z - dataset.states()[at], dataset)[8:].mean() == pytest.approx(VELOCITY, rel=0.05)
    position, again = sampler.state_dict(), [made.rows(rows, rows, sampler.view) for _ in range(2)]
    assert not (again[0] == again[1])[:, [0, 2]].any(), "noise is redrawn whenever a row enters a batch"
    sampler.load_state_dict(position)
    following = sampler.sample()
    sampler.load_state_dict(position)
    assert torch.equal(sampler.sample().z, following.z), "a resumed training draws the same noise"


@pytest.mark.parametrize("mode", ["resample", "emission"])
def test_state_noise_is_independent_per_row_and_view(noisy, with_states, mode):
    dataset = open_dataset(with_states)
    made = frozen(noisy, dataset, mode)
    first, again, second = (made.episode(0, made.view(number)) for number in (0, 0, 1))
    assert torch.equal(first, again), "a view repeats"
    assert torch.equal(first, second) == (mode == "emission")
    error = (first - dataset.states()[:ROWS])[:, [0, 2, 10, 17]]
    table = np.corrcoef(torch.cat([error[:-1], error[1:]], 1).T.double().numpy())
    assert np.abs(table - np.eye(8)).max() < 0.2, "noise is independent across coordinates and neighbouring rows"


def test_keyed_normal_draws():
    key = derive_keys(3, torch.arange(40_000))
    draws = draw_normals(key, 3)
    assert (draws.shape, draws.dtype) == ((40_000, 3), torch.float64)
    torch.testing.assert_close(draws.mean(0), torch.zeros(3, dtype=torch.float64), atol=0.02, rtol=0)
    below = [(draws < z).double().mean().item() for z in (-2.0, -1.0, 0.0, 1.0, 2.0)]
    assert below == pytest.approx([0.0228, 0.1587, 0.5, 0.8413, 0.9772], abs=0.004)
    assert torch.equal(draw_normals(key[7:8], 3), draws[7:8])
    assert draw_normals(key.view(4, -1), 2).shape == (4, 10_000, 2)


@pytest.fixture
def hidden(with_states, tmp_path) -> Path:
    """An encoder with memory that hides half of the standardised coordinates."""
    config = smoke_pretrain(with_states, tmp_path / "hidden", frame_encoder="state", hidden_share=0.5)
    return run_pretrain(config).path / "encoder"


@pytest.mark.parametrize("encoder", ["noisy", "hidden"])
def test_streamed_noise_equals_batched_noise(encoder, request):
    loaded = load_encoder(request.getfixturevalue(encoder))[0]
    agent = Agent(loaded, Policy(loaded.dim, 6, 8))
    env = CorruptedEnv(WALKER, CorruptionConfig.of("patch"), length=4, draws="nothing")
    now, seen, states = env.reset(3, EVALUATION_SEED, 2), [], []
    while True:
        seen.append(agent.encoder_input(now, WALKER)[:, 0, 0])
        states.append(torch.from_numpy(WALKER.layout.visible_state(now.time_step.physics)))
        if now.time_step.last:
            break
        now = env.step(np.zeros(6, np.float32))
    key = derive_keys(EVALUATION_SEED, row_key(torch.full((5,), 2), torch.arange(5)))
    batch = loaded.frame.observe(torch.stack(states), key)[..., 0, 0]
    assert torch.equal(torch.stack(seen), batch)
    if encoder == "noisy":
        assert (batch != torch.stack(states)).sum(1).tolist() == [17] * 5
    else:
        assert 20 < (batch == 0).sum() < 70, "about half of 90 coordinates"


def test_noisy_evaluation_does_not_depend_on_worker_count(noisy, plain, tmp_path):
    torch.manual_seed(0)
    policy = Policy(18, 6, 8)
    with torch.no_grad():
        policy.net[-1].weight.mul_(20)
    policy.save(tmp_path / "policy")

    def totals(encoder: Path, workers: int) -> list[float]:
        places = encoder, tmp_path / "policy"
        under = CorruptionConfig.of("patch")
        jobs = [EpisodeJob(*places, WALKER, under, e, film=False, length=6) for e in (0, 1)]
        return [episode.total for episode in evaluate(jobs, workers)]

    with_one = totals(noisy, 1)
    assert totals(noisy, 2) == with_one
    assert not set(totals(plain, 1)) & set(with_one), "noise changes the actions"


def test_pose_and_velocity_noise_are_separate(with_states, tmp_path):
    dataset = open_dataset(with_states)
    for name, touched in (("pose_noise", slice(0, 9)), ("velocity_noise", slice(9, 18))):
        made = frozen(pretrained(with_states, tmp_path / name, **{name: 10.0}), dataset)
        changed = (made.episode(0, made.view(0)) != dataset.states()[:ROWS]).any(0)
        expected = torch.zeros(18, dtype=torch.bool)
        expected[touched] = True
        expected[1] = False  # the constant pose: the simulator's column 3
        assert torch.equal(changed, expected)


def test_state_scale_of_constant_coordinates_is_zero():
    scale = StateScale.fit(torch.tensor([[1.0, 5.0, -2.0], [3.0, 5.0, 2.0]]), pose=1)
    assert (scale.mean.tolist(), scale.std.tolist()) == ([2.0, 5.0, 0.0], [1.0, 0.0, 2.0])
    assert scale.noise(100, 50).tolist() == pytest.approx([(np.pi / 2) ** 0.5, 0, (np.pi / 2) ** 0.5])


def test_state_features_are_cached_in_fp32(with_states, plain, tmp_path):
    """A nearly constant coordinate is scaled up, so half precision would change it in evaluation."""
    dataset = open_dataset(with_states)
    dataset.physics[:, 3] = 1.3
    histories = Histories(dataset, NO_OPTIONS, 1, 0)
    features = encode_views(frozen(plain, dataset), histories, 1, tmp_path / "features.npy", "plain")
    assert torch.equal(features[0], dataset.states())

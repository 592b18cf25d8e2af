"""Random histories, compared with encoding each transition from exactly its visible rows."""

import json

import pytest
import torch

from finetune.config import FinetuneConfig
from finetune.features import ExactSampler, FeatureSampler, FrozenEncoder, encode_views
from finetune.histories import Histories, HistoryOptions
from finetune.train import finetune
from tests.finetune.conftest import BRIEF
from tests.finetune.test_features import LENGTHS, ROWS, noise_set
from tests.helpers_stages import smoke_finetune
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.streams import RandomStream
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import View
from vd4rl_pomdp.nn import Encoder, EncoderConfig, load_encoder

N = 2


@pytest.fixture(params=[("gru", {}), ("transformer", {"attention_window": 3}), ("lru", {})], ids=lambda kind: kind[0])
def frozen(tmp_path, request) -> FrozenEncoder:
    torch.manual_seed(0)
    history, options = request.param
    config = EncoderConfig(6, "nature", 16, history, use_actions=True, hidden_dim=8, memory_options=options)
    encoder = Encoder(config).eval()
    return FrozenEncoder(
        encoder.requires_grad_(False), noise_set(tmp_path / "set", 0.9), CorruptionConfig(), 0, "fp32", 0
    )


def ends_of(frozen: FrozenEncoder, first: int, row: int, last: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Both ends of a transition, encoded step by step from row `first` without an earlier action."""
    state, action, read = frozen.encoder.initial_state(1), torch.zeros(1, 6), []
    for now in range(first, last + 1):
        z, state = frozen.encoder.step(View(frozen.dataset).stacks(torch.tensor([now])), action, state)
        read.append(z[0])
        action = frozen.dataset.action[now + 1 : now + 2]
    return read[row - first], read[last - first]


@pytest.mark.parametrize(("share", "shortest", "longest"), [(0.0, 2, 8), (0.5, 1, 3), (1.0, 2, 2), (1.0, 9, 9)])
def test_both_ends_of_a_transition_share_a_history(frozen, tmp_path, share, shortest, longest):
    options = HistoryOptions(random_histories=share, shortest_history=shortest, longest_history=longest)
    histories = Histories(frozen.dataset, options, N, 0)
    features = encode_views(frozen, histories, 2, tmp_path / "features.npy", "name").float()
    rows = histories.rows.tolist()
    assert histories.random == round(share * len(rows))
    for view in range(2):
        drawn = histories.of_view(view)
        length = dict(zip(drawn.chosen.tolist(), drawn.length.tolist(), strict=True))
        assert len(length) == histories.random
        assert set(length.values()) <= set(range(shortest, longest + 1))
        for i, (first_end, last_end) in enumerate(zip(*drawn.numbers(), strict=True)):
            episode, t = ROWS[rows[i]]
            begin = rows[i] - min(t, length.get(i, len(ROWS)) - 1)
            expected = ends_of(frozen, begin, rows[i], rows[i] + min(N, LENGTHS[episode] - 1 - t))
            torch.testing.assert_close(features[view, first_end], expected[0], atol=2e-3, rtol=0)
            torch.testing.assert_close(features[view, last_end], expected[1], atol=2e-3, rtol=0)


def test_random_histories_differ_between_views_and_repeat(frozen):
    histories = Histories(frozen.dataset, HistoryOptions(random_histories=0.5), N, 0)
    assert torch.equal(histories.of_view(0).chosen, histories.of_view(0).chosen)
    draws = [torch.cat([(view := histories.of_view(n)).chosen, view.length]).tolist() for n in range(4)]
    assert len({tuple(draw) for draw in draws}) > 1


def test_batches_use_drawn_histories(frozen, tmp_path):
    histories = Histories(frozen.dataset, HistoryOptions(random_histories=1.0, longest_history=2), N, 0)
    features = encode_views(frozen, histories, 1, tmp_path / "features.npy", "name")
    sampler = FeatureSampler(histories, features, 64, N, 0.99, RandomStream(torch.Generator().manual_seed(0)))
    batch, known = sampler.sample(), features[0].float()
    first, last = histories.of_view(0).numbers()
    index = torch.randint(len(first), (64,), generator=torch.Generator().manual_seed(0))
    assert torch.equal(batch.z, known[first[index]])
    assert torch.equal(batch.next_z, known[last[index]])
    assert first.min() >= len(ROWS), "all histories are random ones"


def test_exact_batches_use_random_histories(frozen):
    options = HistoryOptions(random_histories=1.0, shortest_history=1, longest_history=1)
    batch = ExactSampler(frozen, options, 16, N, 0.99, RandomStream(torch.Generator().manual_seed(0))).sample()
    index = torch.randint(len(ROWS) - 2, (16,), generator=torch.Generator().manual_seed(0))
    rows = frozen.dataset.transition_rows[index].tolist()
    for z, next_z, row in zip(batch.z, batch.next_z, rows, strict=True):
        episode, t = ROWS[row]
        expected = ends_of(frozen, row, row, row + min(N, LENGTHS[episode] - 1 - t))
        torch.testing.assert_close(z, expected[0], atol=1e-5, rtol=1e-4)
        torch.testing.assert_close(next_z, expected[1], atol=1e-5, rtol=1e-4)


def test_run_stores_readout_and_history_options(encoder, data, tmp_path):
    options = {"readout": "frame+state", "history_window": 4, "random_histories": 0.5, "longest_history": 3}
    config = smoke_finetune(encoder, data, tmp_path / "run", **options, **BRIEF)
    run = finetune(config)
    kept, _ = load_encoder(run.path / "encoder")
    assert (kept.config.readout, kept.config.history_window) == ("frame+state", 4)
    assert json.loads((run.path / "policy" / "config.json").read_text())["dim"] == kept.dim == 64
    record = json.loads((run.path / "config.json").read_text())["config"]
    assert {name: record[name] for name in options} == options
    assert finetune(config).finished


def test_shortest_history_must_not_exceed_longest():
    with pytest.raises(UserError, match="--shortest-history is 5, --longest-history 4: choose"):
        FinetuneConfig.of("smoke", shortest_history=5, longest_history=4).check()

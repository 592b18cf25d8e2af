import json
from dataclasses import replace

import pytest
import torch

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.types import Windows, previous
from vd4rl_pomdp.nn import Encoder, EncoderCard, EncoderConfig, load_encoder, save_encoder
from vd4rl_pomdp.nn.memory import GRU, GRUOptions, run_memory, run_over_next, run_over_versions

CARD = EncoderCard("mik+a", "walker_walk", "expert", {"corruption": "none"}, 0, 10, "smoke")


def make(history: str, use_actions: bool) -> Encoder:
    torch.manual_seed(0)
    return Encoder(EncoderConfig(2, "nature", 16, history, use_actions, 12)).eval()


def window() -> Windows:
    g = torch.Generator().manual_seed(1)
    obs = torch.randint(0, 256, (2, 9, 9, 84, 84), generator=g, dtype=torch.uint8)
    action, real = torch.rand(2, 9, 2, generator=g), torch.ones(2, 9, dtype=torch.bool)
    return Windows(obs, previous(action), action, real, torch.full((2,), 9), torch.zeros(2, 9, dtype=torch.int64))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"history": "GRU"}, "unknown memory 'GRU': choose one of gru"),
        ({"readout": "state+frame"}, r"unknown readout 'state\+frame': choose one of state, frame, frame\+state"),
    ],
)
def test_unknown_history_and_readout_are_rejected(changes, message):
    with pytest.raises(UserError, match=message):
        Encoder(EncoderConfig(6, **changes))


def test_observations_of_another_shape_are_rejected():
    encoder, other = make("gru", True), window()
    for obs in (other.obs[..., :64, :64], other.obs[:, :, :3]):
        with pytest.raises(UserError, match=r"reads observations of shape \(9, 84, 84\), not \("):
            encoder.encode(other.replace(obs=obs))
        with pytest.raises(UserError, match="pretrain an encoder on these"):
            encoder.step(obs[:, 0], other.prev_action[:, 0], encoder.initial_state(len(obs)))


@pytest.mark.parametrize("history", ["none", "gru"])
def test_missing_and_extra_dimensions_are_rejected(history):
    encoder, whole = make(history, False), window()
    row, action, state = whole.obs[:, 0], whole.prev_action[:, 0], encoder.initial_state(2)
    for obs, given in ((row[0], action[0]), (row[None], action[None])):
        with pytest.raises(UserError, match=r"of shape \(B, 9, 84, 84\) here, not \(.*: add or remove"):
            encoder.step(obs, given, state)
    with pytest.raises(UserError, match=r"of shape \(B, T, 9, 84, 84\) here, not \(9, 9, 84, 84\)"):
        encoder.encode(whole.replace(obs=whole.obs[0], prev_action=whole.prev_action[0]))


@pytest.mark.parametrize("history", ["none", "gru", "lru"])  # attention cannot reshape zero windows
def test_empty_batches_have_shapes(history):
    encoder, whole = make(history, True), window()
    none = whole.replace(**{name: whole[name][:0] for name in whole})
    assert encoder.encode(none).shape == (0, 9, encoder.dim)


@pytest.mark.parametrize("span", [None, 1, 2, 5, 99])
@pytest.mark.parametrize("layers", [1, 2])
@pytest.mark.parametrize("number", [1, 3])
def test_gru_reads_the_matching_version_of_each_row(number: int, layers: int, span: int | None):
    torch.manual_seed(0)
    gru = GRU(3, GRUOptions(hidden_dim=4, gru_layers=layers))
    versions, length = torch.randn(number, 2, 6, 3), torch.tensor([6, 4])
    out = run_over_versions(gru, list(versions), length, span)
    for b in range(2):
        for j in range(length[b]):
            read = range(j, min(length[b], j + (span or 99)))
            rows = torch.stack([versions[min(row - j, number - 1), b, row] for row in read])
            torch.testing.assert_close(out[b, j], run_memory(gru, rows.flip(0)[None])[0][0, -1])


def test_encoder_folder_round_trip(tmp_path):
    encoder, batch = make("gru", True), window()
    save_encoder(str(tmp_path), encoder, CARD)
    drawn = torch.get_rng_state()
    loaded, card = load_encoder(str(tmp_path), "walker_walk", 2)
    assert torch.equal(torch.get_rng_state(), drawn), "loading must not draw from the global generator"
    assert card == CARD
    with torch.no_grad():
        torch.testing.assert_close(loaded.encode(batch), encoder.encode(batch))
    assert not any(p.requires_grad for p in loaded.parameters())
    assert not any(part.training for part in loaded.modules())


def test_encoder_with_unregistered_corruption_is_rejected(tmp_path):
    save_encoder(tmp_path, Encoder(EncoderConfig(action_dim=6)), replace(CARD, corruption={"corruption": "fog"}))
    with pytest.raises(UserError, match=r"unknown corruption 'fog'.*, or run or import the file") as caught:
        load_encoder(tmp_path)
    assert "again" not in str(caught.value), "it is whole"


def test_removed_options_are_rejected(tmp_path):
    encoder = Encoder(EncoderConfig(action_dim=6))
    save_encoder(tmp_path, encoder, replace(CARD, corruption={"corruption": "patch", "patch_height": 8}))
    with pytest.raises(UserError, match="--patch-height is not read by the corruption patch"):
        load_encoder(tmp_path)
    for changes, message in (
        ({"frame_options": {"depth": 3}}, "frame encoder 'drq' has no option 'depth'"),
        ({"history": "gru", "memory_options": {"depth": 3}}, "memory 'gru' has no option 'depth'"),
    ):
        encoder.config = EncoderConfig(action_dim=6, **changes)
        save_encoder(tmp_path, encoder, CARD)
        with pytest.raises(UserError, match=message):
            load_encoder(tmp_path)


def test_invalid_encoder_folders_are_rejected(tmp_path):
    with pytest.raises(UserError, match="not an encoder folder"):
        load_encoder(tmp_path)
    save_encoder(tmp_path, make("none", False), CARD)
    with pytest.raises(UserError, match="2 action dimensions"):
        load_encoder(tmp_path, action_dim=6)
    with pytest.raises(UserError, match="pretrained on walker_walk, not on cheetah_run"):
        load_encoder(tmp_path, task="cheetah_run")
    with pytest.raises(UserError, match=r"images of 84x84 pixels, the dataset has 50x50"):
        load_encoder(tmp_path, size=50)
    (tmp_path / "model.safetensors").write_bytes(b"damaged")
    with pytest.raises(UserError, match="cannot be read"):
        load_encoder(tmp_path)
    (tmp_path / "model.safetensors").rename(tmp_path / "model.pt")
    with pytest.raises(UserError, match="pickle"):
        load_encoder(tmp_path)
    config = json.loads((tmp_path / "config.json").read_text())
    config["encoder"]["unknown"] = 1
    (tmp_path / "model.pt").unlink()
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(UserError, match="unknown"):
        load_encoder(tmp_path)


@pytest.mark.parametrize(
    ("part", "field", "value"),
    [("encoder", "hidden_dim", "64"), ("encoder", "size", 2), ("pretrain", "corruption", {"fog": 1})],
)
def test_invalid_encoder_cards_are_rejected(tmp_path, part, field, value):
    save_encoder(tmp_path, make("gru", False), CARD)
    config = json.loads((tmp_path / "config.json").read_text())
    config[part][field] = value
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(UserError, match=r"(describes no|not an) encoder"):
        load_encoder(tmp_path)
    (tmp_path / "config.json").write_bytes(b"\x80\x04")
    with pytest.raises(UserError, match="not an encoder folder"):
        load_encoder(tmp_path)


def test_span_beyond_the_window_is_clipped():
    gru, x, length = GRU(3, GRUOptions(hidden_dim=4)), torch.rand(2, 7, 3), torch.tensor([7, 5])
    whole, read = run_over_next(gru, x, length, 7), []
    gru.register_forward_hook(lambda module, given, out: read.append(given[0].shape[1]))
    assert torch.equal(run_over_next(gru, x, length, 10**9), whole)
    assert read == [7]

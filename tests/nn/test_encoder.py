import json
from dataclasses import replace

import pytest
import torch

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.types import Windows
from vd4rl_pomdp.nn import Encoder, EncoderCard, EncoderConfig, load_encoder, save_encoder
from vd4rl_pomdp.nn.memory import GRU, GRUOptions, run_backward, run_memory, run_over_next, run_over_versions

CARD = EncoderCard("mik+a", "walker_walk", "expert", {"corruption": "none"}, 0, 10, "smoke")


def make(history: str, use_actions: bool, span: int = 0, layers: int = 1) -> Encoder:
    torch.manual_seed(0)
    told = {} if history == "none" else {"gru_layers": layers}
    config = EncoderConfig(2, "nature", 16, history, use_actions, 12, span, memory_options=told)
    return Encoder(config).eval()


def window(rows: int = 9, batch: int = 2) -> Windows:
    g = torch.Generator().manual_seed(1)
    action = torch.rand(batch, rows, 2, generator=g)
    return Windows(
        obs=torch.randint(0, 256, (batch, rows, 9, 84, 84), generator=g, dtype=torch.uint8),
        prev_action=torch.cat([torch.zeros(batch, 1, 2), action[:, :-1]], 1),
        action=action,
        has_action=torch.ones(batch, rows, dtype=torch.bool),
        length=torch.full((batch,), rows),
        key=torch.zeros(batch, rows, dtype=torch.int64),
    )


@pytest.mark.parametrize(
    ("history", "use_actions", "span", "layers"),
    [("none", False, 0, 1), ("gru", False, 0, 1), ("gru", True, 0, 2), ("gru", True, 4, 1), ("gru", False, 3, 2)],
)
def test_streaming_and_batch_encodings_agree(history: str, use_actions: bool, span: int, layers: int):
    encoder, batch = make(history, use_actions, span, layers), window()
    with torch.no_grad():
        whole = encoder.encode(batch)
        state = encoder.initial_state(2)
        for t in range(9):
            z, state = encoder.step(batch.obs[:, t], batch.prev_action[:, t], state)
            torch.testing.assert_close(z, whole[:, t], atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"history": "GRU"}, "unknown memory 'GRU': choose one of gru"),
        ({"readout": "state+frame"}, r"unknown readout 'state\+frame': choose one of state, frame, frame\+state"),
    ],
)
def test_what_would_be_another_encoder_is_refused(changes, message):
    with pytest.raises(UserError, match=message):
        Encoder(EncoderConfig(6, **changes))


def test_observations_of_another_shape_are_refused():
    encoder, other = make("gru", True), window()
    for obs in (other.obs[..., :64, :64], other.obs[:, :, :3]):
        with pytest.raises(UserError, match=r"reads observations of shape \(9, 84, 84\), not \("):
            encoder.encode(other.replace(obs=obs))
        with pytest.raises(UserError, match="pretrain an encoder on these"):
            encoder.step(obs[:, 0], other.prev_action[:, 0], encoder.initial_state(len(obs)))


@pytest.mark.parametrize("span", [0, 3])
def test_a_readout_is_the_frame_the_state_or_both_in_streams_and_batches(span: int):
    batch, read = window(), {}
    for readout in ("frame", "state", "frame+state"):
        encoder = make("gru", True, span)
        encoder.config = replace(encoder.config, readout=readout)
        with torch.no_grad():
            read[readout], state = encoder.encode(batch), encoder.initial_state(2)
            assert read[readout].shape == (2, 9, encoder.dim)
            for t in range(9):
                z, state = encoder.step(batch.obs[:, t], batch.prev_action[:, t], state)
                torch.testing.assert_close(z, read[readout][:, t], atol=1e-5, rtol=1e-4)
            torch.testing.assert_close(encoder.frame(batch.obs), read["frame"])
    assert torch.equal(read["frame+state"], torch.cat([read["frame"], read["state"]], dim=-1))


def test_a_history_window_forgets_what_is_before_it_and_only_that():
    encoder, batch = make("gru", True, span=3), window()
    changed = batch.replace(obs=batch.obs.clone(), prev_action=batch.prev_action.clone())
    changed.obs[:, 4], changed.prev_action[:, 5] = 0, 9.0
    with torch.no_grad():
        moved = (encoder.encode(batch) - encoder.encode(changed)).abs().amax((0, 2)) > 1e-6
    # row 4's frame reaches rows 4..6; a_4 (row 5) reaches rows 5 and 6: in row 7 it would come from the first row
    assert moved.tolist() == [False] * 4 + [True, True, True] + [False] * 2


def test_the_backward_gru_starts_at_each_windows_last_real_row():
    torch.manual_seed(0)
    gru = GRU(3, GRUOptions(hidden_dim=4))
    x, length = torch.randn(2, 6, 3), torch.tensor([6, 4])
    out = run_backward(gru, x, length)
    for b in range(2):
        alone, _ = run_memory(gru, x[b : b + 1, : length[b]].flip(1))
        torch.testing.assert_close(out[b, : length[b]], alone[0].flip(0))


@pytest.mark.parametrize("span", [None, 1, 2, 5, 99])
@pytest.mark.parametrize("layers", [1, 2])
@pytest.mark.parametrize("number", [1, 3])
def test_a_state_reads_its_own_version_of_each_row(number: int, layers: int, span: int | None):
    torch.manual_seed(0)
    gru = GRU(3, GRUOptions(hidden_dim=4, gru_layers=layers))
    versions, length = torch.randn(number, 2, 6, 3), torch.tensor([6, 4])
    out = run_over_versions(gru, list(versions), length, span)
    for b in range(2):
        for j in range(length[b]):
            read = range(j, min(length[b], j + (span or 99)))
            rows = torch.stack([versions[min(row - j, number - 1), b, row] for row in read])
            torch.testing.assert_close(out[b, j], run_memory(gru, rows.flip(0)[None])[0][0, -1])


def test_an_encoder_folder_gives_back_the_same_encoder(tmp_path):
    encoder, batch = make("gru", True), window()
    save_encoder(str(tmp_path), encoder, CARD)
    drawn = torch.get_rng_state()
    loaded, card = load_encoder(str(tmp_path), "walker_walk", 2)
    assert torch.equal(torch.get_rng_state(), drawn), "loading draws nothing from the caller's generator"
    assert card == CARD
    with torch.no_grad():
        torch.testing.assert_close(loaded.encode(batch), encoder.encode(batch))
    assert not any(p.requires_grad for p in loaded.parameters())


def test_an_encoder_of_a_corruption_whose_file_was_not_run_says_so(tmp_path):
    save_encoder(tmp_path, Encoder(EncoderConfig(action_dim=6)), replace(CARD, corruption={"corruption": "fog"}))
    with pytest.raises(
        UserError, match=r"unknown corruption 'fog'.*, or run or import the file that registers it\); correct"
    ):
        load_encoder(tmp_path)


def test_an_option_that_its_part_has_lost_is_no_default(tmp_path):
    encoder = Encoder(EncoderConfig(action_dim=6))
    save_encoder(tmp_path, encoder, replace(CARD, corruption={"corruption": "patch", "patch_height": 8}))
    with pytest.raises(UserError, match="--patch-height is not read by the corruption patch"):
        load_encoder(tmp_path)
    for changes, told in (
        ({"frame_options": {"depth": 3}}, "frame encoder 'drq' has no option 'depth'"),
        ({"history": "gru", "memory_options": {"depth": 3}}, "memory 'gru' has no option 'depth'"),
    ):
        encoder.config = EncoderConfig(action_dim=6, **changes)
        save_encoder(tmp_path, encoder, CARD)
        with pytest.raises(UserError, match=told):
            load_encoder(tmp_path)


def test_bad_encoder_folders_are_refused_in_one_line(tmp_path):
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
def test_an_encoder_card_of_nonsense_is_one_line(tmp_path, part, field, value):
    save_encoder(tmp_path, make("gru", False), CARD)
    config = json.loads((tmp_path / "config.json").read_text())
    config[part][field] = value
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(UserError, match=r"(describes no|not an) encoder") as caught:
        load_encoder(tmp_path)
    assert "\n" not in str(caught.value)
    (tmp_path / "config.json").write_bytes(b"\x80\x04")
    with pytest.raises(UserError, match="not an encoder folder"):
        load_encoder(tmp_path)


def test_a_span_beyond_the_window_costs_no_more_than_the_window():
    gru, x, length = GRU(3, GRUOptions(hidden_dim=4)), torch.rand(2, 7, 3), torch.tensor([7, 5])
    whole, read = run_over_next(gru, x, length, 7), []
    gru.register_forward_hook(lambda module, given, out: read.append(given[0].shape[1]))
    assert torch.equal(run_over_next(gru, x, length, 10**9), whole)
    assert read == [7]

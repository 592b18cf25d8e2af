"""The transformer and the linear recurrence against loops over rows that follow their papers' equations."""

import math

import pytest
import torch
from torch.nn.functional import gelu, layer_norm, silu, softmax

from pretrain.config import PretrainConfig
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.nn.memories.lru import scan
from vd4rl_pomdp.nn.memory import MEMORIES, make_memory, run_memory

ROWS, WINDOW = 11, 4


def made(name, **options):
    """A small memory in float64 with perturbed weights, and input rows."""
    torch.manual_seed(0)
    memory = make_memory(name, 5, {"hidden_dim": 16} | options).double().requires_grad_(False)
    for value in memory.parameters():
        value.add_(0.2 * torch.randn_like(value))
    return memory, torch.randn(3, ROWS, 5, dtype=torch.float64)


def norm(x, layer):
    return layer_norm(x, x.shape[-1:], layer.weight, layer.bias)


def attend(layer, bias, x):
    """(T, D) -> (T, D) attention, one row and head at a time."""
    width, out = layer.width // layer.heads, []
    q, k, v = layer.qkv(norm(x, layer.norm)).split(layer.width, dim=1)
    for i in range(len(x)):
        first, parts = max(0, i - WINDOW + 1), []
        for head in range(layer.heads):
            mine = slice(head * width, (head + 1) * width)
            scores = [
                q[i, mine] @ k[j, mine] / math.sqrt(width) + bias[head, WINDOW - 1 - (i - j)]
                for j in range(first, i + 1)
            ]
            parts.append(softmax(torch.stack(scores), 0) @ v[first : i + 1, mine])
        out.append(torch.cat(parts))
    return layer.out(torch.stack(out))


def test_transformer_matches_its_equations():
    memory, rows = made("transformer", attention_window=WINDOW)
    for window, found in zip(rows, run_memory(memory, rows)[0], strict=True):
        x = memory.read(window)
        for layer, bias in zip(memory.layers, memory.bias, strict=True):
            x = x + attend(layer, bias, x)
            x = x + layer.mlp_out(silu(layer.mlp_in(norm(x, layer.mlp_norm))))
        torch.testing.assert_close(found, norm(x, memory.norm))


def test_linear_recurrent_units_match_their_equations():
    memory, rows = made("lru")
    for window, found in zip(rows, run_memory(memory, rows)[0], strict=True):
        x = memory.read(window)
        for i, layer in enumerate(memory.layers):
            u = norm(x, layer.norm)
            decay = torch.exp(torch.complex(-memory.nu[i].exp(), memory.theta[i].exp()))
            b = torch.complex(layer.b.weight[0::2], layer.b.weight[1::2])
            c = torch.complex(layer.c.weight[:, 0::2], -layer.c.weight[:, 1::2])
            h, y = torch.zeros(len(decay), dtype=b.dtype), []
            for row in u:
                h = decay * h + memory.gamma[i].exp() * (b @ row.to(b.dtype))
                y.append(gelu((c @ h).real + layer.d * row))
            x = x + torch.stack(y) * torch.sigmoid(layer.gate(torch.stack(y)))
        torch.testing.assert_close(found, norm(x, memory.norm))


@pytest.mark.parametrize(("name", "options"), [("transformer", {"attention_window": WINDOW}), ("lru", {})])
@pytest.mark.parametrize("cuts", [[5, 6], [1] * ROWS, [1, 8, 2], [9, 1, 1]], ids=str)
def test_memory_over_parts_equals_whole_window(name, options, cuts):
    memory, rows = made(name, **options)
    whole, after = run_memory(memory, rows)
    state, read = memory.initial_state(3), []
    for part in rows.split(cuts, dim=1):
        out, state = run_memory(memory, part, state)
        read.append(out)
    torch.testing.assert_close(torch.cat(read, dim=1), whole)
    torch.testing.assert_close(state, after)


@pytest.mark.parametrize("layers", [1, 3])
def test_transformer_reach_grows_with_layers(layers):
    memory, rows = made("transformer", attention_window=3, transformer_layers=layers)
    assert memory.reach == 2 * layers + 1
    out, _ = run_memory(memory, rows)
    late, _ = run_memory(memory, rows[:, 2:])
    same = (out[:, 2:] - late).abs().amax((0, 2)) < 1e-12
    assert same.tolist() == [t >= 2 * layers for t in range(ROWS - 2)], "positions in the window do not matter"


def test_scan_matches_the_recurrence_and_its_gradients():
    g = torch.Generator().manual_seed(0)
    for rows in (1, 2, 7, 8):
        decay, inputs, before = (
            torch.view_as_complex(torch.rand(*shape, 2, generator=g, dtype=torch.float64) / 2).requires_grad_()
            for shape in ((3,), (2, rows, 3), (2, 3))
        )
        torch.autograd.gradcheck(scan, (decay, inputs, before))
        h, states = before, []
        for row in inputs.unbind(1):
            h = decay * h + row
            states.append(h)
        torch.testing.assert_close(scan(decay, inputs, before), torch.stack(states, 1))
    slow = torch.tensor([0.9999 + 0j, 1e-3 + 0j])
    states = scan(slow, torch.ones(1, 1001, 2, dtype=torch.complex64), torch.zeros(1, 2, dtype=torch.complex64))
    torch.testing.assert_close(
        states[0, -1].real, torch.tensor([(1 - 0.9999**1001) / 1e-4, 1 / (1 - 1e-3)]), rtol=1e-4, atol=0
    )


def test_linear_units_are_initialised_on_their_ring():
    torch.manual_seed(0)
    memory = make_memory("lru", 5, {"r_min": 0.9, "r_max": 0.99, "max_phase": 0.5, "lru_units": 2000})
    decay, phase = (-memory.nu.detach().exp()).exp(), memory.theta.detach().exp()
    assert 0.9 <= decay.min() < 0.901 < 0.989 < decay.max() <= 0.99
    assert 0 < phase.min() < 0.01 < 0.49 < phase.max() <= 0.5
    torch.testing.assert_close((decay**2).mean(), torch.tensor((0.9**2 + 0.99**2) / 2), atol=2e-3, rtol=0)
    # unit white noise has the stationary variance gamma^2 / (1 - |lambda|^2)
    variance = (2 * memory.gamma.detach()).exp() / (1 - decay**2)
    torch.testing.assert_close(variance, torch.ones_like(variance), atol=1e-4, rtol=0)


@pytest.mark.parametrize("inputs", [256, 262, 263])
def test_memories_of_equal_width_have_similar_size(inputs):
    """Default width; inputs e(o_t), with six action dimensions, and with MIK's flag."""
    counts = {name: sum(p.numel() for p in make_memory(name, inputs, {}).parameters()) for name in MEMORIES}
    assert counts == {name: pytest.approx(counts["gru"], rel=0.01) for name in MEMORIES}


@pytest.mark.parametrize("name", ["gru", "transformer", "lru"])
def test_memories_have_no_data_dependent_control_flow(name):
    """Meta tensors have no values; captured steps rely on this."""
    memory = make_memory(name, 5, {"hidden_dim": 16}).to("meta")
    out, after = memory(torch.empty(2, 40, 5, device="meta"), memory.initial_state(2))
    assert (out.shape, after.shape) == ((2, 40, 16), memory.initial_state(2).shape)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"history": "lru", "r_min": 0.9, "r_max": 0.5}, "--r-min is 0.9, --r-max 0.5: choose a greater --r-max"),
        ({"history": "lru", "lru_units": 0}, "lru-units"),
        ({"history": "transformer", "attention_window": 1}, "attention-window"),
    ],
)
def test_invalid_memory_options_are_rejected(settings, message):
    with pytest.raises(UserError, match=message):
        PretrainConfig.of("smoke", **settings).check()

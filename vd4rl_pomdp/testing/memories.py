"""Conformance checks of memories: shapes, streaming, causality, padding, saving and loading."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from pretrain.config import PretrainConfig
from pretrain.train import build_objective, build_target
from vd4rl_pomdp.core.options import check_options
from vd4rl_pomdp.core.tasks import EPISODE_TRANSITIONS
from vd4rl_pomdp.core.types import Windows, previous
from vd4rl_pomdp.nn.encoder import Encoder
from vd4rl_pomdp.nn.memory import Memory, make_memory, run_backward, run_memory
from vd4rl_pomdp.testing.contract import (
    Check,
    claim,
    claim_close,
    claim_gradients,
    reloaded,
    run_checks,
    streamed,
    weighted_sum,
)

BATCH, ROWS, INPUTS = 3, 6, 5
_WIDTH = 7
_METHODS = ({"method": "mik+a"}, {"method": "mik"}, {"method": "mik+a", "m": 2}, {"method": "mik", "m": 2})
"""Methods with and without actions, over the whole past and over three rows."""


def check_memory(name: str, **options: Any) -> None:
    """Run all checks on a memory of `vd4rl_pomdp.nn.memory.MEMORIES`."""
    check_options(PretrainConfig.of("smoke", history=name, **options))
    run_checks("memory", CHECKS, name, **options)


def make(name: str, **options: Any) -> Memory:
    """The memory for rows of INPUTS numbers, of which the last two are an action; identical at every call."""
    torch.manual_seed(0)
    return make_memory(name, INPUTS, {"hidden_dim": _WIDTH} | options, INPUTS - 2)


def encoder_of(name: str, **settings: Any) -> Encoder:
    """An encoder with the memory, for observations of three numbers; identical at every call."""
    settings = {"frame_encoder": "flat", "action_target": "mse", "hidden_dim": _WIDTH} | settings
    config = PretrainConfig.of("smoke", history=name, **settings)
    torch.manual_seed(0)
    return build_objective(config, 2, build_target(config, torch.zeros(1, 2).numpy()), None, (3, 1)).encoder.eval()


def rows(count: int = ROWS) -> Tensor:
    """Random rows (BATCH, count, INPUTS); identical at every call."""
    return torch.randn(BATCH, count, INPUTS, generator=torch.Generator().manual_seed(0))


def windows() -> Windows:
    """Random windows of ROWS rows without padding; identical at every call."""
    g = torch.Generator().manual_seed(1)
    obs = torch.randint(0, 256, (BATCH, ROWS, 3, 1, 1), generator=g, dtype=torch.uint8)
    action = torch.rand(BATCH, ROWS, 2, generator=g)
    real, length = torch.ones(BATCH, ROWS, dtype=torch.bool), torch.full((BATCH,), ROWS)
    return Windows(obs, previous(action), action, real, length, torch.zeros(BATCH, ROWS, dtype=torch.int64))


def equal_rows_give_equal_outputs(name: str, **options: Any) -> None:
    """A memory's outputs are deterministic, in train and eval mode."""
    memory = make(name, **options)
    for training in (True, False):
        with torch.no_grad():
            first, second = (run_memory(memory.train(training), rows())[0] for _ in range(2))
        claim(torch.equal(first, second), f"they differ between calls, training {training}")


def outputs_have_one_shape(name: str, **options: Any) -> None:
    """Memories map rows (B, T, I) to finite (B, T, hidden_dim) in the dtype of the weights, also under bf16
    autocast."""
    memory = make(name, **options)
    before, width = memory.initial_state(BATCH), ({"hidden_dim": _WIDTH} | options)["hidden_dim"]
    claim(before.dim() == 3 and before.shape[1] == BATCH, f"its initial state is {tuple(before.shape)}, not (L, B, W)")
    claim(not before.any(), "its initial state is not zero")
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        out, after = run_memory(memory, rows())
    found = tuple(out.shape), out.dtype
    claim(found == ((BATCH, ROWS, width), torch.float32), f"{found[0]} {found[1]}")
    claim(out.isfinite().all(), "some are not finite")
    claim(after.shape == before.shape, f"its state is {tuple(before.shape)} before and {tuple(after.shape)} after")


def streaming_equals_batch(name: str, **options: Any) -> None:
    """Encoding row by row equals encoding whole windows, with and without actions, for full and three-row histories,
    and over an episode's rows."""
    for method in _METHODS:
        encoder, window = encoder_of(name, **method, **options), windows()
        with torch.no_grad():
            claim_close(streamed(encoder, window), encoder.encode(window), f"they differ for {method}", 1e-5)
    memory, long = make(name, **options).eval(), rows(EPISODE_TRANSITIONS + 1)
    with torch.no_grad():
        whole, state, streams = run_memory(memory, long)[0], memory.initial_state(BATCH), []
        for row in long.split(1, 1):
            out, state = memory(row, state)
            streams.append(out)
    claim_close(torch.cat(streams, 1), whole, f"they differ over {EPISODE_TRANSITIONS + 1} rows", 1e-4)


def a_state_depends_only_on_its_past(name: str, **options: Any) -> None:
    """An output depends on its own row and on earlier rows of its window only.

    For a memory with a `reach`, on that many rows at most.
    """
    # in float64, so that small gradients across many rows do not underflow
    memory, x = make(name, **options).double(), rows().double().requires_grad_()
    out, _ = run_memory(memory, x)
    for t in range(ROWS):
        (gradient,) = torch.autograd.grad(weighted_sum(out[1, t]), x, retain_graph=True)
        reached = [tuple(place) for place in torch.nonzero(gradient.abs().amax(2)).tolist()]
        first = max(0, t + 1 - (memory.reach or ROWS))
        past = {(1, row) for row in range(first, t + 1)}
        found = f"row {t} of window 1 has gradients to (window, row) {reached}"
        claim(past.issuperset(reached), f"{found}: only rows {first} to {t} of window 1 may have one")
        claim((1, t) in reached and (t == 0 or len(reached) > 1), f"{found}: itself and an earlier row must have one")


def actions_are_read_where_a_method_has_them(name: str, **options: Any) -> None:
    """s_t depends on all actions before row t for "+a" methods, and on no action for others."""
    for method, reads in (("mik+a", True), ("mik", False)):
        encoder, window = encoder_of(name, method=method, **options), windows()
        changed = window.prev_action.clone()
        changed[:, 2] += 1
        with torch.no_grad():
            moved = encoder.encode(window) != encoder.encode(window.replace(prev_action=changed))
        claim(
            moved.any(2).any(0).tolist() == [reads and t >= 2 for t in range(ROWS)],
            f"a_1 moves rows {moved.any(2).any(0).tolist()} of {method}",
        )


def observations_are_read_where_it_says(name: str, **options: Any) -> None:
    """s_t depends on o_t (with `first_only`, on o_0 alone) and never on later observations."""
    for method in ("mik+a", "mik"):
        encoder, window = encoder_of(name, method=method, **options), windows()
        memory = encoder.memory
        assert memory is not None
        for row in range(ROWS):
            changed = window.obs.clone()
            changed[:, row] = 255 - changed[:, row]
            with torch.no_grad():  # not `encode`, which skips later features if `first_only`
                features = (encoder.frame(obs) for obs in (window.obs, changed))
                plain, other = (encoder.from_features(one, window.prev_action) for one in features)
            moved = plain != other
            rows = moved.any(2).any(0).tolist()
            right = rows == [row == 0] * ROWS if memory.first_only else rows[row] and not any(rows[:row])
            claim(right, f"o_{row} moves rows {rows} of {method}")


def padding_is_not_read(name: str, **options: Any) -> None:
    """Run backwards, as for MIK's future encoder, padding does not change the outputs."""
    memory, x, length = make(name, **options), rows(), torch.tensor([ROWS, 4, 1])
    with torch.no_grad():
        padded = run_backward(memory, x, length)
        for b, real in enumerate(length.tolist()):
            alone = run_memory(memory, x[b : b + 1, :real].flip(1))[0][0].flip(0)
            claim_close(padded[b, :real], alone, f"a window of {real} rows differs", 1e-5)


def gradients_reach_all_parameters(name: str, **options: Any) -> None:
    """A loss on the outputs has a gradient to every parameter."""
    memory = make(name, **options)
    weighted_sum(run_memory(memory, rows())[0]).backward()
    claim_gradients(memory.named_parameters())


def a_folder_gives_back_the_encoder(name: str, **options: Any) -> None:
    """The seed determines the weights; saving and loading an encoder preserves its states."""
    encoder, window = encoder_of(name, **options), windows()
    with torch.no_grad():
        states = encoder.encode(window)
        claim_close(reloaded(encoder).encode(window), states, "its states differ", 1e-5)
        claim_close(encoder_of(name, **options).encode(window), states, "another build differs", 1e-5)


CHECKS: tuple[Check, ...] = (
    equal_rows_give_equal_outputs,
    outputs_have_one_shape,
    streaming_equals_batch,
    a_state_depends_only_on_its_past,
    actions_are_read_where_a_method_has_them,
    observations_are_read_where_it_says,
    padding_is_not_read,
    gradients_reach_all_parameters,
    a_folder_gives_back_the_encoder,
)

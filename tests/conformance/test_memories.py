"""All memories satisfy the contract of memories; violations are caught."""

import pytest
import torch

from finetune.train import finetune
from pretrain.train import pretrain
from tests.helpers_pages import isolated_registries, load_example
from tests.helpers_stages import smoke_finetune, smoke_pretrain
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.nn.memory import GRU, MEMORIES, GRUOptions, MemoryPart
from vd4rl_pomdp.testing import check_memory, check_method
from vd4rl_pomdp.testing import memories as checks
from vd4rl_pomdp.testing.contract import run_check


@pytest.mark.parametrize("check", checks.CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("gru", {}),
        ("gru", {"gru_layers": 2}),
        ("transformer", {}),
        ("transformer", {"transformer_layers": 3, "transformer_heads": 1, "attention_window": 2}),
        ("integrator", {}),
        ("integrator", {"gru_layers": 2}),
        ("lru", {}),
        ("lru", {"lru_layers": 1, "lru_units": 5, "r_min": 0.9, "r_max": 0.99, "max_phase": 0.3}),
    ],
    ids=str,
)
def test_memory_conforms(check, name, options):
    run_check("memory", check, name, **options)


def test_methods_conform_with_documented_memory(tmp_path, monkeypatch):
    with isolated_registries():
        load_example("my_memory.py", tmp_path, monkeypatch)
        check_method("mik+a", history="linear")
        check_method("fj+a", history="linear")


@pytest.mark.parametrize("history", ["transformer", "lru"])
def test_memories_train_in_all_stages(data, tmp_path, history):
    made = pretrain(smoke_pretrain(data, tmp_path / "pretrained", method="mik+a", history=history, steps=1)).path
    brief = {"updates": 1, "batch_size": 4, "eval_length": 2, "random_histories": 0.5, "precision": "bf16"}
    assert finetune(smoke_finetune(made / "encoder", data, tmp_path / "finetuned", **brief)).finished


class Averaged(GRU):
    """Sees the whole window."""

    def forward(self, rows, state):
        return super().forward(rows - rows.mean(1, keepdim=True), state)


class Short(GRU):
    """Sees more rows than it declares."""

    reach = 2


class Forgetful(GRU):
    """Resets its state in every call."""

    def forward(self, rows, state):
        return super().forward(rows, torch.zeros_like(state))


class Ageing(GRU):
    """Forgets its past every 64 rows of a call: windows do, streams never."""

    def forward(self, rows, state):
        parts = []
        for part in rows.split(64, 1):
            out, end = super().forward(part, state)
            parts.append(out)
        return torch.cat(parts, 1), end


class Peeking(GRU):
    """Declares to read only the first observation, but reads all."""

    first_only = True


class Wide(GRU):
    def forward(self, rows, state):
        out, state = super().forward(rows, state)
        return torch.cat([out, out], -1), state


class Dropping(GRU):
    def forward(self, rows, state):
        return super().forward(torch.nn.functional.dropout(rows, 0.5, self.training), state)


class Unused(GRU):
    def __init__(self, inputs, options):
        super().__init__(inputs, options)
        self.unused = torch.nn.Linear(2, 2)


class Hidden(GRU):
    """Has a weight that is not part of its state."""

    scale = 1.0

    def forward(self, rows, state):
        Hidden.scale += 1
        return super().forward(rows * Hidden.scale, state)


@pytest.mark.parametrize(
    ("kind", "check", "reason"),
    [
        (
            Averaged,
            checks.a_state_depends_only_on_its_past,
            r"row 0 of window 1 has gradients to \(window, row\) \[\(1, 0\), ",
        ),
        (Short, checks.a_state_depends_only_on_its_past, "only rows 1 to 2 of window 1 may have one"),
        (Forgetful, checks.streaming_equals_batch, "they differ for"),
        (Ageing, checks.streaming_equals_batch, "they differ over 501 rows"),
        (Peeking, checks.observations_are_read_where_it_says, "o_1 moves rows"),
        (Wide, checks.outputs_have_one_shape, r"\(3, 6, 14\)"),
        (Dropping, checks.equal_rows_give_equal_outputs, "they differ between calls, training True"),
        (Unused, checks.gradients_reach_all_parameters, "none reaches unused.bias, unused.weight"),
        (Hidden, checks.a_folder_gives_back_the_encoder, "its states differ"),
    ],
)
def test_nonconforming_memories_are_caught(kind, check, reason):
    MEMORIES.register("mine", MemoryPart(kind, GRUOptions))
    with pytest.raises(AssertionError, match=f"memory 'mine' violates its contract(.|\n)*{reason}"):
        run_check("memory", check, "mine")


@pytest.mark.parametrize("name", ["none", "method", "my.memory"])
def test_reserved_memory_names_are_rejected(name):
    with pytest.raises(UserError, match=f"memory '{name}': this name is reserved"):
        MEMORIES.register(name, MemoryPart(GRU, GRUOptions))


def test_invalid_memories_are_rejected():
    MEMORIES.register("mine", MemoryPart(lambda inputs, options: torch.nn.Identity()))
    with pytest.raises(UserError, match=r"memory .mine. builds a Identity, not a vd4rl"):
        check_memory("mine")
    for name in ("frame", "memory", "encode"):
        MEMORIES.register(name, MemoryPart(GRU, GRUOptions))
        with pytest.raises(UserError, match=f"memory '{name}': an encoder has an attribute of this name"):
            check_memory(name)

"""Named random streams: hashed seeds that do not collide."""

from pathlib import Path

import pytest
import torch

from vd4rl_pomdp.core.streams import seed_networks, stream_generator, stream_seed
from vd4rl_pomdp.corruptions import BatchCorruption, CorruptionConfig
from vd4rl_pomdp.nn.draws import Draws

ROOT = Path(__file__).parents[2]
NAMES = [
    *[(stage, part) for stage in ("pretrain", "finetune", "navigation") for part in ("batches", "networks")],
    *[(kind, "finetune", view) for kind in ("corruption", "shift") for view in range(8)],
    *[(kind, stage) for kind in ("corruption", "shift") for stage in ("pretrain", "finetune")],
    ("corruption", "emission"),
    *[("curl", "shift"), ("driml", "k"), ("homer", "gumbel"), ("homer", "imposters"), ("finetune", "noise")],
]


def test_streams_of_names_and_seeds_are_distinct():
    seeds = {stream_seed(seed, *name) for seed in range(50) for name in NAMES}
    assert len(seeds) == 50 * len(NAMES)
    assert all(0 <= seed < 2**63 for seed in seeds)


def test_stream_seeds_are_platform_independent():
    assert stream_seed(0, "pretrain", "batches") == 8177399787921554125
    assert stream_seed(7, "corruption", "finetune", 3) == 4266965685318587072
    assert stream_seed(0, "corruption", 1) != stream_seed(0, "corruption", "1")


def test_generators_and_networks_are_seeded_by_stream():
    drawn = [torch.randint(2**60, (4,), generator=stream_generator(3, "a")).tolist() for _ in range(2)]
    assert drawn[0] == drawn[1]
    weights = []
    for stage in ("pretrain", "finetune", "pretrain"):
        seed_networks(3, stage)
        weights.append(torch.rand(4).tolist())
    assert weights[0] == weights[2] != weights[1]


@pytest.mark.parametrize("name", [("curl", "shift"), ("driml", "k"), ("homer", "imposters")])
def test_objective_draws_differ_from_corruption_draws(name):
    corruption = BatchCorruption(CorruptionConfig.of("patch"), 0, "pretrain")
    assert not set(Draws(0, *name).keys(64).tolist()) & set(corruption.keys(torch.arange(64)).tolist())


def test_only_emission_corrupts_rows_equally_in_all_stages():
    rows = torch.arange(16)
    for mode, same in (("emission", True), ("resample", False)):
        stages = [
            BatchCorruption(CorruptionConfig.of("patch", mode), 5, *name) for name in (["pretrain"], ["finetune", 1])
        ]
        keys = [stage.keys(rows).tolist() for stage in stages]
        assert (keys[0] == keys[1]) == same

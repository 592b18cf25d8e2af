"""Updates of pretraining and fine-tuning: rates, overheads, and what caching features saves.

A set is trained on where it is.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from vd4rl_pomdp.bench.data import BATCH
from vd4rl_pomdp.bench.memory import make_trainer
from vd4rl_pomdp.bench.timing import alternating, seconds_of
from vd4rl_pomdp.core.options import NO_OPTIONS
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import Dataset
from vd4rl_pomdp.nn.encoder import Encoder, EncoderConfig
from vd4rl_pomdp.runs.device import Precision, pick_device

HISTORY_WINDOW = 32


def pretraining(dataset: Dataset, folder: Path, repeats: int) -> dict[str, Any]:
    """Share of a step that the batch (sampling, corruption, shift) and the optimiser take, and bf16 against fp32."""
    from pretrain.config import PretrainConfig

    results: dict[str, Any] = {"device": str(dataset.t.device)}
    steps: dict[str, float] = {}
    for precision in ("fp32", "bf16"):
        given = {"data": folder, "out": folder, "batch_size": 8, "precision": precision}
        config = PretrainConfig.of("paper", corruption="patch+zero_frames", **given)
        trainer = make_trainer(dataset, config)
        steps[precision], batch, optimiser = alternating(
            max(3, repeats // 3), trainer.update, trainer.batches.sample, trainer.optimiser.step
        )
        results[f"{precision}_frames_per_s"] = config.batch_size * config.window / steps[precision]
        results[f"{precision}_overhead_share"] = (batch + optimiser) / steps[precision]
    return results | {"bf16_over_fp32": steps["fp32"] / steps["bf16"]}


def methods(dataset: Dataset, folder: Path, repeats: int) -> dict[str, Any]:
    """Step time and frames/s of every method in the cpu preset, and what K and the resolution cost MIK+A.

    Without those that regress states, which a set of random pictures has not.
    """
    from pretrain.config import PretrainConfig
    from pretrain.objectives import METHODS

    trained = [name for name, method in METHODS.items() if method.trained and not method.regresses_state]
    config = PretrainConfig.of("cpu", data=folder, out=folder, corruption="patch+zero_frames")
    results: dict[str, Any] = {}
    for name in trained:
        trainer = make_trainer(dataset, config.altered(method=name))
        seconds = seconds_of(trainer.update, max(3, repeats // 3))
        frames = config.batch_size * config.window / seconds
        results[name] = {"step_ms": seconds * 1e3, "frames_per_s": frames}
    narrow, wide = (make_trainer(dataset, config.altered(max_k=k)).update for k in (15, 30))
    once, twice = alternating(repeats, narrow, wide)
    encoders = ("nature", "nature_half")
    whole, half = alternating(
        repeats, *(make_trainer(dataset, config.altered(frame_encoder=name)).update for name in encoders)
    )
    return results | {"k_30_over_k_15": twice / once, "half_over_whole_resolution": half / whole}


def finetuning(dataset: Dataset, repeats: int) -> dict[str, float]:
    """Updates on cached features against updates that encode every batch, for both kinds of encoder.

    The history is cut to a window: encoding whole episodes for every batch would take longer still.
    """
    memoryless = EncoderConfig(dataset.action_dim)
    history = replace(memoryless, history="gru", use_actions=True, history_window=HISTORY_WINDOW)
    results = {
        "fp32": _updates_per_s(dataset, memoryless, "fp32", repeats // 3),
        "bf16": _updates_per_s(dataset, memoryless, "bf16", repeats),
        "history_bf16": _updates_per_s(dataset, history, "bf16", 1),
    }
    return {f"{kind}_{name}": value for kind, values in results.items() for name, value in values.items()}


def _updates_per_s(
    dataset: Dataset, encoder_config: EncoderConfig, precision: Precision, repeats: int
) -> dict[str, float]:
    """Rates of many cached updates in a row, as in training, and of as few exact ones as count both kinds of update."""
    from finetune.algorithms import TD3BC
    from finetune.config import FinetuneConfig
    from finetune.features import ExactSampler, FeatureSampler, FrozenEncoder
    from finetune.histories import Histories
    from vd4rl_pomdp.nn.policy import Policy

    config = FinetuneConfig.of("cpu")
    device = dataset.t.device
    encoder = Encoder(encoder_config).eval().to(device)
    corruption = CorruptionConfig.of("patch+zero_frames")
    frozen = FrozenEncoder(encoder, dataset, corruption, config.shift, precision, 0)
    features = torch.randn(1, dataset.num_rows, encoder.dim, dtype=torch.float16, device=device)
    generator = torch.Generator().manual_seed(0)
    policy = Policy(encoder.dim, dataset.action_dim, config.hidden_dim).to(device)
    algorithm = TD3BC(policy, config.options, config.learning_rate, config.updates, generator)  # type: ignore[arg-type]

    def train(sampler: FeatureSampler | ExactSampler, updates: int) -> None:
        for _ in range(updates):
            algorithm.update(sampler.sample())

    cached = FeatureSampler(Histories(dataset, NO_OPTIONS, 3, 0), features, BATCH, 3, 0.99, generator)
    exact = ExactSampler(frozen, NO_OPTIONS, BATCH, 3, 0.99, generator)
    many, few = 20, algorithm.policy_delay
    fast, slow = alternating(max(1, repeats), lambda: train(cached, many), lambda: train(exact, few))
    fast, slow = fast / many, slow / few
    return {"cached_updates_per_s": 1 / fast, "exact_updates_per_s": 1 / slow, "cached_over_exact": slow / fast}


def maze_training() -> dict[str, float]:
    """Steps/s of `navigation train --preset cpu`, and the share of a step that sampling and the optimiser take."""
    from vd4rl_pomdp.studies.navigation.collect import PRESETS as SETS
    from vd4rl_pomdp.studies.navigation.collect import collect
    from vd4rl_pomdp.studies.navigation.config import NavigationConfig
    from vd4rl_pomdp.studies.navigation.data import MazeData, open_maze_set
    from vd4rl_pomdp.studies.navigation.probed import make_trainer

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shape = {"maze": "no_curtain", "out": folder / "set", "workers": 1}
        collect(replace(SETS["smoke"], **shape))  # type: ignore[arg-type]
        config = NavigationConfig.of("cpu", data=folder / "set", out=folder)
        data = MazeData(*open_maze_set(folder / "set", folder / "cache"), config, None)
        trainer, _ = make_trainer(data, config, pick_device("auto"))
    step, sampling, optimiser = alternating(5, trainer.update, trainer.batches.sample, trainer.optimiser.step)
    return {"training_steps_per_s": 1 / step, "training_overhead_share": (sampling + optimiser) / step}

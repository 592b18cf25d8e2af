"""Speed and memory of every stage as ratios measured in one run, so that a noisy machine cannot bend them much."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from vd4rl_pomdp.augmentation import observe
from vd4rl_pomdp.corruptions import BatchCorruption, CorruptionConfig
from vd4rl_pomdp.data import Dataset, open_dataset
from vd4rl_pomdp.data.format import write_shard
from vd4rl_pomdp.envs.dmc import PixelEnv
from vd4rl_pomdp.envs.parity import canary_frames, compare
from vd4rl_pomdp.experiments.bench_memory import make_trainer, memory, touch
from vd4rl_pomdp.mazes import PICTURE_SIZE
from vd4rl_pomdp.nn.encoder import Encoder, EncoderConfig
from vd4rl_pomdp.runs.device import Precision, pick_device
from vd4rl_pomdp.runs.folder import flatten
from vd4rl_pomdp.runs.provenance import machine, versions
from vd4rl_pomdp.runs.workers import run_jobs
from vd4rl_pomdp.tasks import FRAME_SIZE, FRAME_STACK
from vd4rl_pomdp.types import StepType

BATCH = 256
EPISODE_ROWS = 501
HISTORY_WINDOW = 32
ROUNDS = 5
"""Times that two ways of rendering take turns."""
GOALS: dict[str, tuple[str, float]] = {
    "opening.open_seconds": ("<=", 1.0),
    "memory.peak_over_frames": ("<=", 1.3),
    "sampling.gather_speed_over_copy": (">=", 0.5),
    "sampling.corrupt_and_shift_over_gather": ("<=", 2.0),
    "pretraining.fp32_overhead_share": ("<=", 0.2),
    "pretraining.bf16_overhead_share": ("<=", 0.2),
    "pretraining.bf16_over_fp32": (">=", 1.4),
    "methods.k_30_over_k_15": ("<=", 1.25),
    "finetuning.fp32_cached_over_exact": (">=", 20.0),
    "finetuning.bf16_cached_over_exact": (">=", 20.0),
    "finetuning.history_bf16_cached_over_exact": (">=", 20.0),
    "collection.fast_over_exact": (">=", 1.4),
    "collection.fast_mean_difference_of_255": ("<=", 0.05),
    "collection.two_workers_over_one": (">=", 1.8),
    "mazes.fast_over_default": (">=", 5.0),
    "mazes.first_person_over_default": (">=", 5.0),
    "mazes.training_overhead_share": ("<=", 0.2),
}
"""What this package promises on two cores without a GPU."""


def bench(quick: bool = False) -> dict[str, Any]:
    """Run every measurement.

    Args:
        quick: a smaller set and fewer repetitions.

    Returns:
        Nested ratios and rates, with the machine and the versions they were measured on.
    """
    torch.manual_seed(0)
    repeats = 5 if quick else 15
    with tempfile.TemporaryDirectory() as folder:
        dataset, opening = _synthetic_set(Path(folder), 20 if quick else 200)
        results = {
            "opening": opening,
            "sampling": _sampling(dataset, repeats),
            "pretraining": _pretraining(dataset, Path(folder), repeats),
            "finetuning": _finetuning(dataset, repeats),
            "methods": _methods(dataset, Path(folder), repeats),
            "memory": memory(Path(folder), dataset.frames.numel()),
        }
    results["collection"] = _collection(60 if quick else 200)
    results["mazes"] = _mazes(60 if quick else 200)
    return results | {"machine": machine(), "versions": versions()}


def print_table(results: dict[str, Any]) -> None:
    """All measurements on the terminal, those that have a goal with it and a verdict."""
    table = Table(title="speed and memory, ratios within one run")
    table.add_column("measurement")
    for name in ("value", "goal", ""):
        table.add_column(name, justify="right")
    for name, value in flatten(results).items():
        shown = f"{value:.4g}" if isinstance(value, float) else str(value)
        relation, goal = GOALS.get(name, ("", 0.0))
        reached = value <= goal if relation == "<=" else value >= goal if relation else None
        verdict = {True: "[green]reached[/]", False: "[red]missed[/]", None: ""}[reached]
        table.add_row(name, shown, f"{relation} {goal:g}" if relation else "", verdict)
    Console().print(table)


def _seconds(function: Callable[[], Any], repeats: int) -> float:
    """Median seconds of a call, after one that is not counted."""
    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        function()
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return statistics.median(times[1:])


def _alternating(rounds: int, *functions: Callable[[], Any]) -> list[float]:
    """Median seconds of each function, called in turns: a machine that slows down slows all of them."""
    times = [[_seconds(function, 1) for function in functions] for _ in range(rounds)]
    return [statistics.median(column) for column in zip(*times, strict=True)]


def _synthetic_set(folder: Path, episodes: int) -> tuple[Dataset, dict[str, Any]]:
    """Write, decode and open a set of `episodes` full episodes; random stripes compress fast and cost like pixels."""
    rng = np.random.default_rng(0)
    (folder / "set").mkdir()
    for shard in range(0, episodes, 20):
        count = min(20, episodes - shard)
        rows = count * EPISODE_ROWS
        step_type = np.full(rows, int(StepType.MID))
        step_type[::EPISODE_ROWS], step_type[EPISODE_ROWS - 1 :: EPISODE_ROWS] = StepType.FIRST, StepType.LAST
        stripes = rng.integers(0, 256, (rows, 3, FRAME_SIZE, 1), dtype=np.uint8)
        arrays: dict[str, np.ndarray] = {
            "observation": np.broadcast_to(stripes, (rows, 3, FRAME_SIZE, FRAME_SIZE)),
            "action": rng.uniform(-1, 1, (rows, 6)).astype(np.float32),
            "reward": rng.uniform(0, 2, rows),
            "discount": np.ones(rows),
            "step_type": step_type,
        }
        write_shard(folder / "set" / f"{shard // 20}_bench.hdf5", arrays, {})
    start = time.perf_counter()
    open_dataset(folder / "set", folder / "cache")
    decoding = time.perf_counter() - start
    opening = _seconds(lambda: open_dataset(folder / "set", folder / "cache"), 3)
    dataset = open_dataset(folder / "set", folder / "cache")
    return dataset, {"rows": dataset.num_rows, "decode_seconds": decoding, "open_seconds": opening}


def _sampling(dataset: Dataset, repeats: int) -> dict[str, float]:
    """Gathering against copying the same bytes, and what shift and corruption add to it; new rows every time."""
    some = min(dataset.num_transitions, 20_000)
    touch(dataset.frames[:some])
    generator = torch.Generator().manual_seed(0)
    corruptions = {name: BatchCorruption(CorruptionConfig(name), 0) for name in ("patch", "patch+zero_frames")}

    def rows() -> torch.Tensor:
        return torch.randint(3, some - 1, (2 * BATCH,), generator=generator)

    def copy() -> None:
        start = int(rows()[0]) * (some - len(target)) // some
        target.copy_(dataset.frames[start : start + len(target)])

    def see(name: str) -> Callable[[], Any]:
        return lambda: observe(dataset, rows(), torch.arange(2 * BATCH), 4, corruptions[name])

    target = torch.empty(2 * BATCH * FRAME_STACK, *dataset.frames.shape[1:], dtype=torch.uint8)
    copying, gathering, patch, both = _alternating(
        repeats, copy, lambda: dataset.stacks(rows()), see("patch"), see("patch+zero_frames")
    )
    return {
        "copy_ms": copying * 1e3,
        "gather_ms": gathering * 1e3,
        "gather_speed_over_copy": copying / gathering,
        "corrupt_and_shift_over_gather": both / gathering - 1,
        "patch_and_shift_over_gather": patch / gathering - 1,
        "transitions_ms": _seconds(lambda: dataset.transitions(rows(), 3), repeats) * 1e3,
    }


def _pretraining(dataset: Dataset, folder: Path, repeats: int) -> dict[str, Any]:
    """Share of a step that the batch (sampling, corruption, shift) and the optimiser take, and bf16 against fp32."""
    from pretrain.config import PRESETS

    device = pick_device("auto")
    results: dict[str, Any] = {"device": str(device)}
    steps: dict[str, float] = {}
    for precision in ("fp32", "bf16"):
        config = replace(
            PRESETS["paper"], data=folder, out=folder, batch_size=8, corruption="patch+zero_frames", precision=precision
        )
        trainer = make_trainer(dataset, config)
        steps[precision], batch, optimiser = _alternating(
            max(3, repeats // 3), trainer.update, trainer.batch, trainer.optimiser.step
        )
        results[f"{precision}_frames_per_s"] = config.batch_size * config.window / steps[precision]
        results[f"{precision}_overhead_share"] = (batch + optimiser) / steps[precision]
    return results | {"bf16_over_fp32": steps["fp32"] / steps["bf16"]}


def _methods(dataset: Dataset, folder: Path, repeats: int) -> dict[str, Any]:
    """Step time and frames/s of every method in the cpu preset, and what doubling K costs MIK+A."""
    from pretrain.config import PRESETS
    from pretrain.objectives import METHODS

    trained = [name for name, method in METHODS.items() if method.trained]
    config = replace(PRESETS["cpu"], data=folder, out=folder, corruption="patch+zero_frames")
    results: dict[str, Any] = {}
    for name in trained:
        trainer = make_trainer(dataset, replace(config, method=name))
        seconds = _seconds(trainer.update, max(3, repeats // 3))
        frames = config.batch_size * config.window / seconds
        results[name] = {"step_ms": seconds * 1e3, "frames_per_s": frames}
    narrow, wide = (make_trainer(dataset, replace(config, max_k=k)).update for k in (15, 30))
    once, twice = _alternating(repeats, narrow, wide)
    return results | {"k_30_over_k_15": twice / once}


def _finetuning(dataset: Dataset, repeats: int) -> dict[str, float]:
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
    from finetune.config import PRESETS
    from finetune.features import ExactSampler, FeatureSampler, FrozenEncoder
    from vd4rl_pomdp.nn.policy import Policy

    config = PRESETS["cpu"]
    device = dataset.t.device
    encoder = Encoder(encoder_config).eval().to(device)
    corruption = CorruptionConfig("patch+zero_frames")
    frozen = FrozenEncoder(encoder, dataset, corruption, config.shift, precision, 0)
    features = torch.randn(1, dataset.num_rows, encoder.dim, dtype=torch.float16, device=device)
    generator = torch.Generator().manual_seed(0)
    algorithm = TD3BC(Policy(encoder.dim, dataset.action_dim, config.hidden_dim).to(device), config, generator)

    def train(sampler: FeatureSampler | ExactSampler, updates: int) -> None:
        for _ in range(updates):
            algorithm.update(sampler.sample())

    cached = FeatureSampler(dataset, features, BATCH, 3, 0.99, generator)
    exact = ExactSampler(frozen, BATCH, 3, 0.99, generator)
    many, few = 20, algorithm.policy_delay
    fast, slow = _alternating(max(1, repeats), lambda: train(cached, many), lambda: train(exact, few))
    fast, slow = fast / many, slow / few
    return {"cached_updates_per_s": 1 / fast, "exact_updates_per_s": 1 / slow, "cached_over_exact": slow / fast}


def _collection(frames: int) -> dict[str, float]:
    """Frames per CPU-second of the fast rendering against dm_control's default, and two workers against one."""
    rounds = [[_render_speed((render, frames // ROUNDS)) for render in ("exact", "fast")] for _ in range(ROUNDS)]
    exact, fast = (statistics.median(column) for column in zip(*rounds, strict=True))
    difference = compare(canary_frames("walker_walk", "fast"), canary_frames("walker_walk", "exact"))
    alone = frames / next(iter(run_jobs(_render_wall, [("fast", frames)], 1)))
    together = sum(frames / seconds for seconds in run_jobs(_render_wall, [("fast", 4 * frames)] * 2, 2)) * 4
    return {
        "exact_frames_per_cpu_s": exact,
        "fast_frames_per_cpu_s": fast,
        "fast_over_exact": fast / exact,
        "fast_mean_difference_of_255": difference["mean_difference"],
        "two_workers_over_one": together / alone,
    }


def _render_speed(job: tuple[Any, int]) -> float:
    """Frames per CPU-second of one process."""
    env, action = _warm_environment(job[0])
    start = time.process_time()
    for _ in range(job[1]):
        env.step(action)
    return job[1] / (time.process_time() - start)


def _render_wall(job: tuple[Any, int]) -> float:
    """Wall-clock seconds of one job, without the process's start."""
    env, action = _warm_environment(job[0])
    start = time.perf_counter()
    for _ in range(job[1]):
        env.step(action)
    return time.perf_counter() - start


def _warm_environment(render: Any) -> tuple[PixelEnv, np.ndarray]:
    env = PixelEnv("walker_walk", render)
    env.reset(0)
    action = np.zeros(env.task.action_dim, np.float32)
    env.step(action)
    return env, action


def _mazes(frames: int) -> dict[str, float]:
    """Pictures per CPU-second of the mazes, against PointMaze's own `render()` at the same size."""
    import gymnasium

    from vd4rl_pomdp.envs.maze import MazeEnv
    from vd4rl_pomdp.envs.maze_model import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    default: Any = gymnasium.make(
        "PointMaze_UMaze-v3", render_mode="rgb_array", width=PICTURE_SIZE, height=PICTURE_SIZE
    )
    default.reset(seed=0)
    speeds = {"default_frames_per_cpu_s": _rate(default.render, frames)}
    for name, maze, render in (("fast", "no_curtain", "fast"), ("first_person", "first_person", "fast")):
        env = MazeEnv(maze, render=render)  # type: ignore[arg-type]
        env.reset(seed=0, options={"state": np.array([1.0, 1.0] + [0.0] * (4 if maze == "first_person" else 2))})
        speeds[f"{name}_frames_per_cpu_s"] = _rate(env.draw, frames)
    default.close()
    for name in ("fast", "first_person"):
        speeds[f"{name}_over_default"] = speeds[f"{name}_frames_per_cpu_s"] / speeds["default_frames_per_cpu_s"]
    return speeds | _maze_training()


def _maze_training() -> dict[str, float]:
    """Steps/s of `navigation train --preset cpu`, and the share of a step that sampling and the optimiser take."""
    from pretrain.navigation.config import PRESETS
    from pretrain.navigation.data import MazeData
    from pretrain.navigation.trainer import Trainer, make_objective
    from vd4rl_pomdp.experiments.navigation import collect
    from vd4rl_pomdp.experiments.navigation.observations import open_maze_set

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shape = {"maze": "no_curtain", "out": folder / "set", "workers": 1}
        collect.collect(replace(collect.PRESETS["smoke"], **shape))  # type: ignore[arg-type]
        config = replace(PRESETS["cpu"], data=folder / "set", out=folder)
        data = MazeData(*open_maze_set(folder / "set", folder / "cache"), config, None)
        device = pick_device("auto")
        trainer = Trainer(make_objective(data, config).to(device), data.on(device), config)
    step, sampling, optimiser = _alternating(5, trainer.update, trainer.batch, trainer.optimiser.step)
    return {"training_steps_per_s": 1 / step, "training_overhead_share": (sampling + optimiser) / step}


def _rate(function: Callable[[], Any], count: int) -> float:
    """Calls per CPU-second, after some that are not counted."""
    for _ in range(5):
        function()
    start = time.process_time()
    for _ in range(count):
        function()
    return count / (time.process_time() - start)

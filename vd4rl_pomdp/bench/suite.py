"""`vd4rl-pomdp bench`: all measurements, each as a ratio to another one of the same run, and their goals.

Ratios vary less than times on a noisy machine.
"""

from __future__ import annotations

import importlib.util
import itertools
import statistics
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from finetune.algorithms import ALGORITHMS
from finetune.config import FinetuneConfig
from finetune.end_to_end import EndToEnd
from finetune.features import STAGE, ExactSampler, FeatureSampler, FrozenEncoder
from finetune.histories import Histories
from finetune.train import Updates
from pretrain.config import PretrainConfig
from pretrain.objectives import METHODS
from vd4rl_pomdp.bench.processes import JAX_MISSING, apart, make_trainer, memory, sharing, touch
from vd4rl_pomdp.core.hardware import Precision, pick_device
from vd4rl_pomdp.core.options import NO_OPTIONS
from vd4rl_pomdp.core.streams import RandomStream, random_stream
from vd4rl_pomdp.core.tasks import EPISODE_TRANSITIONS, FRAME_SIZE, FRAME_STACK, TASKS
from vd4rl_pomdp.core.types import StepType
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import Dataset, View, open_dataset
from vd4rl_pomdp.data.format import write_shard
from vd4rl_pomdp.data.parity import canary_frames, compare
from vd4rl_pomdp.envs.make import make_env
from vd4rl_pomdp.envs.mazes import PICTURE_SIZE
from vd4rl_pomdp.nn.encoder import Encoder, EncoderConfig
from vd4rl_pomdp.nn.memory import MEMORIES
from vd4rl_pomdp.nn.policy import Policy
from vd4rl_pomdp.runs.files import flatten
from vd4rl_pomdp.runs.provenance import machine, versions
from vd4rl_pomdp.runs.workers import run_jobs
from vd4rl_pomdp.studies.navigation.collect import MazeCollectConfig, collect
from vd4rl_pomdp.studies.navigation.config import NavigationConfig
from vd4rl_pomdp.studies.navigation.train import MazeData
from vd4rl_pomdp.studies.navigation.train import make_trainer as make_maze_trainer

GOALS: dict[str, tuple[str, float]] = {
    "opening.open_seconds": ("<=", 1.0),
    "memory.peak_over_frames": ("<=", 1.25),
    "sampling.gather_speed_over_copy": (">=", 0.5),
    "sampling.corrupt_and_shift_over_gather": ("<=", 2.0),
    "pretraining.fp32_overhead_share": ("<=", 0.2),
    "pretraining.bf16_overhead_share": ("<=", 0.2),
    "pretraining.bf16_over_fp32": (">=", 1.4),
    "methods.k_30_over_k_15": ("<=", 1.25),
    "memories.transformer_step_over_gru": ("<=", 1.3),
    "memories.lru_step_over_gru": ("<=", 1.3),
    "memories.transformer_row_over_gru": ("<=", 1.5),
    "memories.lru_row_over_gru": ("<=", 1.5),
    "memories.integrator_step_over_gru": ("<=", 1.3),
    "memories.integrator_row_over_gru": ("<=", 1.5),
    "finetuning.fp32_cached_over_exact": (">=", 20.0),
    "finetuning.bf16_cached_over_exact": (">=", 20.0),
    "finetuning.history_bf16_cached_over_exact": (">=", 20.0),
    "finetuning.rebrac_over_td3_bc": ("<=", 1.5),
    "jax.units_256_fp32_jax_over_ours": (">=", 1.0),
    "jax.units_256_bf16_jax_over_ours": (">=", 1.0),
    "jax.units_1024_fp32_jax_over_ours": (">=", 1.0),
    "jax.units_1024_bf16_jax_over_ours": (">=", 1.0),
    "collection.fast_over_exact": (">=", 1.4),
    "collection.fast_mean_difference_of_255": ("<=", 0.05),
    "collection.two_workers_over_one": (">=", 1.8),
    "sharing.of_two_over_alone": (">=", 0.45),
    "mazes.fast_over_default": (">=", 5.0),
    "mazes.first_person_over_default": (">=", 5.0),
    "mazes.training_overhead_share": ("<=", 0.2),
}
"""Goals on two cores without a GPU; for bf16 over fp32, where `machine.bf16_kernels` is yes."""


BATCH = 256
EPISODE_ROWS = EPISODE_TRANSITIONS + 1
ROUNDS = 5
"""Alternating repetitions of the two rendering modes."""
HISTORY_WINDOW = 32


def bench(quick: bool = False, device: str = "auto") -> dict[str, Any]:
    """All ratios and rates, nested, with machine and versions; `quick`: smaller dataset and fewer repetitions."""
    place = pick_device(device)
    torch.manual_seed(0)
    repeats = 5 if quick else 15
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        dataset, opening = synthetic_set(folder, 20 if quick else 200)
        results: dict[str, Any] = {"opening": opening, "sampling": sampling(dataset, repeats)}
        dataset.to(place)
        results |= {
            "pretraining": pretraining(dataset, folder, repeats),
            "finetuning": finetuning(dataset, repeats),
            "jax": against_jax(dataset, max(2, repeats // 3)),
            "methods": methods(dataset, folder, repeats),
            "memories": memories(dataset, folder, repeats),
            "memory": memory(folder, dataset.frames.numel()),
        }
    results["collection"] = collection(60 if quick else 200)
    results["sharing"] = sharing(3 if quick else 10)
    results["mazes"] = maze_pictures(60 if quick else 200) | maze_training(place)
    return results | {"machine": machine(device), "versions": versions()}


def print_table(results: dict[str, Any], goals: Mapping[str, tuple[str, float]], title: str) -> None:
    """Print all measurements, with goal and verdict where there is one."""
    if not results.get("machine", {}).get("bf16_kernels", True):
        goals = {name: goal for name, goal in goals.items() if name != "pretraining.bf16_over_fp32"}
    table = Table(title=title)
    table.add_column("measurement")
    for name in ("value", "goal", ""):
        table.add_column(name, justify="right")
    for name, value in flatten(results).items():
        text = f"{value:.4g}" if isinstance(value, float) else str(value)
        relation, goal = goals.get(name, ("", 0.0))
        if relation and float(text) == goal:
            text = str(value)  # do not round a missed goal to the goal
        reached = value <= goal if relation == "<=" else value >= goal if relation else None
        verdict = {True: "[green]reached[/]", False: "[red]missed[/]", None: ""}[reached]
        table.add_row(name, text, f"{relation} {goal:g}" if relation else "", verdict)
    Console().print(table)


def seconds_of(function: Callable[[], Any], repeats: int) -> float:
    """Median seconds per call, after one warm-up call."""
    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        function()
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return statistics.median(times[1:])


def alternating(rounds: int, *functions: Callable[[], Any]) -> list[float]:
    """Median seconds per call of each function; calls alternate, so that a slow phase of the machine hits all of
    them."""
    times = [[seconds_of(function, 1) for function in functions] for _ in range(rounds)]
    return [statistics.median(column) for column in zip(*times, strict=True)]


def rate(function: Callable[[], Any], count: int) -> float:
    """Calls per CPU-second, after a warm-up."""
    for _ in range(5):
        function()
    start = time.process_time()
    for _ in range(count):
        function()
    return count / (time.process_time() - start)


def synthetic_set(folder: Path, episodes: int) -> tuple[Dataset, dict[str, Any]]:
    """Write, decode and open a dataset of full episodes; random stripes compress fast and cost as much as real
    pixels."""
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
    dataset = open_dataset(folder / "set", folder / "cache")
    decoding = time.perf_counter() - start
    opening = seconds_of(lambda: open_dataset(folder / "set", folder / "cache"), 3)
    return dataset, {"rows": dataset.num_rows, "decode_seconds": decoding, "open_seconds": opening}


def sampling(dataset: Dataset, repeats: int) -> dict[str, float]:
    """Gathering frames relative to copying as many bytes, and the added cost of shift and corruption; new rows every
    time."""
    some = min(dataset.num_transitions, 20_000)
    touch(dataset.frames[:some])
    generator = torch.Generator().manual_seed(0)

    def rows() -> torch.Tensor:
        return torch.randint(3, some - 1, (2 * BATCH,), generator=generator)

    def copy() -> None:
        start = int(rows()[0]) * (some - len(target)) // some
        target.copy_(dataset.frames[start : start + len(target)])

    def see(name: str) -> Callable[[], Any]:
        view = View(dataset, CorruptionConfig.of(name), shift=4)
        return lambda: view.observe(rows())

    plain = View(dataset)
    target = torch.empty(2 * BATCH * FRAME_STACK, *dataset.frames.shape[1:], dtype=torch.uint8)
    copying, gathering, patch, both = alternating(
        repeats, copy, lambda: plain.stacks(rows()), see("patch"), see("patch+zero_frames")
    )
    return {
        "copy_ms": copying * 1e3,
        "gather_ms": gathering * 1e3,
        "gather_speed_over_copy": copying / gathering,
        "corrupt_and_shift_over_gather": both / gathering - 1,
        "patch_and_shift_over_gather": patch / gathering - 1,
        "transitions_ms": seconds_of(lambda: plain.transitions(rows(), 3), repeats) * 1e3,
    }


def collection(frames: int) -> dict[str, float]:
    """Frames per CPU-second of fast rendering relative to dm_control's default, and of two workers relative to one."""
    rounds = [[rate(_acting(render), frames // ROUNDS) for render in ("exact", "fast")] for _ in range(ROUNDS)]
    exact, fast = (statistics.median(column) for column in zip(*rounds, strict=True))
    difference = compare(canary_frames("walker_walk", "fast"), canary_frames("walker_walk", "exact"))
    alone = frames / next(iter(run_jobs(_render_wall, [frames], 1)))
    together = sum(frames / seconds for seconds in run_jobs(_render_wall, [4 * frames] * 2, 2)) * 4
    return {
        "exact_frames_per_cpu_s": exact,
        "fast_frames_per_cpu_s": fast,
        "fast_over_exact": fast / exact,
        "fast_mean_difference_of_255": difference["mean_difference"],
        "two_workers_over_one": together / alone,
    }


def _render_wall(frames: int) -> float:
    """Wall-clock seconds of fast rendering, without process start."""
    act = _acting("fast")
    start = time.perf_counter()
    for _ in range(frames):
        act()
    return time.perf_counter() - start


def _acting(render: Any) -> Callable[[], None]:
    """A function that takes one step in a warmed-up environment, and resets it at the end of an episode."""
    env = make_env(TASKS["walker_walk"], render)
    action = np.zeros(env.action_dim, np.float32)
    env.reset(0)

    def act() -> None:
        if env.step(action).last:
            env.reset(0)

    act()
    return act


def maze_pictures(frames: int) -> dict[str, float]:
    """Images per CPU-second of the mazes relative to PointMaze's own `render()` at the same size."""
    from vd4rl_pomdp.envs.maze import MazeEnv, gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    size: dict[str, Any] = {"width": PICTURE_SIZE, "height": PICTURE_SIZE}
    default: Any = gymnasium.make("PointMaze_UMaze-v3", render_mode="rgb_array", **size)
    default.reset(seed=0)
    usual = rate(default.render, frames)
    default.close()
    speeds, ratios = {"default_frames_per_cpu_s": usual}, {}
    for name, maze in (("fast", "no_curtain"), ("first_person", "first_person")):
        env = MazeEnv(maze)
        env.reset(seed=0, options={"state": np.array([1.0, 1.0] + [0.0] * (4 if maze == "first_person" else 2))})
        speeds[f"{name}_frames_per_cpu_s"] = rate(env.draw, frames)
        ratios[f"{name}_over_default"] = speeds[f"{name}_frames_per_cpu_s"] / usual
    return speeds | ratios


def pretraining(dataset: Dataset, folder: Path, repeats: int) -> dict[str, Any]:
    """Fraction of a step spent on the batch (sampling, corruption, shift) and the optimiser, and bf16 relative to
    fp32."""
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


def _pretraining(folder: Path, **settings: Any) -> PretrainConfig:
    return PretrainConfig.of("cpu", data=folder, out=folder, corruption="patch+zero_frames", **settings)


def methods(dataset: Dataset, folder: Path, repeats: int) -> dict[str, Any]:
    """Step time and frames/s of every method in the cpu preset, and how K and the resolution affect MIK+A's step time.

    Methods that regress states are left out: a synthetic dataset has none.
    """
    config = _pretraining(folder)

    def step(**settings: Any) -> Callable[[], Any]:
        return make_trainer(dataset, _pretraining(folder, **settings)).update

    results: dict[str, Any] = {}
    for name in (name for name, method in METHODS.items() if method.trained and not method.regresses_state):
        seconds = seconds_of(step(method=name), max(3, repeats // 3))
        results[name] = {"step_ms": seconds * 1e3, "frames_per_s": config.batch_size * config.window / seconds}
    once, twice = alternating(repeats, step(max_k=15), step(max_k=30))
    whole, half = alternating(repeats, step(frame_encoder="nature"), step(frame_encoder="nature_half"))
    return results | {"k_30_over_k_15": twice / once, "half_over_whole_resolution": half / whole}


def memories(dataset: Dataset, folder: Path, repeats: int) -> dict[str, float]:
    """Pretraining step and streaming row of MIK+A in the cpu preset with each other memory, relative to the GRU."""
    trainers = [make_trainer(dataset, _pretraining(folder, history=name)) for name in MEMORIES]
    obs, action = View(dataset).stacks(torch.tensor([3], device=dataset.t.device)), dataset.action[3:4]

    @torch.no_grad()
    def stream(encoder: Encoder) -> None:
        state = encoder.initial_state(1)
        for _ in range(10):
            _, state = encoder.step(obs, action, state)

    steps = alternating(max(3, repeats // 3), *(trainer.update for trainer in trainers))
    rows = alternating(repeats, *(partial(stream, trainer.objective.encoder) for trainer in trainers))
    gru = list(MEMORIES).index("gru")
    return {
        f"{name}_{what}_over_gru": seconds / times[gru]
        for what, times in (("step", steps), ("row", rows))
        for name, seconds in zip(MEMORIES, times, strict=True)
        if name != "gru"
    }


def finetuning(dataset: Dataset, repeats: int) -> dict[str, float]:
    """Updates/s on cached features and on batches that are encoded each, for both kinds of encoder; cost of ReBRAC.

    The history is cut to a window, since encoding whole episodes per batch would take even longer.
    """
    config, device = _small(), dataset.t.device
    memoryless = EncoderConfig(dataset.action_dim)
    history = replace(memoryless, history="gru", use_actions=True, history_window=HISTORY_WINDOW)
    results: dict[str, float] = {}
    cases: dict[str, tuple[EncoderConfig, Precision, int]] = {
        "fp32": (memoryless, "fp32", max(1, repeats // 3)),
        "bf16": (memoryless, "bf16", repeats),
        "history_bf16": (history, "bf16", 1),
    }
    for kind, (encoder_config, precision, rounds) in cases.items():
        encoder = Encoder(encoder_config).eval().to(device)
        frozen = FrozenEncoder(encoder, dataset, CorruptionConfig.of("patch+zero_frames"), config.shift, precision, 0)
        features = torch.randn(1, dataset.num_rows, encoder.dim, dtype=torch.float16, device=device)
        exact = next_update(config, dataset, encoder.dim, partial(ExactSampler, frozen, NO_OPTIONS, BATCH, 3, 0.99))
        many, few = 20, ALGORITHMS[config.algorithm].period  # a whole period of delayed updates
        updates = repeated(many, on_features(config, dataset, features)), repeated(few, exact)
        fast, slow = alternating(rounds, *updates)
        results |= {f"{kind}_cached_updates_per_s": many / fast, f"{kind}_exact_updates_per_s": few / slow}
        results[f"{kind}_cached_over_exact"] = (slow / few) / (fast / many)
    features = random_features(dataset, 1)
    td3_bc, rebrac = alternating(
        repeats,
        *(repeated(20, on_features(_small(algorithm=name), dataset, features)) for name in ("td3_bc", "rebrac")),
    )
    return results | {"rebrac_over_td3_bc": rebrac / td3_bc}


def against_jax(dataset: Dataset, repeats: int, widths: Sequence[int] = (256, 1024)) -> dict[str, Any]:
    """Milliseconds per TD3+BC update, including sampling, and the time of float32 JAX relative to it."""
    if importlib.util.find_spec("optax") is None:
        return {"jax": JAX_MISSING}
    results: dict[str, Any] = {}
    features = random_features(dataset, FinetuneConfig.of("cpu").views)
    for hidden in widths:
        updates = max(2, 2560 // hidden)
        shape = {"hidden_dim": hidden, "batch_size": BATCH, "dim": features.shape[-1], "rows": dataset.num_rows}
        shape |= {"action_dim": dataset.action_dim, "views": len(features)}
        (theirs,) = apart("vd4rl_pomdp.bench.processes.jax_updates", shape, updates, repeats)
        precisions = ("fp32", "bf16")
        ours = (_small(hidden_dim=hidden, update_precision=precision) for precision in precisions)
        seconds = alternating(repeats, *(repeated(updates, on_features(config, dataset, features)) for config in ours))
        for precision, ms in zip(precisions, (1e3 * one / updates for one in seconds), strict=True):
            name = f"units_{hidden}_{precision}"
            results |= {f"{name}_ms": ms, f"{name}_jax_over_ours": theirs["ms"] / ms}
    return results


def random_features(dataset: Dataset, views: int) -> torch.Tensor:
    """(views, rows, D) float16 on the dataset's device, with the default frame encoder's width."""
    width = EncoderConfig(dataset.action_dim).feature_dim
    return torch.randn(views, dataset.num_rows, width, device=dataset.t.device).half()


def _small(**settings: Any) -> FinetuneConfig:
    return FinetuneConfig.of("cpu", batch_size=BATCH, **settings)


def repeated(count: int, update: Callable[[], Any]) -> Callable[[], None]:
    """A function that makes several updates."""

    def updates() -> None:
        for _ in range(count):
            update()

    return updates


def on_features(
    config: FinetuneConfig, dataset: Dataset, features: torch.Tensor, runs: int = 1
) -> Callable[[], object]:
    """A function that makes one update of a run, or of a stack of runs, on cached (V, N, D) features."""
    histories = Histories(dataset, NO_OPTIONS, 3, 0)
    sampler = partial(FeatureSampler, histories, features, config.batch_size, 3, 0.99)
    return next_update(config, dataset, features.shape[-1], sampler, runs)


def next_update(
    config: FinetuneConfig,
    dataset: Dataset,
    dim: int,
    batches: Callable[[RandomStream], Any],
    runs: int = 1,
    encoder: Encoder | None = None,
) -> Callable[[], object]:
    """A function that makes one training update of a run, or of a stack of `runs`, including sampling.

    `batches` makes a sampler of (B, dim) representations from a random stream; an end-to-end method trains `encoder`.
    """
    device, kind = dataset.t.device, ALGORITHMS.named(config.algorithm)
    algorithms: list[Any] = []
    samplers = []
    for seed in range(runs):
        draws, noise = (random_stream(seed, STAGE, name, device=device) for name in ("batches", "noise"))
        policy = Policy(dim, dataset.action_dim, config.hidden_dim).to(device)
        algorithm = kind(policy, config.options, config.learning_rate, config.updates, noise)
        algorithms.append(algorithm if encoder is None else EndToEnd(algorithm, encoder, config))
        samplers.append(batches(draws))
    updates, made = Updates(algorithms, samplers, config), itertools.count()
    return lambda: updates(next(made))


def maze_training(device: torch.device) -> dict[str, float]:
    """Steps/s of `navigation train --preset cpu`, and the fraction of a step spent on sampling and the optimiser."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        collect(MazeCollectConfig.of("smoke", maze="no_curtain", out=folder / "set", workers=1))
        config = NavigationConfig.of("cpu", data=folder / "set", out=folder)
        trainer, _ = make_maze_trainer(MazeData(config, folder / "cache"), config, device)
    step, sampling, optimiser = alternating(5, trainer.update, trainer.batches.sample, trainer.optimiser.step)
    return {"training_steps_per_s": 1 / step, "training_overhead_share": (sampling + optimiser) / step}

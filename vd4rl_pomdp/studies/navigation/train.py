"""`vd4rl-pomdp navigation train`: train an objective with a state probe on a maze, and measure the probe's errors.

A run folder holds config.json, metrics.jsonl (means over `log_every` steps), encoder/, trajectory.csv and, at the end,
results.json: every number for the report, as rows of (measure, split, probe, rows, k, value).

The probe is an MLP from representations to the standardised true state (x, y, vx, vy). It is trained online beside the
objective, and refitted on frozen representations. Errors are mean absolute errors in two units: percent of a standard
deviation, where predicting the mean gives about 65 to 100, and the simulator's units x 100.
"""

from __future__ import annotations

import math
from collections import defaultdict
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from torch import Tensor, nn

from pretrain.train import Trainer, build_objective, build_target
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.hardware import autocast, pick_device
from vd4rl_pomdp.core.options import flat, settings_of
from vd4rl_pomdp.core.streams import random_stream, seed_networks, stream_generator
from vd4rl_pomdp.core.types import Windows
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import Dataset, View, WindowSampler, open_dataset
from vd4rl_pomdp.data.folder import read_plan
from vd4rl_pomdp.envs.mazes import MAZES, PICTURE_SIZE
from vd4rl_pomdp.nn.encoder import Encoder, EncoderCard
from vd4rl_pomdp.nn.encoder_folder import FILES_OF_RUN, save_encoder
from vd4rl_pomdp.nn.heads import mlp
from vd4rl_pomdp.nn.objective import InverseObjective, Objective
from vd4rl_pomdp.nn.policy import Standardise
from vd4rl_pomdp.runs import METRICS_FILE, NAVIGATION_FILE, TRAJECTORY_FILE
from vd4rl_pomdp.runs.files import replacing_file, write_json
from vd4rl_pomdp.runs.metrics import read_metrics
from vd4rl_pomdp.runs.outputs import refuse_inside
from vd4rl_pomdp.runs.run import RunFolder
from vd4rl_pomdp.studies.navigation.config import NavigationConfig, NoiseOptions
from vd4rl_pomdp.studies.navigation.pictures import SHAPES, ExogenousNoise, source_fingerprint, to_grey50, to_rgb50
from vd4rl_pomdp.studies.navigation.runs import RAW_PREFIX, SUPERVISED, UNTRAINED, Measure

HELD_OUT = 10
"""One in this many trajectories, the last ones, is held out."""


class MazeView(View):
    """Observations of a maze's dataset: one image per row, with the exogenous noise of its key."""

    def __init__(self, dataset: Dataset, noise: ExogenousNoise | None) -> None:
        super().__init__(dataset, frame_stack=1)
        self._noise = noise

    def observe(self, rows: Tensor, shift_key: Tensor | None = None) -> Tensor:
        """Observations (N, ..., 3, 100, 100) uint8 of (N, ...) int64 rows."""
        pictures = super().observe(rows, shift_key)
        if self._noise is None:
            return pictures
        noisy = self._noise(pictures.flatten(0, -4), self.dataset.keys(rows).flatten())
        return noisy.view(pictures.shape)


class MazeData:
    """Batches of a maze's dataset: the last tenth of the trajectories is held out, the others are for training."""

    def __init__(self, config: NavigationConfig, cache: Path | None = None) -> None:
        """Open the config's dataset, with its exogenous noise, on the CPU; UserError if it does not fit."""
        dataset, again = open_dataset(config.data, cache), "collect a dataset with `vd4rl-pomdp navigation collect`"
        names = {stored.get("task") for stored in dataset.store.meta["attributes"]}
        lengths = dataset.episode_end - dataset.episode_start
        single = f"trajectory {int(lengths.argmin())} is a single row, without a step"
        without = f"`vd4rl-pomdp data import vd4rl {config.data} NEW --shortest 2`"
        for wrong, what in (
            (len(names) != 1 or not names <= set(MAZES), f"names no maze; {again}"),
            (dataset.frame_size != PICTURE_SIZE, f"has frames of {dataset.frame_size} pixels, mazes of 100; {again}"),
            (dataset.physics is None, f"holds no true states ('physics'), which the probe needs; {again}"),
            (len(lengths) < 2, "a single trajectory leaves none to hold out; collect more --trajectories"),
            (lengths.min() < 2, f"{single}; leave it out: {without}"),
        ):
            if wrong:
                raise UserError(f"{config.data}: {what}")
        self.dataset, self.maze, self._config = dataset, MAZES[names.pop()], config
        self.first_held_out = dataset.num_episodes - max(1, dataset.num_episodes // HELD_OUT)
        split = int(dataset.episode_start[self.first_held_out])
        assert dataset.physics is not None
        raw = torch.from_numpy(dataset.physics[:, self.maze.position + self.maze.velocity])
        std, mean = torch.std_mean(raw[:split], dim=0)
        self.states, self.mean, self.std = ((raw - mean) / std).float(), mean.float(), std.float()
        """(N, 4) float32 states of all rows, standardised by mean and std (4,) of the training rows."""
        self.hidden = torch.from_numpy(self.maze.hidden(dataset.physics))
        """(N,) bool: a curtain covers the whole mass."""
        rows = dataset.transition_rows
        self.training_actions = dataset.action_after(rows[rows < split])
        """(M, 2) float32."""
        self.total = dataset.num_windows(config.window)
        self.training = int(dataset.windows_per_episode(config.window)[: self.first_held_out].sum())
        """Windows 0..training-1 are for training, the others are held out."""
        self.inputs = {"data": dataset.fingerprint}
        """Fingerprints of a run's inputs by name."""
        noise = None
        if isinstance(config.noise, NoiseOptions):
            noise = ExogenousNoise(config.exogenous, config.noise.exogenous_weight, config.seed)
            self.inputs["exogenous"] = source_fingerprint(config.exogenous)
        self.view: View = MazeView(dataset, noise)

    def on(self, device: torch.device) -> MazeData:
        """Prepare the observations and move everything to a device."""
        if self._config.picture != "rgb100":  # shrunk once, so that training never touches the large images
            shrink = {"grey50": to_grey50, "rgb50": to_rgb50}[self._config.picture]
            channels, size = SHAPES[self._config.picture]
            small = torch.empty(self.dataset.num_rows, channels, size, size, dtype=torch.uint8)
            for rows in torch.arange(self.dataset.num_rows).split(1000):
                small[rows] = shrink(self.view.observe(rows))
            self.dataset.frames, self.view = small, View(self.dataset, frame_stack=1)
        self.dataset.to(device)
        for name in ("states", "hidden", "mean", "std"):
            setattr(self, name, getattr(self, name).to(device))
        return self

    def windows(self, number: Tensor, length: int | None = None) -> Windows:
        """Windows by (B,) numbers, as observed by the model."""
        return self.view.windows(number, length or self._config.window)

    def spread(self, count: int, held_out: bool) -> list[Tensor]:
        """Numbers of `count` windows, evenly spaced over the training or held-out ones, in batches."""
        first, last = (self.training, self.total) if held_out else (0, self.training)
        numbers = torch.linspace(first, last - 1, min(count, last - first)).long()
        return list(numbers.split(self._config.batch_size))


STATE_DIM = 4
COMPONENTS = {"state": slice(0, 4), "position": slice(0, 2), "velocity": slice(2, 4)}


class StateProbe(nn.Module):
    """MLP with two hidden layers of 256 units: (..., D) representations -> (..., 4) states."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.standardise = Standardise(dim)
        self.net = mlp(dim, 256, STATE_DIM, layers=2)

    def forward(self, z: Tensor, frozen: bool = True) -> Tensor:
        """Estimated states; if `frozen`, without gradient to the representation."""
        return self.net(self.standardise(z.detach() if frozen else z))


class ErrorSums(nn.Module):
    """Buffers with sums and counts of absolute errors: over all rows and over hidden ones."""

    sums: Tensor
    counts: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("sums", torch.zeros(2, STATE_DIM, dtype=torch.float64))
        self.register_buffer("counts", torch.zeros(2, dtype=torch.float64))

    def add(self, estimate: Tensor, truth: Tensor, hidden: Tensor, burn_in: int) -> None:
        """Add the errors of (B, T, 4) estimates without GPU synchronisation; rows before `burn_in` are left out."""
        error = (estimate.detach().float() - truth)[:, burn_in:].abs().flatten(0, 1)
        under = hidden[:, burn_in:].flatten()
        weights = torch.stack([torch.ones_like(under), under]).to(error)
        self.to(error.device)
        # in place, for CUDA graphs
        self.sums.add_((weights @ error).double())
        self.counts.add_(weights.sum(1).double())

    def both(self, std: Tensor) -> dict[str, float]:
        """`state`, `position`, `velocity` in percent of `std` (4,); with suffix `_hidden` if a counted row was hidden;
        and all of them with RAW_PREFIX in the simulator's units x 100."""
        sums, counts = self.sums.cpu(), self.counts.cpu()
        return {
            f"{unit}{name}{suffix}": float((100 * scale * sums[number] / counts[number])[part].mean())
            for unit, scale in (("", torch.ones(STATE_DIM)), (RAW_PREFIX, std.cpu()))
            for number, suffix in enumerate(("", "_hidden"))
            if counts[number]
            for name, part in COMPONENTS.items()
        }


def refit(features: Tensor, truth: Tensor, steps: int, seed: int) -> StateProbe:
    """Fit a probe on frozen (N, D) representations and their (N, 4) states."""
    seed_networks(seed, "refit")
    probe = StateProbe(features.shape[1]).to(features.device)
    probe.standardise.fit(features)
    optimiser = torch.optim.Adam(probe.parameters(), lr=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    generator = stream_generator(seed, "refit", "batches")
    for _ in range(steps):
        rows = torch.randint(len(features), (1024,), generator=generator).to(features.device, non_blocking=True)
        loss = (probe(features[rows]) - truth[rows]).square().mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        schedule.step()
    return probe.eval()


STAGE = "navigation"


class ProbedObjective(Objective):
    """An objective with a detached probe; a supervised reference is trained by the probe's error only."""

    def __init__(self, data: MazeData, config: NavigationConfig) -> None:
        """Build on the CPU, where `data` is."""
        super().__init__()
        trained = config.trained()
        target = build_target(trained, data.training_actions.numpy())
        objective = build_objective(trained, data.training_actions.shape[1], target, observation=SHAPES[config.picture])
        assert isinstance(objective, InverseObjective)
        self.objective, self.probe, self.errors = objective, StateProbe(objective.encoder.dim), ErrorSums()
        self.data, self.config = data, config

    @property
    def encoder(self) -> Encoder:  # type: ignore[override]
        """The objective's encoder."""
        return self.objective.encoder

    @property
    def device(self) -> torch.device:
        """Device of the parameters."""
        return next(self.parameters()).device

    def loss(self, window: Windows, progress: float | Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of objective and probe on one batch; errors accumulate until `take_errors`."""
        loss, logs, states = self.measured(window, progress)
        with torch.autocast(self.device.type, enabled=False):
            self.errors.add(*states, self.config.burn_in)
        return loss, logs

    def measured(
        self, window: Windows, progress: float | Tensor
    ) -> tuple[Tensor, dict[str, Tensor], tuple[Tensor, Tensor, Tensor]]:
        """Loss and logs of one batch, and its estimated states, true states and hidden mask; frames are encoded
        once, if the method adds nothing to `loss`."""
        past, future = self.objective.representations(window)
        rows = self.data.dataset.rows(window.key)
        supervised = self.config.method in SUPERVISED
        estimate, truth = self.probe(past, frozen=not supervised), self.data.states[rows]
        error = (estimate.float() - truth).square().mean()
        states = (estimate, truth, self.data.hidden[rows])
        if supervised:
            return error, {"loss": error.detach()}, states
        if type(self.objective).loss is InverseObjective.loss:
            loss, logs = self.objective.loss_of(past, future, window, progress)
        else:  # it trains more than `loss_of` gives, and encodes the frames again
            loss, logs = self.objective.loss(window, progress)
        return loss + error, logs | {"probe_loss": error.detach()}, states

    def after_step(self) -> None:
        """Call the objective's."""
        self.objective.after_step()

    def take_errors(self) -> dict[str, float]:
        """Mean errors since the last call."""
        found = self.errors.both(self.data.std)
        self.errors.sums.zero_()
        self.errors.counts.zero_()
        return found


class MazeBatches(WindowSampler):
    """Uniformly drawn training windows of a maze's dataset."""

    def __init__(self, data: MazeData, config: NavigationConfig) -> None:
        draws = random_stream(config.seed, STAGE, "batches", device=data.dataset.t.device)
        super().__init__(data.view, config.batch_size, config.window, draws)
        self._count = data.training


def make_trainer(data: MazeData, config: NavigationConfig, device: torch.device) -> tuple[Trainer, ProbedObjective]:
    """The trainer of a config and its objective; the data is moved to the device."""
    seed_networks(config.seed, STAGE)
    probed = ProbedObjective(data, config).to(device)
    return Trainer(probed, MazeBatches(data.on(device), config), config, partial(learning_rate, config)), probed


def learning_rate(config: NavigationConfig, step: int) -> float:
    """Adam's learning rate at a step, counted from 0."""
    rising = min(1.0, (step + 1) / config.warm_up) if config.warm_up else 1.0
    fraction = max(0, step - config.warm_up) / max(1, config.steps - config.warm_up)
    falling = (1 + math.cos(math.pi * fraction)) / 2 if config.schedule == "cosine" else 1.0
    # without the factor, two of three seeds of a supervised reference predict the mean
    return config.learning_rate * rising * falling * (0.5 if config.method in SUPERVISED else 1.0)


TRAJECTORY_ROWS = 200
"""Rows of the held-out trajectory saved for a figure."""


def train(config: NavigationConfig) -> RunFolder:
    """Run or resume the stage; returns the run's folder."""
    config.check()
    refuse_inside(config.out)
    data = MazeData(config)
    trainer, probed = make_trainer(data, config, pick_device(config.device))
    labels, results = {"method": config.method, "task": data.maze.name}, [NAVIGATION_FILE, TRAJECTORY_FILE]
    with RunFolder(
        config.out, STAGE, config, data.inputs, (*results, *FILES_OF_RUN), collection=read_plan(config.data)
    ) as run:
        if not run.finished:
            steps, last_averaged = 0 if config.method == UNTRAINED else config.steps, config.steps - config.average_last
            title = f"{data.maze.name} {config.method}"
            trainer.run(run, steps, title, labels, probed.take_errors, last_averaged)
            trained, frames = run.seconds, trainer.step * config.batch_size * config.window
            probe, rows = measure(probed, run.path / METRICS_FILE)
            write_trajectory(run.path / TRAJECTORY_FILE, probed, probe)
            card = EncoderCard(
                method=config.method,
                task=data.maze.name,
                quality=data.maze.driver,
                corruption=flat(CorruptionConfig()),
                seed=config.seed,
                steps=trainer.step,
                preset=config.preset,
                data=data.dataset.fingerprint,
                settings=settings_of(run.config),
            )
            save_encoder(run.path / "encoder", probed.encoder, card, frames)
            found = {"maze": data.maze.name, "set": data.dataset.fingerprint, "rows": rows}
            write_json(run.path / NAVIGATION_FILE, found)
            seconds = {"seconds": round(trained, 2), "total_seconds": round(run.seconds, 2)}
            run.finish(steps=trainer.step, frames=frames, **seconds)
    return run


@torch.no_grad()
def evaluate(probed: ProbedObjective) -> tuple[dict[str, float], dict[str, float]]:
    """Action losses and online probe errors on held-out windows."""
    sums: dict[str, float] = defaultdict(float)
    errors, count = ErrorSums(), 0
    probed.objective.eval()
    for number in probed.data.spread(probed.config.evaluation_windows, held_out=True):
        with autocast(probed.device, probed.config.precision):
            _, logs, states = probed.measured(probed.data.windows(number), 1.0)
        errors.add(*states, probed.config.burn_in)
        count += len(number)
        for name, value in logs.items():
            sums[name] += float(value) * len(number)
    return {name: value / count for name, value in sums.items()}, errors.both(probed.data.std)


@torch.no_grad()
def encode(probed: ProbedObjective, number: Tensor, length: int | None = None) -> tuple[Tensor, Tensor]:
    """Frozen representations (B, T, D) float32 of windows, and their rows (B, T)."""
    window = probed.data.windows(number, length)
    with autocast(probed.device, probed.config.precision):
        return probed.encoder.encode(window).float(), probed.data.dataset.rows(window.key)


def refitted_errors(probed: ProbedObjective) -> tuple[StateProbe, dict[str, dict[str, float]]]:
    """A probe fitted on frozen representations of training windows, and its errors by split."""
    config, data = probed.config, probed.data
    probed.objective.eval()
    parts = [encode(probed, number) for number in data.spread(config.refit_windows, held_out=False)]
    features, rows = (torch.cat([part[i][:, config.burn_in :].flatten(0, 1) for part in parts]) for i in (0, 1))
    probe = refit(features, data.states[rows], config.refit_steps, config.seed)
    found = {}
    for split, held_out in (("training", False), ("held_out", True)):
        errors = ErrorSums()
        for number in data.spread(config.evaluation_windows, held_out):
            past, at = encode(probed, number)
            errors.add(probe(past), data.states[at], data.hidden[at], config.burn_in)
        found[split] = errors.both(data.std)
    return probe, found


def measure(probed: ProbedObjective, log: Path) -> tuple[StateProbe, list[dict[str, Any]]]:
    """The refitted probe, and all rows of `results.json`; `log` is the run's metrics.jsonl.

    Action losses are in nats x 100, as in the paper's table; k = 0 is the mean over all pairs.
    """
    probe, refitted = refitted_errors(probed)
    found = [(split, "refit", errors) for split, errors in refitted.items()]
    if probed.config.method != UNTRAINED:  # neither its online probe nor its action head was trained
        losses, online = evaluate(probed)
        # means over the last `average_last` steps, in which each logged row counts by its steps
        sums, counts = defaultdict[str, float](float), defaultdict[str, float](float)
        before: float = max(0, probed.config.steps - probed.config.average_last)
        for row in read_metrics(log):
            if row["step"] > before:
                for name, value in row.items():
                    sums[name] += value * (row["step"] - before)
                    counts[name] += row["step"] - before
                before = row["step"]
        averages = {name: total / counts[name] for name, total in sums.items()}
        found += [("held_out", "online", online), ("training", "online", averages)]
        if "action_loss" in losses:
            found += [("training", "", averages), ("held_out", "", losses)]
    values: dict[Measure, float] = {}
    for split, estimator, logs in found:
        for name, value in logs.items():
            error, rows = name.removesuffix("_hidden"), "hidden" if name.endswith("_hidden") else "all"
            if estimator and error.removeprefix(RAW_PREFIX) in COMPONENTS:
                values[Measure(f"{error}_error", split, estimator, rows)] = value
        if not estimator:
            by_k = {0: logs["action_loss"]} | {int(n[6:]): loss for n, loss in logs.items() if n.startswith("loss_k")}
            values |= {Measure("action_loss", split, "", k=k): 100 * loss for k, loss in by_k.items()}
    return probe, [measure._asdict() | {"value": value} for measure, value in values.items()]


def write_trajectory(path: Path, probed: ProbedObjective, probe: StateProbe) -> None:
    """Write true and estimated states of the first held-out trajectory, encoded as one sequence."""
    data, dataset = probed.data, probed.data.dataset
    length = min(TRAJECTORY_ROWS, int((dataset.episode_end - dataset.episode_start).min()))
    first = int(dataset.windows_per_episode(length)[: data.first_held_out].sum())
    past, rows = encode(probed, torch.tensor([first]), length)
    estimate, truth = ((z * data.std + data.mean).cpu() for z in (probe(past)[0].detach(), data.states[rows[0]]))
    names = ["x", "y", "vx", "vy", *(f"estimated_{name}" for name in ("x", "y", "vx", "vy"))]
    table = pd.DataFrame(torch.cat([truth, estimate], 1).double().numpy(), columns=names)
    table["hidden"] = data.hidden[rows[0]].int().cpu()
    with replacing_file(path) as fresh:
        table.to_csv(fresh, index_label="t", float_format="%.5f", lineterminator="\r\n")

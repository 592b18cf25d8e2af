"""Train an objective on a maze beside a state probe, and measure what it knows; resumable to the bit on a CPU.

A run folder holds config.json, metrics.jsonl (means over `log_every` steps), encoder/, trajectory.csv and, at its end,
results.json: every number the report needs, as rows of (measure, split, probe, rows, k, value).
"""

from __future__ import annotations

import csv
import json
import math
import shlex
from collections import defaultdict
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pretrain.navigation.config import NavigationConfig, command_of
from pretrain.navigation.probe import ErrorSums, StateProbe, TrueStates, refit
from pretrain.objectives import build_objective, get_method
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import Dataset
from vd4rl_pomdp.errors import MAX_SEED, UserError, refuse_outside
from vd4rl_pomdp.experiments.navigation.exogenous import ExogenousNoise
from vd4rl_pomdp.experiments.navigation.observations import SHAPES, observe, open_maze_set, shrink
from vd4rl_pomdp.mazes import MazeSpec
from vd4rl_pomdp.nn.action_target import make_action_target
from vd4rl_pomdp.nn.folder import EncoderCard, save_encoder
from vd4rl_pomdp.objective import InverseObjective
from vd4rl_pomdp.runs.checkpoint import restore_checkpoint, save_checkpoint, seed_everything
from vd4rl_pomdp.runs.device import autocast, pick_device
from vd4rl_pomdp.runs.folder import RunFolder, jsonable, write_json
from vd4rl_pomdp.runs.metrics import MetricsLog
from vd4rl_pomdp.runs.progress import ProgressLine
from vd4rl_pomdp.types import Windows

STAGE = "navigation"
UNTRAINED = "random"
METHOD_NAMES = ("no_history", "ah", "ah+a", "fj", "fj+a", "mik", "mik+a", UNTRAINED)
"""The paper's objectives, and the floor."""
_UNTRAINED_IS = "mik+a"
HELD_OUT = 10
"""One in this many trajectories, the last ones, is never trained on."""
TRAJECTORY_ROWS = 200
"""Rows of the held-out trajectory whose estimated states are kept for a figure."""
_BATCH_STREAM, _NOISE_STREAM = 1, 2


def train(config: NavigationConfig) -> RunFolder:
    """Run the stage, or go on with it; returns the run's folder."""
    _check(config)
    noise = None
    if config.exogenous != "none":
        noise = ExogenousNoise(config.exogenous, config.exogenous_weight, config.seed * 10 + _NOISE_STREAM)
    data = MazeData(*open_maze_set(config.data), config, noise)
    seed_everything(config.seed)
    objective = make_objective(data, config)
    run = RunFolder(config.out, STAGE, config)
    if run.finished:
        return run
    device = pick_device(config.device)
    trainer = Trainer(objective.to(device), data.on(device), config)
    trainer.run(run, 0 if config.method == UNTRAINED else config.steps)
    _conclude(run, trainer, data)
    return run


class MazeData:
    """Batches of a maze's set: the first trajectories are for training, the last tenth is held out."""

    def __init__(
        self, dataset: Dataset, maze: MazeSpec, config: NavigationConfig, noise: ExogenousNoise | None
    ) -> None:
        self.dataset, self.maze, self._config, self._noise = dataset, maze, config, noise
        held_out = max(1, dataset.num_episodes // HELD_OUT)
        self.first_held_out = dataset.num_episodes - held_out
        split = int(dataset.episode_start[self.first_held_out])
        self.states = TrueStates.of(dataset, maze, split)
        self.training_actions = dataset.action[:split][dataset.t[:split] > 0]
        """(M, 2) float32."""
        windows = (dataset.episode_end - dataset.episode_start - config.window + 1).clamp(min=0)
        self.total = dataset.num_windows(config.window)
        self.training = int(windows[: self.first_held_out].sum())
        """Windows 0..training-1 are for training, the rest is held out."""
        self._stored = config.picture == "rgb100"

    def on(self, device: torch.device) -> MazeData:
        """Prepare the observations and move everything to a device."""
        if not self._stored:
            shrink(self.dataset, self._config.picture, self._noise)
        self.dataset.to(device)
        self.states = self.states.to(device)
        return self

    def windows(self, number: Tensor, length: int | None = None) -> Windows:
        """Windows by (B,) numbers, as the model sees them."""
        window = self.dataset.windows(number, length or self._config.window, 1)
        if self._stored and self._noise is not None:
            obs = observe(window.obs.flatten(0, 1), window.key.flatten(), self._config.picture, self._noise)
            window = window.replace(obs=obs.view(window.obs.shape))
        return window

    def spread(self, count: int, held_out: bool) -> list[Tensor]:
        """Numbers of `count` windows, evenly spread over the training or the held-out ones, in batches."""
        first, last = (self.training, self.total) if held_out else (0, self.training)
        numbers = torch.linspace(first, last - 1, min(count, last - first)).long()
        return list(numbers.split(self._config.batch_size))


class Trainer:
    """One objective and its probe on one maze's data."""

    def __init__(self, objective: InverseObjective, data: MazeData, config: NavigationConfig) -> None:
        self.objective, self.data, self.config = objective, data, config
        self.probe = StateProbe(objective.encoder.dim).to(next(objective.parameters()).device)
        self.device = next(objective.parameters()).device
        self.generator = torch.Generator().manual_seed(config.seed * 10 + _BATCH_STREAM)
        parameters = [*objective.parameters(), *self.probe.parameters()]
        self.optimiser = torch.optim.Adam(parameters, lr=config.learning_rate)
        self.step, self.seconds = 0, 0.0

    def batch(self) -> Windows:
        """The next training windows."""
        number = torch.randint(self.data.training, (self.config.batch_size,), generator=self.generator)
        return self.data.windows(number)

    def update(self) -> tuple[dict[str, Tensor], tuple[Tensor, Tensor, Tensor]]:
        """One gradient step; returns scalars, and (estimated, true, hidden) states."""
        window = self.batch()
        with autocast(self.device, self.config.precision):
            loss, logs, states = self.losses(window)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate(self.config, self.step)
        self.optimiser.step()
        self.objective.after_step()
        self.step += 1
        return logs, states

    def losses(self, window: Windows) -> tuple[Tensor, dict[str, Tensor], tuple[Tensor, Tensor, Tensor]]:
        """Objective's and probe's loss of one batch, whose frames are encoded once."""
        past, future = self.objective.representations(window)
        loss, logs = self.objective.loss_of(past, future, window, self.step / max(1, self.config.steps))
        rows = self.data.states.rows(window)
        estimate, truth = self.probe(past), self.data.states.values[rows]
        error = (estimate.float() - truth).square().mean()
        logs["probe_loss"] = error.detach()
        return loss + error, logs, (estimate, truth, self.data.states.hidden[rows])

    def run(self, run: RunFolder, steps: int) -> None:
        """Train up to `steps`, from the newest checkpoint if there is one."""
        restore_checkpoint(run.checkpoint, self._restore)
        before = self.seconds
        log = MetricsLog(run.path / "metrics.jsonl", self.step, self.config.wandb, jsonable(asdict(self.config)))
        with ProgressLine(f"{self.data.maze.name} {self.config.method}", steps, "steps", self.step) as progress:
            while self.step < steps:
                count = min(self.config.log_every, steps - self.step)
                row = self._interval(count)
                log.write(self.step, row)
                progress.advance(count, loss=row["loss"], state_error=row["state"])
                if self.step % self.config.checkpoint_every == 0 or self.step == steps:
                    self.seconds = run.seconds(before)
                    save_checkpoint(run.checkpoint, self._state())
        self.seconds = run.seconds(before)
        log.close()

    def _interval(self, count: int) -> dict[str, float]:
        """Means over the next `count` steps."""
        sums: dict[str, Tensor | float] = defaultdict(float)
        errors = ErrorSums()
        for _ in range(count):
            logs, states = self.update()
            errors.add(*states, self.config.burn_in)
            for name, value in logs.items():
                sums[name] = sums[name] + value
        return {name: float(value) / count for name, value in sums.items()} | errors.percent()

    def _state(self) -> dict[str, Any]:
        return {
            "step": self.step,
            "seconds": self.seconds,
            "objective": self.objective.state_dict(),
            "probe": self.probe.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "batches": self.generator.get_state(),
        }

    def _restore(self, state: dict[str, Any]) -> None:
        self.step, self.seconds = state["step"], state["seconds"]
        self.objective.load_state_dict(state["objective"])
        self.probe.load_state_dict(state["probe"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.generator.set_state(state["batches"])


def learning_rate(config: NavigationConfig, step: int) -> float:
    """Adam's learning rate of a step, the first being 0."""
    rising = min(1.0, (step + 1) / config.warm_up) if config.warm_up else 1.0
    share = max(0, step - config.warm_up) / max(1, config.steps - config.warm_up)
    falling = (1 + math.cos(math.pi * share)) / 2 if config.schedule == "cosine" else 1.0
    return config.learning_rate * rising * falling


@torch.no_grad()
def evaluate(trainer: Trainer) -> tuple[dict[str, float], dict[str, float]]:
    """Action losses, and errors of the probe as trained, on held-out windows."""
    sums: dict[str, float] = defaultdict(float)
    errors, count = ErrorSums(), 0
    trainer.objective.eval()
    for number in trainer.data.spread(trainer.config.evaluation_windows, held_out=True):
        with autocast(trainer.device, trainer.config.precision):
            _, logs, states = trainer.losses(trainer.data.windows(number))
        errors.add(*states, trainer.config.burn_in)
        count += len(number)
        for name, value in logs.items():
            sums[name] += float(value) * len(number)
    return {name: value / count for name, value in sums.items()}, errors.percent()


@torch.no_grad()
def encode(trainer: Trainer, number: Tensor, length: int | None = None) -> tuple[Tensor, Tensor]:
    """Frozen states (B, T, D) float32 of windows, and their rows (B, T)."""
    window = trainer.data.windows(number, length)
    with autocast(trainer.device, trainer.config.precision):
        return trainer.objective.encoder.encode(window).float(), trainer.data.states.rows(window)


def refitted_errors(trainer: Trainer) -> tuple[StateProbe, dict[str, dict[str, float]]]:
    """A probe fitted on frozen states of training windows, and its errors by split."""
    config, states = trainer.config, trainer.data.states
    trainer.objective.eval()
    parts = [encode(trainer, number) for number in trainer.data.spread(config.refit_windows, held_out=False)]
    features, rows = (torch.cat([part[i][:, config.burn_in :].flatten(0, 1) for part in parts]) for i in (0, 1))
    probe = refit(features, states.values[rows], config.refit_steps, config.seed)
    found = {}
    for split, held_out in (("training", False), ("held_out", True)):
        errors = ErrorSums()
        for number in trainer.data.spread(config.evaluation_windows, held_out):
            past, at = encode(trainer, number)
            errors.add(probe(past), states.values[at], states.hidden[at], config.burn_in)
        found[split] = errors.percent()
    return probe, found


def _conclude(run: RunFolder, trainer: Trainer, data: MazeData) -> None:
    """Measure, and write what is kept of a run."""
    config = trainer.config
    losses, online = evaluate(trainer)
    probe, refitted = refitted_errors(trainer)
    rows = _error_rows("held_out", "online", online)
    for split, errors in refitted.items():
        rows += _error_rows(split, "refit", errors)
    averages = _training_averages(run.path / "metrics.jsonl", config)
    if config.method == UNTRAINED:  # its online probe and its action head were never trained
        rows = [row for row in rows if row["probe"] == "refit"]
    else:
        rows += _error_rows("training", "online", averages)
        rows += _loss_rows("training", averages) + _loss_rows("held_out", losses)
    _write_trajectory(run.path / "trajectory.csv", trainer, probe)
    card = EncoderCard(
        method=config.method,
        task=data.maze.name,
        quality="planner",
        corruption=asdict(CorruptionConfig("none")),
        seed=config.seed,
        steps=trainer.step,
        preset=config.preset,
    )
    save_encoder(run.path / "encoder", trainer.objective.encoder, card)
    record = {"maze": data.maze.name, "set": data.dataset.fingerprint, "command": shlex.join(command_of(config))}
    write_json(run.path / "results.json", record | {"rows": rows})
    frames = trainer.step * config.batch_size * config.window
    run.finish(trainer.seconds, steps=trainer.step, frames=frames, total_seconds=round(run.seconds(0.0), 2))


def _error_rows(split: str, probe: str, errors: dict[str, float]) -> list[dict[str, Any]]:
    named = [name for name in errors if name.removesuffix("_hidden") in ("state", "position", "velocity")]
    return [
        {
            "measure": f"{name.removesuffix('_hidden')}_error",
            "split": split,
            "probe": probe,
            "rows": "hidden" if name.endswith("_hidden") else "all",
            "k": 0,
            "value": errors[name],
        }
        for name in named
    ]


def _loss_rows(split: str, logs: dict[str, float]) -> list[dict[str, Any]]:
    """Action losses in nats x 100, as in the paper's table: k = 0 stands for the mean over all pairs."""
    by_k = {0: logs["action_loss"]} | {int(n[6:]): v for n, v in logs.items() if n.startswith("loss_k")}
    common = {"measure": "action_loss", "split": split, "probe": "", "rows": "all"}
    return [common | {"k": k, "value": 100 * value} for k, value in by_k.items()]


def _training_averages(path: Path, config: NavigationConfig) -> dict[str, float]:
    """Means of the logged intervals that end in the last `average_last` steps."""
    logged = [json.loads(line) for line in path.read_text().splitlines()]
    last = [row for row in logged if row["step"] > config.steps - config.average_last]
    values: dict[str, list[float]] = defaultdict(list)
    for row in last:
        for name, value in row.items():
            values[name].append(value)
    return {name: sum(numbers) / len(numbers) for name, numbers in values.items()}


def _write_trajectory(path: Path, trainer: Trainer, probe: StateProbe) -> None:
    """True and estimated states of the first held-out trajectory, read as one stream."""
    dataset, states = trainer.data.dataset, trainer.data.states
    start = int(dataset.episode_start[trainer.data.first_held_out])
    length = min(TRAJECTORY_ROWS, int((dataset.episode_end - dataset.episode_start).min()))
    past, rows = encode(trainer, torch.tensor([_window_at(dataset, start, length)]), length)
    estimate = (probe(past)[0].detach() * states.std + states.mean).cpu()
    truth = (states.values[rows[0]] * states.std + states.mean).cpu()
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        names = ("x", "y", "vx", "vy")
        writer.writerow(["t", *names, *(f"estimated_{name}" for name in names), "hidden"])
        for t, hidden in enumerate(states.hidden[rows[0]].tolist()):
            numbers = [*truth[t].tolist(), *estimate[t].tolist()]
            writer.writerow([t, *(f"{number:.5f}" for number in numbers), int(hidden)])


def _window_at(dataset: Dataset, row: int, length: int) -> int:
    """Number of the window of `length` rows that begins at a row."""
    episode = int(dataset.episode[row])
    per_episode = (dataset.episode_end - dataset.episode_start - length + 1).clamp(min=0)
    return int(per_episode[:episode].sum()) + int(dataset.t[row])


def make_objective(data: MazeData, config: NavigationConfig) -> InverseObjective:
    """The objective of a config on a maze's data, on the CPU."""
    method = _UNTRAINED_IS if config.method == UNTRAINED else config.method
    target = make_action_target(config.action_target, data.training_actions.numpy(), config.codes, config.seed)
    objective = build_objective(
        config.objective_config(method), data.training_actions, target, observation=SHAPES[config.picture]
    )
    if not isinstance(objective, InverseObjective):
        raise UserError(f"{method} predicts no actions: choose one of {', '.join(METHOD_NAMES)}")
    return objective


def _check(config: NavigationConfig) -> None:
    """Refuse settings that cannot work, before anything is read or written."""
    get_method(config.method)
    refuse_outside(
        config, seed=(0, MAX_SEED), steps=1, batch_size=1, window=2, max_k=1, codes=1, m=0, n=0, burn_in=0,
        average_last=1, log_every=1, checkpoint_every=1, evaluation_windows=1, refit_windows=1, refit_steps=1,
    )  # fmt: skip
    if config.picture not in SHAPES:
        raise UserError(f"unknown picture {config.picture!r}: choose one of {', '.join(SHAPES)}")
    if config.literal_future and config.method != "mik+a":
        raise UserError(f"--literal-future is for mik+a, not for {config.method}: leave it out or change --method")
    if config.burn_in >= config.window:
        raise UserError(f"--burn-in {config.burn_in} leaves no row of a window of {config.window}: lower it")
    if config.checkpoint_every % config.log_every:
        raise UserError(
            f"--checkpoint-every {config.checkpoint_every} is no multiple of --log-every {config.log_every}: change one"
        )

"""`vd4rl-pomdp pretrain`: train an encoder with a method on a data set, under a corruption.

`Trainer` is the training loop; pixels, states and mazes all use it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pretrain.config import HiddenOptions, PretrainConfig, TrainingConfig, history_of
from pretrain.objectives import METHODS
from pretrain.objectives.untrained import StateOptions
from vd4rl_pomdp.core.errors import UserError, refuse_outside
from vd4rl_pomdp.core.hardware import autocast, pick_device, set_products, warn_of_busy_cores, warn_of_slow_bf16
from vd4rl_pomdp.core.options import flat, settings_of
from vd4rl_pomdp.core.state_scale import StateScale
from vd4rl_pomdp.core.streams import RandomStream, random_stream, seed_networks
from vd4rl_pomdp.core.tasks import FRAME_SIZE, FRAME_STACK, TASKS, UNKNOWN_QUALITY
from vd4rl_pomdp.core.types import StateWindows, Windows
from vd4rl_pomdp.corruptions import check_corruption_fits
from vd4rl_pomdp.data import Dataset, StateView, View, WindowSampler, open_dataset
from vd4rl_pomdp.data.folder import read_plan
from vd4rl_pomdp.envs.make import layout_of
from vd4rl_pomdp.nn.action_target import ActionTarget, make_action_target
from vd4rl_pomdp.nn.adam import Adam, set_learning_rate
from vd4rl_pomdp.nn.encoder import Encoder, EncoderCard, EncoderConfig
from vd4rl_pomdp.nn.encoder_folder import FILES_OF_RUN, save_encoder
from vd4rl_pomdp.nn.frame import STATE, StateFrame, encoder_settings
from vd4rl_pomdp.nn.memory import MemoryOptions
from vd4rl_pomdp.nn.objective import ActionOptions, Objective
from vd4rl_pomdp.nn.probes import held_out
from vd4rl_pomdp.runs import METRICS_FILE
from vd4rl_pomdp.runs.loop import training
from vd4rl_pomdp.runs.metrics import read_metrics
from vd4rl_pomdp.runs.outputs import refuse_inside
from vd4rl_pomdp.runs.replay import Replay
from vd4rl_pomdp.runs.run import RunFolder

STAGE = "pretrain"


def pretrain(config: PretrainConfig) -> RunFolder:
    """Run or resume pretraining and write `out/encoder`; returns the run folder."""
    config.check()
    refuse_inside(config.out)
    method, dataset = METHODS.named(config.method), open_dataset(config.data)
    config = replace(config, task=_task_of(dataset, config))
    objective = make_objective(dataset, config).to(pick_device(config.device))
    inputs = {"data": dataset.fingerprint} | getattr(objective.encoder.frame, "found", {})
    collection = read_plan(config.data)
    with RunFolder(config.out, STAGE, config, inputs, FILES_OF_RUN, collection=collection) as run:
        if not run.finished:
            dataset.to(next(objective.parameters()).device)
            trainer = Trainer(objective, make_batches(dataset, config, objective), config)
            labels = {name: run.config[name] for name in ("method", "task", "corruption")}
            labels["quality"] = dataset.quality or UNKNOWN_QUALITY
            trainer.run(run, config.steps if method.trained else 0, f"pretrain {config.method}", labels)
            frames = trainer.step * config.batch_size * (1 if method.histories else config.window)
            save_encoder(run.path / "encoder", objective.encoder, _card(config, dataset, run), frames)
            run.finish(steps=trainer.step, frames=frames)
    return run


class Trainer:
    """Training loop for any objective: sample, compute the loss, step. On a CPU, resuming is bit-exact."""

    def __init__(
        self,
        objective: Objective,
        batches: WindowSampler,
        config: TrainingConfig,
        learning_rate: Callable[[int], float] | None = None,
    ) -> None:
        """Objective and batches are on one device already.

        `learning_rate` is a schedule from step (starting at 0) to learning rate; None: the config's, constant.
        """
        self.objective, self.batches, self.config, self._learning_rate = objective, batches, config, learning_rate
        self.device = next(objective.parameters()).device
        set_products(self.device, config.precision)
        self.optimiser = Adam(objective.parameters(), config.learning_rate)
        self.step = 0
        self._replay = Replay(self._update, self.device, [batches.draws], trained=[objective, self.optimiser])
        self._progress: float | Tensor = torch.zeros((), device=self.device) if self._replay.replays else 0.0

    def run(
        self,
        run: RunFolder,
        steps: int,
        title: str,
        labels: dict[str, str],
        measures: Callable[[], dict[str, float]] = dict,
        also_at: int | None = None,
    ) -> None:
        """Train up to step `steps`, resuming from the newest checkpoint if there is one.

        Args:
            run: folder for checkpoints and metrics.
            steps: total number of steps.
            title: of the progress bar.
            labels: of the run, for wandb and TensorBoard.
            measures: called for extra values in each row of metrics, next to the objective's mean scalars.
            also_at: log a row of metrics after this step, too.
        """
        warn_of_busy_cores(self.device)
        warn_of_slow_bf16(self.device, precision=self.config.precision)
        with training(run, self, title, steps, labels=labels) as loop:
            for step in loop:
                loop.add(self.update())
                if loop.due(self.config.log_every) or step == also_at:
                    loop.log("loss", **measures())
            loop.require_finite(self.objective)  # no later loss would show that the last step diverged

    def update(self) -> dict[str, Tensor]:
        """Take one gradient step; returns the objective's scalars to log."""
        progress = self.step / max(1, self.config.steps)
        if isinstance(self._progress, Tensor):
            self._progress.fill_(progress)  # in place: a captured CUDA graph reads this tensor
        else:
            self._progress = progress
        if self._learning_rate is not None:
            set_learning_rate(self.optimiser, self._learning_rate(self.step))
        logs = self._replay(0)
        self.step += 1
        return logs

    def _update(self, turn: int) -> dict[str, Tensor]:
        window = self.batches.sample()
        with autocast(self.device, self.config.precision):
            loss, logs = self.objective.loss(window, self._progress)
        # outside autocast, which is meant for the forward pass only
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        self.optimiser.step()
        self.objective.after_step()
        return logs

    def state(self) -> dict[str, Any]:
        return {
            "step": self.step,
            "objective": self.objective.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "batches": self.batches.state_dict(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        self.step = state["step"]
        self.objective.load_state_dict(state["objective"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.batches.load_state_dict(state["batches"])


def make_objective(dataset: Dataset, config: PretrainConfig) -> Objective:
    """Build the objective of a config for a data set, on the CPU; UserError if config and data set do not fit."""
    method = METHODS.named(config.method)
    dataset.require_transitions()
    dataset.check_windows(config.window)
    refuse_outside(config, shift=(0, dataset.frame_size - 1))
    # a method that reads states uses images only for videos, which have the benchmark's frame size
    check_corruption_fits(config.corruption, FRAME_SIZE if method.reads_state else dataset.frame_size)
    seed_networks(config.seed, STAGE)
    target = build_target(config, dataset.action_after(dataset.transition_rows).numpy())
    needed = method.reads_state or method.regresses_state or config.frame_encoder == STATE
    states = dataset.state_scale() if needed else None
    return build_objective(config, dataset.action_dim, target, states, (3 * FRAME_STACK, dataset.frame_size))


def build_target(config: TrainingConfig, actions: np.ndarray) -> ActionTarget | None:
    """Build the action target from the (N, A) float32 training actions; None if the method predicts no actions."""
    options = config.options
    if not isinstance(options, ActionOptions):
        return None
    # K-means is seeded by the run: the codes it finds are part of the variance between seeds
    return make_action_target(options.action_target, actions, flat(options).get("codes", 0), config.seed)


def build_objective(
    config: TrainingConfig,
    action_dim: int,
    target: ActionTarget | None,
    states: StateScale | None = None,
    observation: tuple[int, int] = (3 * FRAME_STACK, FRAME_SIZE),
) -> Objective:
    """Build the objective of a config, with a new encoder.

    Args:
        config: the run's settings.
        action_dim: action dimension A.
        target: from `build_target`.
        states: scale of the simulator states; needed if states are an input or a regression target.
        observation: channels and image size of pixel observations, such as (9, 84).
    """
    method, memory, options = METHODS.named(config.method), {}, config.options
    shape: dict[str, Any]
    if method.reads_state or config.frame_encoder == STATE:  # raw, with noise, or standardised with hidden coordinates
        assert states is not None
        frame: dict[str, Any] = {}
        if isinstance(options, StateOptions) and (options.pose_noise or options.velocity_noise):
            frame = {"noise": states.noise(options.pose_noise, options.velocity_noise).tolist()}
        if isinstance(config.frame, HiddenOptions):
            share = config.frame.hidden_share
            frame = {"mean": states.mean.tolist(), "std": states.std.tolist(), "hidden_share": share}
        shape = {"frame_encoder": STATE, "channels": len(states.std), "size": 1, "frame_options": frame}
    else:
        channels, size = observation
        shape = {"frame_encoder": config.frame_encoder, "channels": channels, "size": size}
        shape |= encoder_settings(config.frame)
    if isinstance(config.memory, MemoryOptions):
        others = asdict(config.memory)
        hidden, m = others.pop("hidden_dim"), others.pop("m")
        past = method.past if m is None else m
        memory = {
            "history": history_of(config.method, method, getattr(config, "history", "method")),
            "use_actions": method.use_actions,
            "hidden_dim": hidden,
            "history_window": 0 if past is None else past + 1,  # the m rows of the past, and row t itself
            "memory_options": others,
        }
    encoder = Encoder(EncoderConfig(action_dim, **shape, **memory))
    return method.build(encoder, states if method.regresses_state else target, options, config.seed)


def make_batches(dataset: Dataset, config: PretrainConfig, objective: Objective) -> WindowSampler:
    """Sampler of the windows that the method trains on, shifted and corrupted; seeded by the run."""
    method, draws = METHODS.named(config.method), random_stream(config.seed, STAGE, "batches", device=dataset.t.device)
    frame = objective.encoder.frame
    if isinstance(frame, StateFrame):
        view: View = StateView(dataset, frame.observe, config.corruption, config.seed, STAGE)
    else:
        shared = "window" if getattr(config.options, "shift_shared", False) else method.shift
        pad, shared = (0, "window") if shared == "own" else (config.shift, shared)
        view = View(dataset, config.corruption, pad, config.seed, STAGE, shared=shared)
    if not method.regresses_state:
        return WindowSampler(view, config.batch_size, config.window, draws)
    hold_out = getattr(config.options, "hold_out", False)
    return StateWindowSampler(view, config.batch_size, config.window, draws, method.histories, hold_out)


class StateWindowSampler(WindowSampler):
    """Samples windows together with the simulator states of their rows, for losses that regress states."""

    def __init__(
        self, source: View, batch_size: int, length: int, draws: RandomStream, histories: bool, hold_out: bool
    ) -> None:
        """`histories`: see `Method.histories`. `hold_out`: the states of the probe's test episodes are NaN, for no loss
        to see."""
        super().__init__(source, batch_size, length, draws)
        data = source.dataset
        # a separate sampler, so that no other method can read a state by mistake
        self._states = data.states()
        if hold_out:
            test = torch.from_numpy(held_out(data.episode.cpu().numpy())).to(data.t.device)
            self._states = self._states.masked_fill(test[:, None], torch.nan)
        self._longest = data.longest_episode if histories else 0

    def sample(self) -> StateWindows:
        window = self._histories() if self._longest else super().sample()
        return StateWindows(**window, state=self._states[self.view.dataset.rows(window.key)])

    def _histories(self) -> Windows:
        """Half from an episode's first row, as in evaluation, half from a random row, for variety."""
        data = self.view.dataset
        row = data.transition_rows[self._draw(data.num_transitions)]
        whole = self.draws.uniform(len(row)) < 0.5
        first = torch.where(whole, data.episode_start[data.episode[row]], row)
        return self.view.histories(first, self._longest)


def _task_of(dataset: Dataset, config: PretrainConfig) -> str:
    name = config.task or dataset.task
    if name is None:
        raise UserError(f"{config.data}: cannot determine the dataset's task; pass --task")
    if dataset.task is not None and name != dataset.task:
        raise UserError(f"{config.data}: is a dataset of {dataset.task}, not of {name}; leave --task out")
    if dataset.imported and name not in TASKS:
        return name  # pretraining needs no environment; evaluation refuses an unknown task
    if (width := layout_of(TASKS.named(name)).action_dim) != dataset.action_dim:
        raise UserError(
            f"{config.data}: has {dataset.action_dim} action dimensions, {name} has {width}; pass the right --task"
        )
    return name


def _card(config: PretrainConfig, dataset: Dataset, run: RunFolder) -> EncoderCard:
    losses = [row["action_loss"] for row in read_metrics(run.path / METRICS_FILE) if "action_loss" in row]
    last_tenth = losses[-max(1, len(losses) // 10) :]  # a single row would be noisy
    return EncoderCard(
        method=config.method,
        task=config.task,
        quality=dataset.quality or UNKNOWN_QUALITY,
        corruption=settings_of(flat(config.corruption)),
        seed=config.seed,
        steps=config.steps,
        preset=config.preset,
        end_to_end=METHODS.named(config.method).end_to_end,
        action_loss=sum(last_tenth) / len(last_tenth) if last_tenth else None,
        data=dataset.fingerprint,
        settings=settings_of(run.config),
    )

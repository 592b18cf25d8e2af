"""The pretraining loop. It knows no method by name: sample, corrupt, shift, step; resumable to the bit on a CPU."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from pretrain.build import build_objective, build_target
from pretrain.config import PretrainConfig
from pretrain.objectives import METHODS
from vd4rl_pomdp.core.errors import UserError, refuse_outside
from vd4rl_pomdp.core.options import flat
from vd4rl_pomdp.core.seeding import seed_networks, stream_generator
from vd4rl_pomdp.core.settings import settings_of
from vd4rl_pomdp.core.tasks import FRAME_SIZE, FRAME_SIZES, FRAME_STACK, TASKS, UNKNOWN_QUALITY
from vd4rl_pomdp.core.types import StateWindows, Windows
from vd4rl_pomdp.corruptions import check_corruption_fits
from vd4rl_pomdp.data import Dataset, View, WindowSampler, open_dataset
from vd4rl_pomdp.envs.make import layout_of
from vd4rl_pomdp.nn.encoder import EncoderCard
from vd4rl_pomdp.nn.encoder_folder import FILES_OF_RUN, save_encoder
from vd4rl_pomdp.nn.objective import Objective, require_loss
from vd4rl_pomdp.runs import METRICS_FILE
from vd4rl_pomdp.runs.device import autocast, pick_device
from vd4rl_pomdp.runs.loop import training
from vd4rl_pomdp.runs.memory import bytes_kept, bytes_of_parameters, require_memory, telling_memory
from vd4rl_pomdp.runs.metrics import read_metrics
from vd4rl_pomdp.runs.outputs import refuse_inside
from vd4rl_pomdp.runs.run import RunFolder

STAGE = "pretrain"
DECIDE_MEMORY = ("batch_size", "window", "feature_dim", "hidden_dim", "head_dim", "codes", "homer_codes")
"""Settings that the memory of a training hangs on."""


def pretrain(config: PretrainConfig) -> RunFolder:
    """Run the stage, or go on with it, and write `out/encoder`; returns the run's folder."""
    check_config(config)
    refuse_inside(config.out)
    with telling_memory(config, *DECIDE_MEMORY):
        return _pretrain(config)


def _pretrain(config: PretrainConfig) -> RunFolder:
    method = METHODS.named(config.method)
    dataset = open_dataset(config.data)
    dataset.require_transitions()
    check_pictures(config, dataset.frame_size)
    task = _task_of(dataset, config)
    seed_networks(config.seed, STAGE)
    objective = _build(dataset, config)
    device = pick_device(config.device)
    if method.trained:
        require_batch(objective, device, config)
    inputs = {"data": dataset.fingerprint}
    with RunFolder(config.out, STAGE, replace(config, task=task), inputs, FILES_OF_RUN) as run:
        if not run.finished:
            trainer = PretrainTrainer(objective.to(device), dataset.to(device), config)
            trainer.run(run, config.steps if method.trained else 0)
            card = _card(config, task, dataset, run)
            frames = trainer.step * config.batch_size * config.window
            save_encoder(run.path / "encoder", objective.encoder, card, frames)
            run.finish(steps=trainer.step, frames=frames)
    return run


class PretrainTrainer:
    """One objective on one data set."""

    def __init__(
        self, objective: Objective, dataset: Dataset, config: PretrainConfig, view: View | None = None
    ) -> None:
        """See the class; `view` is what is seen of the set, unless it is what the config says."""
        self.objective, self.dataset, self.config = objective, dataset, config
        self.device = dataset.t.device
        self.states = dataset.states() if METHODS.named(config.method).regresses_state else None
        view = view or view_of(dataset, config)
        batches = stream_generator(config.seed, STAGE, "batches")
        self.sampler = WindowSampler(view, config.batch_size, config.window, batches)
        self.optimiser = torch.optim.Adam(objective.parameters(), lr=config.learning_rate)
        self.step = 0

    def batch(self) -> Windows:
        """The next windows, shifted and corrupted: what the agent would see, with the states if the loss wants them."""
        window = self.sampler.sample()
        if self.states is None:
            return window
        return StateWindows(**window, state=self.states[self.dataset.rows(window.key)])

    def update(self) -> dict[str, torch.Tensor]:
        """One gradient step; returns the objective's scalars."""
        window = self.batch()
        with autocast(self.device, self.config.precision):
            given = self.objective.loss(window, self.step / max(1, self.config.steps))
        loss, logs = require_loss(self.config.method, given)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        self.optimiser.step()
        self.objective.after_step()
        self.step += 1
        return logs

    def run(self, run: RunFolder, steps: int) -> None:
        """Train up to `steps`, from the newest checkpoint if there is one."""
        with training(run, self, f"pretrain {self.config.method}", steps, labels=self._labels(run)) as loop:
            while self.step < steps:
                loop.add(self.update())
                if loop.due(self.config.log_every):
                    loop.log("loss")
                loop.step_done(save=loop.due(self.config.checkpoint_every))
            loop.require_finite(self.objective)

    def _labels(self, run: RunFolder) -> dict[str, str]:
        """What names the run where it is tracked."""
        told = {name: run.config[name] for name in ("method", "task", "corruption")}
        return told | {"quality": self.dataset.quality or UNKNOWN_QUALITY}

    def state(self) -> dict[str, Any]:
        """Everything needed to go on to the bit."""
        return {
            "step": self.step,
            "objective": self.objective.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "sampler": self.sampler.state_dict(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from `state`."""
        self.step = state["step"]
        self.objective.load_state_dict(state["objective"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.sampler.load_state_dict(state["sampler"])


def check_config(config: PretrainConfig) -> None:
    """Refuse settings that cannot work, before anything is read or written."""
    config.check()
    least = METHODS.named(config.method).least_batch
    if config.batch_size < least:
        raise UserError(f"--batch-size is {config.batch_size}; {config.method} tells windows apart: give it {least}")
    refuse_outside(config, shift=(0, FRAME_SIZES[1] - 1))


def check_pictures(config: PretrainConfig, size: int) -> None:
    """Refuse a shift or a corruption that does not fit frames of size x size pixels."""
    refuse_outside(config, shift=(0, size - 1))
    films = METHODS.named(config.method).reads_state  # pictures are for its film alone, of the benchmark's size
    check_corruption_fits(config.corruption, min(size, FRAME_SIZE) if films else size)


def require_batch(objective: Objective, device: torch.device, config: Any) -> None:
    """Refuse a batch whose frames alone, once encoded, exceed the memory of a device.

    Args:
        objective: what will be trained.
        device: where.
        config: a stage's settings, `DECIDE_MEMORY` among them.
    """
    shape = objective.encoder.config
    stack = torch.zeros(1, shape.channels, shape.size, shape.size, dtype=torch.uint8)
    rows = config.batch_size * config.window
    with autocast(stack.device, config.precision):
        needed = rows * (stack.nbytes + bytes_kept(objective.encoder.frame, stack)) + bytes_of_parameters(objective)
    require_memory(needed, device, config, *DECIDE_MEMORY)


def _build(dataset: Dataset, config: PretrainConfig) -> Objective:
    target = build_target(config, dataset.action_after(dataset.transition_rows).numpy())
    method = METHODS.named(config.method)
    states = dataset.state_scale() if method.reads_state or method.regresses_state else None
    objective = build_objective(config, dataset.action_dim, target, states, (3 * FRAME_STACK, dataset.frame_size))
    dataset.check_windows(config.window)
    return objective


def view_of(dataset: Dataset, config: PretrainConfig) -> View:
    """What is seen of a set, shifted as the method has it."""
    shared = METHODS.named(config.method).shift
    if getattr(config.options, "shift_shared", False):
        shared = "window"
    if shared == "own":
        return View(dataset, config.corruption, 0, config.seed, STAGE)
    return View(dataset, config.corruption, config.shift, config.seed, STAGE, shared=shared)


def _task_of(dataset: Dataset, config: PretrainConfig) -> str:
    name = config.task or dataset.task
    if name is None:
        raise UserError(f"{config.data}: cannot tell the task of this set; pass --task")
    if dataset.task is not None and name != dataset.task:
        raise UserError(f"{config.data}: is a set of {dataset.task}, not of {name}; leave --task out")
    task = TASKS.named(name)
    if (width := layout_of(task).action_dim) != dataset.action_dim:
        raise UserError(
            f"{config.data}: has {dataset.action_dim} action dimensions, {name} has {width}; pass the right --task"
        )
    return name


def _card(config: PretrainConfig, task: str, dataset: Dataset, run: RunFolder) -> EncoderCard:
    return EncoderCard(
        method=config.method,
        task=task,
        quality=dataset.quality or UNKNOWN_QUALITY,
        corruption=flat(config.corruption),
        seed=config.seed,
        steps=config.steps,
        preset=config.preset,
        end_to_end=METHODS.named(config.method).end_to_end,
        action_loss=_last_action_loss(run),
        data=dataset.fingerprint,
        settings=settings_of(run.config),
    )


def _last_action_loss(run: RunFolder) -> float | None:
    """Mean of the last tenth of the rows that have one; each row is a mean, and all count the same."""
    rows = read_metrics(run.path / METRICS_FILE)
    losses = [row["action_loss"] for row in rows if "action_loss" in row]
    return sum(last) / len(last) if (last := losses[-max(1, len(losses) // 10) :]) else None

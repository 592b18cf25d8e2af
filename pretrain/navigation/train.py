"""`vd4rl-pomdp navigation train`: train an objective on a maze beside a state probe, and measure what it knows.

A run folder holds config.json, metrics.jsonl (means over `log_every` steps), encoder/, trajectory.csv and, at its end,
results.json: every number the report needs, as rows of (measure, split, probe, rows, k, value).
"""

from __future__ import annotations

import shlex
from dataclasses import asdict

from pretrain.navigation.config import PRESETS, NavigationConfig, command_of
from pretrain.navigation.data import open_data
from pretrain.navigation.measure import measure, write_trajectory
from pretrain.navigation.trainer import STAGE, Trainer, make_objective, network_of
from pretrain.objectives import INVERSE, METHODS, unread_options
from pretrain.train import DECIDE_MEMORY, require_batch
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.errors import MAX_SEED, UserError, refuse_outside, refuse_unread
from vd4rl_pomdp.navigation.methods import REFERENCES, UNTRAINED
from vd4rl_pomdp.navigation.observations import SHAPES
from vd4rl_pomdp.nn.action_target import check_action_target
from vd4rl_pomdp.nn.encoder import MAX_LAYERS
from vd4rl_pomdp.nn.encoder_folder import EncoderCard, save_encoder
from vd4rl_pomdp.nn.frame import check_frame_encoder
from vd4rl_pomdp.objective import check_gap
from vd4rl_pomdp.runs.device import pick_device
from vd4rl_pomdp.runs.files import jsonable, write_json
from vd4rl_pomdp.runs.memory import telling_memory
from vd4rl_pomdp.runs.outputs import refuse_inside
from vd4rl_pomdp.runs.run import RunFolder
from vd4rl_pomdp.runs.settings import settings_of
from vd4rl_pomdp.seeding import seed_networks


def train(config: NavigationConfig) -> RunFolder:
    """Run the stage, or go on with it; returns the run's folder."""
    _check(config)
    refuse_inside(config.out)
    with telling_memory(config, *DECIDE_MEMORY):
        return _train(config)


def _train(config: NavigationConfig) -> RunFolder:
    data = open_data(config)
    seed_networks(config.seed, STAGE)
    objective = make_objective(data, config)
    device = pick_device(config.device)
    require_batch(objective, device, config)
    with RunFolder(config.out, STAGE, config, data.inputs) as run:
        if not run.finished:
            trainer = Trainer(objective.to(device), data.on(device), config)
            trainer.run(run, 0 if config.method == UNTRAINED else config.steps)
            _conclude(run, trainer)
    return run


def _conclude(run: RunFolder, trainer: Trainer) -> None:
    """Measure, and write what is kept of a run."""
    config, data, trained = trainer.config, trainer.data, run.seconds
    probe, rows = measure(trainer, run.path / "metrics.jsonl")
    write_trajectory(run.path / "trajectory.csv", trainer, probe)
    card = EncoderCard(
        method=config.method,
        task=data.maze.name,
        quality="planner",
        corruption=asdict(CorruptionConfig("none")),
        seed=config.seed,
        steps=trainer.step,
        preset=config.preset,
        data=data.dataset.fingerprint,
        settings=settings_of(jsonable(asdict(config))),
    )
    save_encoder(run.path / "encoder", trainer.objective.encoder, card)
    record = {"maze": data.maze.name, "set": data.dataset.fingerprint, "command": shlex.join(command_of(config))}
    write_json(run.path / "results.json", record | {"rows": rows})
    frames = trainer.step * config.batch_size * config.window
    run.finish(seconds=round(trained, 2), steps=trainer.step, frames=frames, total_seconds=round(run.seconds, 2))


def _check(config: NavigationConfig) -> None:
    """Refuse settings that cannot work or that nothing reads, before anything is read or written."""
    METHODS.named(network_of(config.method))
    refuse_outside(
        config, seed=(0, MAX_SEED), steps=1, batch_size=1, window=2, max_k=1, codes=1, m=0, n=0, burn_in=0,
        average_last=1, log_every=1, checkpoint_every=1, evaluation_windows=1, refit_windows=1, refit_steps=1,
        learning_rate=0, warm_up=0, feature_dim=1, hidden_dim=1, gru_layers=(1, MAX_LAYERS), head_dim=1,
        self_prediction=0, l2_states=0,
    )  # fmt: skip
    if config.picture not in SHAPES:
        raise UserError(f"unknown picture {config.picture!r}: choose one of {', '.join(SHAPES)}")
    check_frame_encoder(config.frame_encoder)
    check_action_target(config.action_target)
    refuse_unread(config, PRESETS[config.preset], _unread(config), config.method)
    if config.burn_in >= config.window:
        raise UserError(f"--burn-in {config.burn_in} leaves no row of a window of {config.window}: lower it")
    if config.checkpoint_every % config.log_every:
        raise UserError(
            f"--checkpoint-every {config.checkpoint_every} is no multiple of --log-every {config.log_every}: change one"
        )
    check_gap(config.max_k, config.window)


def _unread(config: NavigationConfig) -> set[str]:
    """Settings that change nothing in a run; a reference's K names its cell of a table."""
    unread = unread_options(config.objective_config(network_of(config.method)))
    if config.method in REFERENCES:
        unread |= {*INVERSE, "n", "literal_future"} - {"max_k"}
    if config.exogenous == "none":
        unread.add("exogenous_weight")
    return {name for name in unread if hasattr(config, name)}

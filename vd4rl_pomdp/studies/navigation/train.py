"""`vd4rl-pomdp navigation train`: train an objective on a maze beside a state probe, and measure what it knows.

A run folder holds config.json, metrics.jsonl (means over `log_every` steps), encoder/, trajectory.csv and, at its end,
results.json: every number the report needs, as rows of (measure, split, probe, rows, k, value).
"""

from __future__ import annotations

import shlex

from vd4rl_pomdp.core.options import flat, settings_of
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data.folder import read_plan
from vd4rl_pomdp.nn.encoder import EncoderCard
from vd4rl_pomdp.nn.encoder_folder import FILES_OF_RUN, save_encoder
from vd4rl_pomdp.runs import METRICS_FILE, NAVIGATION_FILE, TRAJECTORY_FILE
from vd4rl_pomdp.runs.device import pick_device
from vd4rl_pomdp.runs.files import write_json
from vd4rl_pomdp.runs.outputs import refuse_inside
from vd4rl_pomdp.runs.run import RunFolder
from vd4rl_pomdp.studies.navigation.config import NavigationConfig, command_of
from vd4rl_pomdp.studies.navigation.data import open_data
from vd4rl_pomdp.studies.navigation.measure import measure, write_trajectory
from vd4rl_pomdp.studies.navigation.measures import UNTRAINED
from vd4rl_pomdp.studies.navigation.probed import STAGE, ProbedObjective, make_trainer

RESULTS = (NAVIGATION_FILE, TRAJECTORY_FILE, *FILES_OF_RUN)
"""What a finished run holds."""


def train(config: NavigationConfig) -> RunFolder:
    """Run the stage, or resume it; returns the run's folder."""
    config.check()
    refuse_inside(config.out)
    data = open_data(config)
    trainer, probed = make_trainer(data, config, pick_device(config.device))
    labels = {"method": config.method, "task": data.maze.name}
    with RunFolder(config.out, STAGE, config, data.inputs, RESULTS, collection=read_plan(config.data)) as run:
        if not run.finished:
            steps, last_averaged = 0 if config.method == UNTRAINED else config.steps, config.steps - config.average_last
            trainer.run(run, steps, " ".join(reversed(labels.values())), labels, probed.take_errors, last_averaged)
            _conclude(run, trainer.step, probed)
    return run


def _conclude(run: RunFolder, steps: int, probed: ProbedObjective) -> None:
    """Measure, and write what is kept of a run."""
    config, data, trained = probed.config, probed.data, run.seconds
    probe, rows = measure(probed, run.path / METRICS_FILE)
    write_trajectory(run.path / TRAJECTORY_FILE, probed, probe)
    card = EncoderCard(
        method=config.method,
        task=data.maze.name,
        quality=data.maze.driver,
        corruption=flat(CorruptionConfig()),
        seed=config.seed,
        steps=steps,
        preset=config.preset,
        data=data.dataset.fingerprint,
        settings=settings_of(run.config),
    )
    frames = steps * config.batch_size * config.window
    save_encoder(run.path / "encoder", probed.encoder, card, frames)
    record = {"maze": data.maze.name, "set": data.dataset.fingerprint, "command": shlex.join(command_of(config))}
    write_json(run.path / NAVIGATION_FILE, record | {"rows": rows})
    run.finish(seconds=round(trained, 2), steps=steps, frames=frames, total_seconds=round(run.seconds, 2))

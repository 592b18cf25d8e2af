"""From a training run to the files that ship: expert, medium, and the ladder of snapshots behind medium_replay.

The folder that `export_run` writes also holds the run's config, curve and networks: small enough for a repository, and
all that another machine needs to go on.
"""

from __future__ import annotations

import csv
import io
import json
import math
import shutil
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from vd4rl_pomdp.core.errors import UserError, refuse_no_folder
from vd4rl_pomdp.core.reading import read_bytes
from vd4rl_pomdp.core.tasks import TASKS, Task
from vd4rl_pomdp.policies.actor import Actor, Ladder, read_actor, read_ladder
from vd4rl_pomdp.policies.state_env import StateEnv
from vd4rl_pomdp.runs.files import read_json, write_bytes
from vd4rl_pomdp.runs.outputs import refuse_foreign, refuse_inside

CARD_EPISODES = 20
CARD_SEED = 10_000
"""Episode i of an actor's card starts from environment seed CARD_SEED + i."""
NETWORKS = "networks.safetensors"
CURVE_COLUMNS = ("decisions", "return_mean")
SETTINGS, CURVE = "config.json", "curve.csv"
PROGRESS = (SETTINGS, CURVE, NETWORKS)
"""Files of a run from which another one can start."""
LADDER_RUNGS = 15
"""Snapshots in a ladder, at most: the actors of all tasks together stay under 10 MB."""


def episode_returns(actor: Actor, task: Task, episodes: int, first_seed: int = CARD_SEED) -> list[float]:
    """Returns of the actor's mean action on episodes seeded first_seed, first_seed + 1, ..."""
    env = StateEnv(task)
    returns = []
    for episode in range(episodes):
        state, _ = env.reset(seed=first_seed + episode)
        total, ended = 0.0, False
        while not ended:
            state, reward, terminated, truncated, _ = env.step(actor.act(state))
            total += reward
            ended = terminated or truncated
        returns.append(total)
    return returns


def read_curve(run: Path) -> list[tuple[int, float]]:
    """Learning curve of a run: (decisions, mean return) rows; raises UserError if it is damaged."""
    steps, mean = CURVE_COLUMNS
    try:
        text = read_bytes(run / CURVE).decode()
        curve = [(int(row[steps]), float(row[mean])) for row in csv.DictReader(io.StringIO(text, newline=""))]
    except UserError:
        raise
    except (FileNotFoundError, KeyError, TypeError, ValueError, csv.Error) as error:
        raise UserError(f"{run / CURVE}: is no learning curve ({error}); take another copy of the run") from error
    if not all(math.isfinite(mean) for _, mean in curve):
        raise UserError(f"{run / CURVE}: a return in it is not finite; take another copy of the run")
    return curve


def snapshot_path(run: Path, decisions: int) -> Path:
    """File of the actor that a run saved after so many decisions."""
    return run / "snapshots" / f"{decisions:08d}.safetensors"


def export_run(run: Path, out: Path) -> dict[str, Path]:
    """Choose and write a run's expert, medium and ladder, and copy its progress; the run may still be going on.

    The expert is the best of the three best snapshots, the medium actor the one of the three snapshots before it whose
    return is nearest to half of the expert's; all are judged on the same 20 episodes.

    Args:
        run: folder of a training run.
        out: folder for the files.

    Returns:
        The files by quality: `expert`, `medium`, `replay`.
    """
    if not (run / CURVE).exists() or not (run / SETTINGS).exists():
        raise UserError(f"{run}: is not the folder of a policy run with a snapshot; `policy train` makes one")
    refuse_no_folder(out)
    config = read_json(run / SETTINGS)
    played = str(config.get("task"))
    task = TASKS.named(played)
    if out.resolve() != run.resolve():
        _refuse_other(out, played)
    curve = read_curve(run)
    kept = [row for row in curve if snapshot_path(run, row[0]).exists()]
    if not kept:
        raise UserError(f"{run}: keeps no snapshot of its curve; export the run's own folder, not an exported one")
    judged = _judge(run, task, [step for step, _ in sorted(kept, key=lambda row: row[1])[-3:]])
    expert = max(judged, key=lambda step: float(np.mean(judged[step])))
    half = float(np.mean(judged[expert])) / 2
    near = sorted((row for row in kept if row[0] < expert), key=lambda row: abs(row[1] - half))[:3]
    judged |= _judge(run, task, [step for step, _ in near])
    medium = min((step for step, _ in near), key=lambda step: abs(float(np.mean(judged[step])) - half), default=expert)
    out.mkdir(parents=True, exist_ok=True)
    for name in PROGRESS:
        if (run / name).exists() and out.resolve() != run.resolve():
            shutil.copy(run / name, out / name)
    files = {
        quality: _publish(run, out / f"{played}_{quality}.safetensors", config, quality, step, judged[step], curve)
        for quality, step in (("expert", expert), ("medium", medium))
    }
    return files | {"replay": _publish_ladder(run, out, played, [row for row in kept if row[0] <= medium])}


def _refuse_other(out: Path, task: str) -> None:
    """Raise UserError for a folder to export to that holds anything but an earlier export for the same task."""
    exported = (out / CURVE).is_file() and not (out / "snapshots").exists()
    if exported and read_json(out / SETTINGS).get("task") == task:
        refuse_inside(out)
    else:
        refuse_foreign(out, f"exported policy of {task}")


def _judge(run: Path, task: Task, steps: list[int]) -> dict[int, list[float]]:
    return {step: episode_returns(read_actor(snapshot_path(run, step)), task, CARD_EPISODES) for step in steps}


def _publish(
    run: Path,
    path: Path,
    config: dict[str, Any],
    quality: str,
    step: int,
    returns: list[float],
    curve: list[tuple[int, float]],
) -> Path:
    """Write the actor with its card, and beside it the card with the learning curve.

    Versions of what trained it are those that its snapshot names; of what played the returns, those of this process.
    """
    actor = read_actor(snapshot_path(run, step))
    here = {name: version(name) for name in ("dm-control", "mujoco", "numpy")}
    card = {
        "task": config["task"],
        "quality": quality,
        "decisions": step,
        "return_mean": round(float(np.mean(returns)), 3),
        "return_min": round(min(returns), 3),
        "return_max": round(max(returns), 3),
        "returns": returns,
        "returns_seeds": [CARD_SEED, CARD_SEED + CARD_EPISODES - 1],
        "config": config,
        "versions": actor.card.get("versions", {}) | here,
    }
    Actor(actor.weights, card).save(path)
    write_bytes(path.with_suffix(".json"), (json.dumps(card | {"learning_curve": curve}, indent=1) + "\n").encode())
    return path


def _publish_ladder(run: Path, out: Path, task: str, rows: list[tuple[int, float]]) -> Path:
    """Write at most LADDER_RUNGS snapshots, evenly spread over the run up to the last of `rows`, into one file."""
    chosen = sorted({round(i) for i in np.linspace(0, len(rows) - 1, min(LADDER_RUNGS, len(rows)))})
    steps = [rows[i][0] for i in chosen]
    actors = [read_actor(snapshot_path(run, step)) for step in steps]
    path = out / f"{task}_replay.safetensors"
    Ladder.of(actors, {"task": task, "decisions": steps, "curve": [rows[i][1] for i in chosen]}).save(path)
    return path


def exported_actors(folder: Path, task: str) -> Iterator[tuple[int, Actor]]:
    """Actors that `export_run` wrote into a folder, each after its decisions: first the ladder's, which are rounded."""
    ladder = folder / f"{task}_replay.safetensors"
    if ladder.exists():
        read = read_ladder(ladder, task)
        yield from zip(read.card["decisions"], read.rungs, strict=True)
    for quality in ("medium", "expert"):
        path = folder / f"{task}_{quality}.safetensors"
        if path.exists():
            actor = read_actor(path, task)
            yield actor.card["decisions"], actor

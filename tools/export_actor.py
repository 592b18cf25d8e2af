"""Choose actors among the snapshots of a `train_actor.py` run, and export them with their cards.

`python tools/export_actor.py RUN --out FOLDER`, also while the run continues. Expert: the best of the three best
snapshots. Medium: of the three earlier snapshots with returns closest to half of the expert's, the closest. Both are
judged on the same 20 episodes. Replay: a ladder of snapshots up to the medium one, in place of the replay buffer behind
medium_replay. FOLDER also gets the run's config, curve and networks, from which another run can start.
"""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import tyro
from script import run_script

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import TASKS, Task
from vd4rl_pomdp.envs.make import layout_of, make_env
from vd4rl_pomdp.policies.actor import Actor, Ladder, read_actor, read_ladder
from vd4rl_pomdp.runs.files import write_bytes

CARD_EPISODES = 20
CARD_SEED = 10_000
"""Episode i of an actor's card has environment seed CARD_SEED + i."""
SETTINGS, CURVE, NETWORKS = "config.json", "curve.csv", "networks.safetensors"
PROGRESS = (SETTINGS, CURVE, NETWORKS)
"""Files of a run from which another one can start."""
LADDER_RUNGS = 15
"""Maximum snapshots in a ladder: the actors of all tasks together stay under 10 MB."""


class StateEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """A task on states; its limit of decisions truncates episodes.

    Observations: (D,) float32, dm_control's observations flattened in order. Actions: (A,) float32 in [-1, 1].
    """

    def __init__(self, task: Task) -> None:
        self._env = make_env(task, size=None)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (layout_of(task).state_dim,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (layout_of(task).action_dim,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Start an episode from a seed, or from one drawn by the environment's generator."""
        super().reset(seed=seed)
        first = self._env.reset(int(self.np_random.integers(2**31)) if seed is None else seed)
        return first.state, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Repeat an action for the action repeat; the reward is the sum."""
        now = self._env.step(action)
        return now.state, now.reward, now.terminated, now.last and not now.terminated, {}


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
    """Learning curve of a run: rows (decisions, mean return); empty before the first evaluation."""
    if not (run / CURVE).exists():
        return []
    with (run / CURVE).open(newline="", encoding="utf-8") as file:
        return [(int(row["decisions"]), float(row["return_mean"])) for row in csv.DictReader(file)]


def snapshot_path(run: Path, decisions: int) -> Path:
    """File of the snapshot after this many decisions."""
    return run / "snapshots" / f"{decisions:08d}.safetensors"


def export_run(run: Path, out: Path) -> dict[str, Path]:
    """Choose and write a run's actors (see the module), and copy its progress; the run may still be training.

    Returns:
        Files by quality: `expert`, `medium`, `replay`.
    """
    curve = read_curve(run)
    rows = [row for row in curve if snapshot_path(run, row[0]).exists()]
    if not rows:
        raise UserError(f"{run}: keeps no snapshot of an actor; name the folder of a training run, not of an export")
    config = json.loads((run / SETTINGS).read_text(encoding="utf-8"))
    name = config["task"]

    def judge(rows: list[tuple[int, float]]) -> dict[int, list[float]]:
        actors = {step: read_actor(snapshot_path(run, step)) for step, _ in rows}
        return {step: episode_returns(actor, TASKS.named(name), CARD_EPISODES) for step, actor in actors.items()}

    judged = judge(sorted(rows, key=lambda row: row[1])[-3:])
    expert = max(judged, key=lambda step: float(np.mean(judged[step])))
    half = float(np.mean(judged[expert])) / 2
    near = sorted((row for row in rows if row[0] < expert), key=lambda row: abs(row[1] - half))[:3]
    judged |= judge(near)
    medium = min((step for step, _ in near), key=lambda step: abs(float(np.mean(judged[step])) - half), default=expert)
    out.mkdir(parents=True, exist_ok=True)
    for file in PROGRESS:
        if (run / file).exists() and out.resolve() != run.resolve():
            shutil.copy(run / file, out / file)
    files = {quality: out / f"{name}_{quality}.safetensors" for quality in ("expert", "medium", "replay")}
    # versions of what trained it come from the snapshot, of what evaluated it from this process
    here = {name: version(name) for name in ("dm-control", "mujoco", "numpy")}
    for quality, step in (("expert", expert), ("medium", medium)):
        actor, returns, path = read_actor(snapshot_path(run, step)), judged[step], files[quality]
        card = {"task": name, "quality": quality, "decisions": step, "return_mean": round(float(np.mean(returns)), 3)}
        card |= {"return_min": round(min(returns), 3), "return_max": round(max(returns), 3), "returns": returns}
        card |= {"returns_seeds": [CARD_SEED, CARD_SEED + CARD_EPISODES - 1], "config": config}
        card["versions"] = actor.card.get("versions", {}) | here
        Actor(actor.weights, card).save(path)
        text = json.dumps(card | {"learning_curve": curve}, indent=1)
        write_bytes(path.with_suffix(".json"), f"{text}\n".encode())
    rungs = [row for row in rows if row[0] <= medium]
    chosen = sorted({round(i) for i in np.linspace(0, len(rungs) - 1, min(LADDER_RUNGS, len(rungs)))})
    steps = [rungs[i][0] for i in chosen]
    of = {"task": name, "decisions": steps, "curve": [rungs[i][1] for i in chosen]}
    Ladder.of([read_actor(snapshot_path(run, step)) for step in steps], of).save(files["replay"])
    return files


def exported_actors(folder: Path, task: str) -> Iterator[tuple[int, Actor]]:
    """Actors exported to a folder with their decisions: first the ladder's, which are rounded."""
    ladder = folder / f"{task}_replay.safetensors"
    if ladder.exists():
        read = read_ladder(ladder, task)
        yield from zip(read.card["decisions"], read.rungs, strict=True)
    for quality in ("medium", "expert"):
        path = folder / f"{task}_{quality}.safetensors"
        if path.exists():
            actor = read_actor(path, task)
            yield actor.card["decisions"], actor


@dataclass(frozen=True)
class Export:
    """Export a run's expert, medium and medium_replay actors with their cards."""

    run: tyro.conf.Positional[Path]
    """Folder of a training run."""
    out: Path
    """Output folder."""


def main(command: Export) -> None:
    """Export, and print the files."""
    for quality, path in export_run(command.run, command.out).items():
        print(f"{quality}: {path}")


if __name__ == "__main__":
    run_script(main, Export)

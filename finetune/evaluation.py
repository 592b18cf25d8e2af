"""Evaluate a frozen encoder and a policy in the corrupted environment: parallel episodes, raw rows as the result."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cache, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from vd4rl_pomdp.agents import Agent
from vd4rl_pomdp.core.errors import UserError, refuse_number
from vd4rl_pomdp.core.options import LABELS, flat
from vd4rl_pomdp.core.registry import warn_of_other_code
from vd4rl_pomdp.core.tasks import FRAME_SIZE, MOST_EPISODES, TASKS, Task
from vd4rl_pomdp.corruptions import CorruptionConfig, check_corruption_fits
from vd4rl_pomdp.data.parity import render_info
from vd4rl_pomdp.data.reference import Reference, action_error
from vd4rl_pomdp.envs.corrupted import CorruptedEnv, Drawn
from vd4rl_pomdp.nn.encoder_folder import load_encoder, read_record
from vd4rl_pomdp.nn.policy import load_policy, policy_step
from vd4rl_pomdp.policies.actor import read_actor
from vd4rl_pomdp.runs import CONFIG_FILE, EPISODES_FILE, TIMING_FILE
from vd4rl_pomdp.runs.episodes import EVALUATION_SEED, read_episodes
from vd4rl_pomdp.runs.files import Row, read_json
from vd4rl_pomdp.runs.provenance import machine
from vd4rl_pomdp.runs.results import Result, read_run
from vd4rl_pomdp.runs.workers import run_jobs

FILM_EVERY = 4
"""Rows between two frames of a film."""


@dataclass(frozen=True)
class EpisodeJob:
    """One evaluation episode."""

    encoder: Path
    policy: Path
    task: Task
    """The task itself, not its name: a user's task need not be registered in the worker process."""
    corruption: CorruptionConfig
    episode: int
    film: bool
    length: int | None = None
    actor: Path | None = None
    """File of the behaviour policy that collected the data; None if unknown."""
    evaluated_under: str = ""
    """Label of the corruption in the rows; empty: the corruption's name."""


@dataclass(frozen=True)
class Episode:
    """Result of an evaluation episode."""

    evaluated_under: str
    """Corruption during the episode: its name, plus any options that differ from the run's own."""
    episode: int
    rewards: list[float]
    """One per decision."""
    film: dict[str, np.ndarray] | None
    """`clean` (F, 3, S, S) and `corrupted` (F, C, S, S) uint8 frames, and `return` (F,) so far."""
    action_errors: list[np.floating] = field(default_factory=list)
    """Per decision, in closed loop: mean squared difference between the policy's action and the behaviour policy's mean
    action in the current state; empty if that policy is unknown."""

    @property
    def total(self) -> float:
        """Undiscounted return, summed in order."""
        return float(np.cumsum(self.rewards)[-1])  # np.sum is pairwise: other last digits

    @property
    def action_error(self) -> float | None:
        """Mean over its decisions; None if unknown."""
        return float(np.mean(self.action_errors)) if self.action_errors else None


def evaluate(jobs: list[EpisodeJob], workers: int) -> list[Episode]:
    """Run evaluation episodes. Results do not depend on `workers`."""
    return list(run_jobs(_run_episode, jobs, workers))


def episode_rows(episodes: list[Episode], labels: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows of `episodes.csv`, one per episode; `labels` gives the columns up to `step`, as in training."""
    divisor = TASKS.named(labels["task"]).score_divisor
    return [
        labels
        | {
            "episode": e.episode,
            "episode_seed": EVALUATION_SEED + e.episode,
            "return": round(e.total, 4),
            "length": len(e.rewards),
            "score": round(e.total / divisor, 4),
            "evaluated_under": e.evaluated_under,
            "action_error": None if e.action_error is None else round(e.action_error, 6),
        }
        for e in episodes
    ]


_environment = cache(CorruptedEnv)
"""Cached, so that all episodes of this process share one GL context."""
_read_actor = cache(read_actor)


@lru_cache(maxsize=1)
def _agent(encoder: Path, policy: Path, written: tuple[int, ...]) -> Agent:
    """The agent of two folders, cached until another is requested or one of its folders was `written` again."""
    return Agent(load_encoder(encoder)[0], load_policy(policy))


def _run_episode(job: EpisodeJob) -> Episode:
    written = tuple(folder.stat().st_mtime_ns for folder in (job.encoder, job.policy) if folder.exists())
    agent = _agent(job.encoder, job.policy, written)
    # a film needs all frames; otherwise render only frames that the agent sees
    draws: Drawn = "all" if job.film else "nothing" if agent.encoder.reads_state else "seen"
    env = _environment(job.task, job.corruption, "fast", job.length, agent.picture_size, draws)
    agent.reset()
    now = env.reset(EVALUATION_SEED + job.episode, EVALUATION_SEED, job.episode)
    film = [(now, 0.0)]
    actor = job.actor and _read_actor(job.actor)
    rewards: list[float] = []
    errors: list[np.floating] = []
    while not now.time_step.last:
        action = agent.act(agent.encoder_input(now, job.task))
        if actor:
            errors.append(action_error(action, actor.act(now.time_step.state)))
        now = env.step(action)
        rewards.append(now.time_step.reward)
        if job.film and len(rewards) % FILM_EVERY == 0:
            film.append((now, float(np.cumsum(rewards)[-1])))
    pictures = None
    if job.film:
        pictures = {
            "clean": np.stack([shot.clean[-3:].numpy() for shot, _ in film]),
            "corrupted": np.stack([shot.obs.numpy() for shot, _ in film]),
            "return": np.array([total for _, total in film]),
        }
    return Episode(job.evaluated_under or job.corruption.corruption, job.episode, rewards, pictures, errors)


def by_part(episodes: list[Episode], parts: int) -> dict[str, dict[str, float | None]]:
    """Mean reward and action error by time within the episode, to see where policies fail.

    The longest episode is cut into at most `parts` equal parts; one that ended early counts in those that it reached.
    By first and last decision ("0-49"): mean `reward` and `action_error` (None if unknown) per decision.
    """
    longest = max(len(episode.rewards) for episode in episodes)
    parts = min(parts, longest)
    found: dict[str, dict[str, float | None]] = {}
    for first, end in pairwise(longest * part // parts for part in range(parts + 1)):
        rewards = [value for episode in episodes for value in episode.rewards[first:end]]
        errors = [value for episode in episodes for value in episode.action_errors[first:end]]
        error = float(np.mean(errors)) if errors else None
        found[f"{first}-{end - 1}"] = {"reward": float(np.mean(rewards)), "action_error": error}
    return found


def own_and_none(corruption: CorruptionConfig) -> list[CorruptionConfig]:
    """Corruptions for evaluating a policy: the one of its training, and none."""
    clean = CorruptionConfig.of("none")
    return [corruption] if corruption.corruption == clean.corruption else [corruption, clean]


def jobs_of(
    run: Path,
    task: Task,
    under: list[CorruptionConfig],
    episodes: int,
    length: int,
    film: bool = False,
    evaluated_under: str = "",
) -> list[EpisodeJob]:
    """Evaluation episodes of a run's policy under each corruption in turn. Only the very first is filmed."""
    actor = Reference.read(run).actor_file
    length = min(length, task.decisions)
    return [
        EpisodeJob(
            run / "encoder", run / "policy", task, corruption, episode, film and corruption is under[0] and not episode,
            length, actor, evaluated_under,
        )
        for corruption in under
        for episode in range(episodes)
    ]  # fmt: skip


def another(trained: dict[str, Any], corruption: str, options: dict[str, Any]) -> tuple[CorruptionConfig, str]:
    """The corruption of a name and options; missing ones are as in training, or else the defaults.

    Also its label in rows: the name with the options that differ from training, "patch, patch_size 24".
    """
    own = CorruptionConfig.fill(trained | {"corruption": corruption})
    before = flat(own)
    chosen = CorruptionConfig.of(**(before | options))
    changed = {name: value for name, value in flat(chosen).items() if value != before[name]}
    words = {name: ("no", "yes")[value] if isinstance(value, bool) else value for name, value in changed.items()}
    return chosen, ", ".join([corruption, *(f"{name} {word}" for name, word in words.items())])


def refuse_kept(run: Path, evaluated_under: str) -> None:
    """Raise UserError if rows cannot be added to a run: it is unfinished, or has rows under that corruption already."""
    if not (run / TIMING_FILE).exists():
        raise UserError(f"{run}: is not finished and still writes {EPISODES_FILE}; leave --keep out until then")
    step = policy_step(run / "policy")
    rows = [row for row in read_episodes(run / EPISODES_FILE) if row["step"] == step]
    if there := sum(row["evaluated_under"] == evaluated_under for row in rows):
        raise UserError(
            f"{run}: {EPISODES_FILE} already has {there} episodes under {evaluated_under}; leave --keep out"
        )


def evaluate_run(
    run: Path, corruption: str | None, episodes: int, workers: int, **options: Any
) -> tuple[list[dict[str, Any]], list[Episode]]:
    """Evaluate a fine-tuning run's policy again, in episodes as long as in its own evaluations.

    Args:
        run: its folder.
        corruption: name of the corruption to evaluate under, see `another`. None: the run's own, and none.
        episodes: episodes per corruption.
        workers: processes; 0: one per core.
        options: that corruption's options.

    Returns:
        Rows of `episodes.csv` (`corruption` is that of training, `step` that of the policy), and their episodes.

    Raises:
        UserError: an unknown or unsuitable corruption or option, no episodes, or a folder without an evaluated run.
    """
    refuse_number("episodes", episodes, 1, MOST_EPISODES)
    refuse_number("workers", workers, 0)
    evaluated = read_episodes(run / EPISODES_FILE)
    if not evaluated:
        raise UserError(f"{run}: holds no evaluated run; name a run of `vd4rl-pomdp finetune` with evaluations")
    (encoder, card), record = load_encoder(run / "encoder"), read_json(run / CONFIG_FILE)
    what = "this policy was trained, and it plays by the new; take the earlier code, or train it again"
    warn_of_other_code(run, record, read_record(run / "encoder").parts, what)
    under, label = own_and_none(CorruptionConfig.fill(card.corruption)), ""
    if corruption is not None:
        one, label = another(card.corruption, corruption, options)
        under = [one]
    for one in under:
        check_corruption_fits(one, FRAME_SIZE if encoder.reads_state else encoder.config.size)
    labels = {name: evaluated[0][name] for name in LABELS} | {"step": policy_step(run / "policy")}
    length = record["config"]["eval_length"]
    played = evaluate(jobs_of(run, TASKS.named(card.task), under, episodes, length, evaluated_under=label), workers)
    return episode_rows(played, labels), played


REPLAYED = ("return", "length", "score", "action_error")
"""Columns of `episodes.csv` that a replay recomputes."""


def replay(run: Path, results: Iterable[Result]) -> tuple[Row, Row, str]:
    """Replay the first episode of a run's last evaluation, whose row is in the results under the run's id.

    Returns:
        The recorded row, the replayed row, and a text on the renderers and processors behind both.

    Raises:
        UserError: as in `evaluate_run`, or the results lack this run or its policy's last evaluation.
    """
    own, step = read_run(run), policy_step(run / "policy")
    result = next((result for result in results if result.id == own.id), None)
    if result is None:
        raise UserError(f"{run}: run {own.id} has no rows in the results folder; name a run that has")
    firsts = [row for row in result.rows if row["step"] == step and row["episode"] == 0]
    recorded = next((row for row in firsts if row["evaluated_under"] == row["corruption"]), None)
    if recorded is None:
        raise UserError(
            f"{run}: its policy is from update {step}, for which the results lack run {own.id}'s first episode"
        )
    (replayed,), _ = evaluate_run(run, recorded["corruption"], 1, 1)
    made = result.files.get("render", {}), result.parts[-1].get("processor")
    row, here = (
        f"mujoco {render.get('mujoco')}, {render.get('gl_renderer')}, {processor}"
        for render, processor in (made, (render_info(recorded["task"]), machine("cpu")["processor"]))
    )
    return recorded, replayed, f"the row was made with {row}, this is {here}"

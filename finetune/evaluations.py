"""The evaluations of a fine-tuning: when they are due, under what they are played, and the rows that they leave."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from finetune.algorithms import Algorithm
from finetune.config import FinetuneConfig
from finetune.end_to_end import EndToEnd
from finetune.evaluation import EpisodeJob, episode_rows, evaluate, own_and_none
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data.reference import Reference
from vd4rl_pomdp.nn.encoder import EncoderCard
from vd4rl_pomdp.nn.encoder_folder import save_encoder
from vd4rl_pomdp.runs import EPISODES_FILE, FILM_FILE, interrupt
from vd4rl_pomdp.runs.episodes import append_episodes, drop_episodes_after, episodes_until, read_episodes
from vd4rl_pomdp.runs.files import Row, replacing_file
from vd4rl_pomdp.runs.loop import Loop
from vd4rl_pomdp.runs.metrics import EVALUATION
from vd4rl_pomdp.runs.run import remedy

POLICY = ("policy/config.json", "policy/model.safetensors")
"""A policy's files, below the folder of its run."""


@dataclass(frozen=True)
class Evaluations:
    """Those of one run."""

    run: Path
    config: FinetuneConfig
    card: EncoderCard
    reference: Reference

    @property
    def _rows(self) -> Path:
        return self.run / EPISODES_FILE

    def require(self, step: int) -> None:
        """Raise UserError if rows of an evaluation before a step are gone: the run would end without them."""
        found = Counter(row["step"] for row in episodes_until(self._rows, step))
        due = range(self.config.eval_every, step, self.config.eval_every)
        missing = [step for step in due if found[step] < self.config.eval_episodes]
        if missing:
            raise UserError(
                f"{self._rows}: lacks the evaluation at update {missing[0]}; restore it or start another run"
            )

    def require_all(self) -> None:
        """Raise UserError unless a finished run has the rows of its evaluations, the last one's played as trained."""
        self.require(self.config.updates)
        own = self.card.corruption["corruption"]
        last = [row for row in read_episodes(self._rows) if row["step"] == self.config.updates]
        if sum(row["evaluated_under"] == own for row in last) < self.config.eval_episodes:
            raise UserError(f"{self._rows}: lacks rows of the last evaluation; {remedy(self.run)}")

    def drop_after(self, step: int) -> None:
        """Forget the rows of evaluations after a step."""
        drop_episodes_after(self._rows, step)

    def carry_out(self, step: int, algorithm: Algorithm | EndToEnd, loop: Loop) -> None:
        """Keep the policy of a step, evaluate it, unless that is done, and log the scores.

        Its checkpoint is kept: while it plays, a signal need not wait.

        Raises:
            FloatingPointError: a weight is not finite.
        """
        with interrupt.deferred(False):
            self._keep(step, algorithm, loop)
            if not self._at(step):
                self._play(step, loop)
        row = scores_by_corruption(self._at(step))
        loop.log_evaluation(row)
        loop.show(score=row[f"{EVALUATION}score/{self._under(step)[0].corruption}"])

    def _at(self, step: int) -> list[Row]:
        """The rows of the evaluation at a step; none if there is none or the run was cut while it went on."""
        rows = [row for row in read_episodes(self._rows) if row["step"] == step]
        return rows if len(rows) == len(self._under(step)) * self.config.eval_episodes else []

    def _under(self, step: int) -> list[CorruptionConfig]:
        """The corruptions of the evaluation at a step; the run's own comes first."""
        own = CorruptionConfig.fill(self.card.corruption)
        clean = self.config.eval_clean and step == self.config.updates
        return own_and_none(own) if clean else [own]

    def _keep(self, step: int, algorithm: Algorithm | EndToEnd, loop: Loop) -> None:
        """Write the policy, with the encoder if that was trained along."""
        for part in [algorithm.policy] + ([algorithm.encoder] if isinstance(algorithm, EndToEnd) else []):
            loop.require_finite(part)
        algorithm.policy.save(self.run / "policy", step)
        if isinstance(algorithm, EndToEnd):
            save_encoder(self.run / "encoder", algorithm.encoder, self.card)

    def _play(self, step: int, loop: Loop) -> None:
        """Keep a film of the first episode, then append the rows of all."""
        self.drop_after(step - 1)
        episodes = evaluate(self._jobs(step), self.config.workers)
        rows = episode_rows(episodes, labels(self.config, self.card) | {"step": step})
        if episodes[0].film is not None:
            with replacing_file(self.run / FILM_FILE) as fresh, fresh.open("wb") as file:
                np.savez_compressed(file, **episodes[0].film)  # type: ignore[arg-type]
        append_episodes(self._rows, rows)

    def _jobs(self, step: int) -> list[EpisodeJob]:
        task, under = TASKS.named(self.card.task), self._under(step)
        return [
            EpisodeJob(
                encoder=self.run / "encoder",
                policy=self.run / "policy",
                task=task,
                corruption=corruption,
                episode=episode,
                film=episode == 0 and corruption is under[0],
                length=min(self.config.eval_length, task.decisions),
                actor=self.reference.actor_file,
            )
            for corruption in under
            for episode in range(self.config.eval_episodes)
        ]


def scores_by_corruption(rows: list[Row]) -> dict[str, float]:
    """Mean return and score of an evaluation's episodes, by the corruption they were played under: a row of metrics."""
    return {
        f"{EVALUATION}{measure}/{under}": float(
            np.mean([row[measure] for row in rows if row["evaluated_under"] == under])
        )
        for under in dict.fromkeys(row["evaluated_under"] for row in rows)
        for measure in ("return", "score")
    }


def labels(config: FinetuneConfig, card: EncoderCard) -> dict[str, Any]:
    """The columns that name a run's rows."""
    return {
        "method": card.method,
        "task": card.task,
        "quality": card.quality,
        "corruption": card.corruption["corruption"],
        "algorithm": config.algorithm,
        "seed": config.seed,
    }

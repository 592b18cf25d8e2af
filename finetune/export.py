"""From a finished fine-tuning to an agent's folder (`vd4rl_pomdp.agents`), its episodes played as it was rounded."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

from finetune.evaluation import episode_rows, evaluate, jobs_of, own_and_none
from vd4rl_pomdp.agents import AgentCard, read_card, write_card, write_rounded
from vd4rl_pomdp.core.errors import UserError, refuse_number
from vd4rl_pomdp.core.options import LABELS
from vd4rl_pomdp.core.tasks import MOST_EPISODES, TASKS
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data.parity import render_info
from vd4rl_pomdp.nn.encoder_folder import read_record
from vd4rl_pomdp.runs.files import Row, holds_anything
from vd4rl_pomdp.runs.outputs import refuse_inside
from vd4rl_pomdp.runs.provenance import machine
from vd4rl_pomdp.runs.results import read_run

KEPT = ("episode", "episode_seed", "return", "length", "score", "evaluated_under")
"""Columns of `episodes.csv` in a card."""


def export_agent(run: Path, out: Path, episodes: int = 10, workers: int = 0) -> AgentCard:
    """Round a run's encoder and policy to half precision, play them, and write both and the card as an agent's folder.

    Args:
        run: folder of a finished fine-tuning.
        out: folder to make; an empty one will do.
        episodes: how many to play, under the corruption of training and under none.
        workers: processes, 0 for every core.

    Raises:
        UserError: `run` is no finished fine-tuning or is damaged, or `out` holds something.
    """
    refuse_number("episodes", episodes, 1, MOST_EPISODES)
    refuse_number("workers", workers, 0)
    refuse_inside(out)
    if holds_anything(out):
        raise UserError(f"{out}: is not empty; choose another --out")
    told = read_run(run)
    if told.record["stage"] != "finetune" or not told.finished or told.diverged:
        raise UserError(f"{run}: is no finished fine-tuning; name a folder that `vd4rl-pomdp finetune` wrote")
    encoder, config = read_record(run / "encoder"), told.record["config"]
    about = encoder.pretrain
    write_rounded(run, out)
    card = AgentCard(
        **{name: told.labels[name] for name in LABELS if name != "corruption"},
        data=str(told.record["inputs"]["data"]),
        corruption=about.corruption,
        budget={
            "pretraining": {"preset": about.preset, "steps": about.steps, "frames": encoder.frames, "seed": about.seed},
            "finetuning": {"preset": config["preset"], "updates": told.files["timing"].get("updates")},
        },
        run=told.id,
        length=min(config["eval_length"], TASKS.named(about.task).decisions),
        episodes=[],
        commit=told.commit,
        render=render_info(about.task),
        processor=machine("cpu")["processor"],
        sha256={},
    )
    under = own_and_none(CorruptionConfig.fill(about.corruption))
    card = replace(card, episodes=_played(out, card, under, episodes, workers))
    write_card(out, card)
    return card


def replay_agent(folder: Path) -> Row:
    """What the first episode of an agent's card gives here."""
    card = read_card(folder)
    return _played(folder, card, [CorruptionConfig.fill(card.corruption)], 1, 1)[0]


def _played(folder: Path, card: AgentCard, under: list[CorruptionConfig], episodes: int, workers: int) -> list[Row]:
    """Rows of a card: so many episodes under each corruption in turn."""
    jobs = jobs_of(folder, TASKS.named(card.task), under, episodes, card.length)
    rows = episode_rows(evaluate(jobs, workers), asdict(card))
    return [{name: row[name] for name in KEPT} for row in rows]

"""Export a finished fine-tuning as an agent's folder (`vd4rl_pomdp.agents`), re-evaluated after rounding to float16."""

from __future__ import annotations

from pathlib import Path

from finetune.evaluation import Episode, episode_rows, evaluate, jobs_of, own_and_none
from vd4rl_pomdp.agents import CARD, checksums, find_agent, write_rounded
from vd4rl_pomdp.core.errors import UserError, refuse_number
from vd4rl_pomdp.core.options import LABELS
from vd4rl_pomdp.core.tasks import MOST_EPISODES, TASKS
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data.parity import render_info
from vd4rl_pomdp.nn.encoder_folder import read_record
from vd4rl_pomdp.runs.files import Row, read_json, write_json
from vd4rl_pomdp.runs.outputs import built
from vd4rl_pomdp.runs.provenance import machine
from vd4rl_pomdp.runs.results import read_run

KEPT = ("episode", "episode_seed", "return", "length", "score", "evaluated_under")
"""Columns of `episodes.csv` in a card."""


def export_agent(run: Path, out: Path, episodes: int = 10, workers: int = 0) -> Row:
    """Round a run's encoder and policy to float16, evaluate them, and write both and a card as an agent's folder.

    As many episodes are under the training corruption as under none. UserError if the run is no finished fine-tuning or
    is damaged, or `out` is not empty.
    """
    refuse_number("episodes", episodes, 1, MOST_EPISODES)
    refuse_number("workers", workers, 0)
    with built(out) as made:
        trained = read_run(run)
        if trained.record["stage"] != "finetune" or not trained.finished or trained.diverged:
            raise UserError(
                f"{run}: is not a finished fine-tuning run; name a folder that `vd4rl-pomdp finetune` wrote"
            )
        encoder, config = read_record(run / "encoder"), trained.record["config"]
        about = encoder.pretrain
        length = min(config["eval_length"], TASKS.named(about.task).decisions)
        under = own_and_none(CorruptionConfig.fill(about.corruption))
        write_rounded(run, made)
        data = {"data": trained.record["inputs"]["data"], "quality": trained.labels["quality"]}
        before = {name: value for name in data if (value := getattr(about, name)) != data[name]}
        card = {name: trained.labels[name] for name in LABELS} | {
            "data": data["data"],
            "corruption": about.corruption,
            "budget": {
                "pretraining": {
                    "preset": about.preset,
                    "steps": about.steps,
                    "frames": encoder.frames,
                    "seed": about.seed,
                    **before,  # of the encoder, if the policy was trained on other data
                },
                "finetuning": {"preset": config["preset"], "updates": trained.files["timing"].get("updates")},
            },
            "run": trained.id,
            "commit": trained.commit,
            "length": length,
            "episodes": _played(made, trained.labels, length, under, episodes, workers),
            "render": render_info(about.task),
            "processor": machine("cpu")["processor"],
            "sha256": checksums(made),
        }
        write_json(made / CARD, card)
    return card


def replay_agent(folder: Path) -> Row:
    """Replay the first episode of an agent's card; returns its row."""
    card = read_json(folder / CARD)
    return _played(folder, card, card["length"], [CorruptionConfig.fill(card["corruption"])], 1, 1)[0]


def play_agents(names: list[str], episodes: int = 10, workers: int = 0) -> tuple[list[Row], list[list[Episode]]]:
    """Play the same episodes with several agents, as long and under the corruption as the first one's card tells.
    First episodes are filmed.

    Returns the cards of the agents (shipped ones, or folders) and each one's episodes. UserError if none is named, one
    is unknown or damaged, or their tasks differ.
    """
    if not names:
        raise UserError("no agents given: name a shipped agent or a folder")
    refuse_number("episodes", episodes, 1, MOST_EPISODES)
    refuse_number("workers", workers, 0)
    found = [find_agent(name) for name in names]
    cards = [card for _, card in found]
    if len({card["task"] for card in cards}) > 1:
        raise UserError(f"agents must have the same task, not {' and '.join(card['task'] for card in cards)}")
    first = cards[0]
    task, under = TASKS.named(first["task"]), [CorruptionConfig.fill(first["corruption"])]
    jobs = [job for folder, _ in found for job in jobs_of(folder, task, under, episodes, first["length"], film=True)]
    played = evaluate(jobs, workers)
    return cards, [played[start : start + episodes] for start in range(0, len(played), episodes)]


def _played(
    folder: Path, labels: Row, length: int, under: list[CorruptionConfig], episodes: int, workers: int
) -> list[Row]:
    """A card's rows: the given number of episodes under each corruption in turn."""
    jobs = jobs_of(folder, TASKS.named(labels["task"]), under, episodes, length)
    return [{name: row[name] for name in KEPT} for row in episode_rows(evaluate(jobs, workers), labels)]

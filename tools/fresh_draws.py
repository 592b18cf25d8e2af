"""How much of a policy's action error on the data's path is one of training?

    python tools/fresh_draws.py --runs RUN/finetune-td3_bc ... --out fresh_draws.csv

`reference.json` tells the error on the first of the views (draws of shift and corruption) that the policy's cached
features were made of. Here it is measured on that one again, and on the first that it has never seen.
The sets are opened where the runs' records say, from the present folder. Columns: what names the run, its number of
views, whether the policy was trained on the view, the view's number, and the mean squared difference from the actor.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from script import run_script

from finetune.features import FrozenEncoder
from finetune.trainer import path_error
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.options import LABELS
from vd4rl_pomdp.corruptions import CorruptionConfig
from vd4rl_pomdp.data import open_dataset
from vd4rl_pomdp.data.reference import Reference
from vd4rl_pomdp.nn import load_encoder
from vd4rl_pomdp.nn.policy import load_policy
from vd4rl_pomdp.policies.actor import read_actor
from vd4rl_pomdp.runs.files import Row, write_csv
from vd4rl_pomdp.runs.outputs import refuse_inside
from vd4rl_pomdp.runs.results import read_records


@dataclass(frozen=True)
class Config:
    """Settings of the measurement."""

    runs: tuple[Path, ...]
    """Finished fine-tunings on cached features of sets that one known actor made."""
    out: Path = Path("fresh_draws.csv")
    """CSV file to write."""


def errors(folder: Path) -> list[Row]:
    """One row for a view that the policy was trained on, and one for a view that it has not seen."""
    config = read_records(folder).record["config"]
    actor = Reference.read(folder).actor_file
    if actor is None or not config.get("views"):
        raise UserError(f"{folder}: has no cached features, or no single actor made its set")
    dataset = open_dataset(Path(config["data"]))
    encoder, card = load_encoder(folder / "encoder")
    hiding = CorruptionConfig.fill(card.corruption)
    seed = config["seed"] if config.get("view_seed") is None else config["view_seed"]
    frozen = FrozenEncoder(encoder, dataset, hiding, config["shift"], config["precision"], seed)
    policy, shown = load_policy(folder / "policy"), read_actor(actor)
    named = {"method": card.method, "task": dataset.task, "quality": dataset.quality}
    named |= {"corruption": hiding.corruption, "algorithm": config["algorithm"], "seed": config["seed"]}

    def row(view: int) -> Row:
        drawn = frozen.view(view)
        seen = [frozen.episode(number, drawn) for number in range(dataset.num_episodes)]  # draws follow one another
        error = path_error(dataset, shown, seen.__getitem__, policy)
        told: dict[str, Any] = {"views": config["views"], "trained_on": view < config["views"], "view": view}
        return named | told | {"action_error": round(error, 6)}

    return [row(view) for view in (0, config["views"])]


def main(config: Config) -> None:
    """Measure and write."""
    refuse_inside(config.out)
    rows = [row for folder in config.runs for row in errors(folder)]
    write_csv(config.out, (*LABELS, "views", "trained_on", "view", "action_error"), rows)


if __name__ == "__main__":
    run_script(main, Config)

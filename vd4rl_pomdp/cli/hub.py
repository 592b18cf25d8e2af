"""`vd4rl-pomdp hub`: encoders, agents and data sets to and from the Hugging Face Hub; `agents`: those of one's own."""

from __future__ import annotations

from pathlib import Path

import tyro

from vd4rl_pomdp import hub
from vd4rl_pomdp.cli.parsing import command


@command
def push(
    folder: tyro.conf.Positional[Path],
    repository: tyro.conf.Positional[str],
    private: bool = False,
    revision: str = "main",
    license: str = "mit",
) -> None:
    """Write an encoder, an agent or a data set to the Hub as one commit; endpoint and token are huggingface_hub's.

    Args:
        folder: RUN/encoder, what `agents export` wrote, or the folder of a data set.
        repository: OWNER/NAME for an encoder or agent, datasets/OWNER/NAME for a data set; made if there is none.
        private: Make it private.
        revision: Branch to write to; made if there is none.
        license: Licence that its card names, as the Hub spells it.
    """
    print(hub.push(folder, repository, private, revision, license))


@command
def pull(repository: tyro.conf.Positional[str], folder: tyro.conf.Positional[Path], revision: str = "main") -> None:
    """Fetch an encoder, an agent or a data set that `hub push` wrote, and check it; re-run to resume.

    Args:
        repository: OWNER/NAME for an encoder or agent, datasets/OWNER/NAME for a data set.
        folder: Folder to make; an empty one will do.
        revision: Branch, tag or commit.
    """
    fetched = hub.pull(repository, folder, revision)
    print(f"{folder}: {'fetched and checked' if fetched else 'is there already, and right'}")


@command
def export(run: tyro.conf.Positional[Path], out: Path, episodes: int = 10, workers: int = 0) -> None:
    """Write a fine-tuned run's encoder and policy as an agent's folder: half precision, a card, checksums.

    Args:
        run: Folder of a finished fine-tuning.
        out: Folder to make; an empty one will do.
        episodes: Episodes that the rounded agent plays for its card, under its corruption and under none.
        workers: Processes; 0 uses every core.
    """
    from finetune.export import export_agent

    card = export_agent(run, out, episodes, workers)
    for under in dict.fromkeys(row["evaluated_under"] for row in card["episodes"]):
        returns = [row["return"] for row in card["episodes"] if row["evaluated_under"] == under]
        print(f"{len(returns)} episodes under {under}: mean return {sum(returns) / len(returns):.4f}")
    print(f'agent: {out}, loaded by vd4rl_pomdp.load_agent("{out}")')

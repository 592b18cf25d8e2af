"""`vd4rl-pomdp hub`: upload and download encoders, agents and datasets; `agents`: export and play local ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tyro

from vd4rl_pomdp.cli.parsing import command
from vd4rl_pomdp.core.errors import UserError, refuse_no_folder
from vd4rl_pomdp.core.text import counted, one_line
from vd4rl_pomdp.report.stats import mean_interval, with_interval
from vd4rl_pomdp.runs.files import write_bytes
from vd4rl_pomdp.runs.outputs import refuse_inside


@command
def push(
    folder: tyro.conf.Positional[Path],
    repository: tyro.conf.Positional[str],
    private: bool = False,
    revision: str = "main",
    license: str = "mit",
) -> None:
    """Upload an encoder, an agent or a dataset to the Hugging Face Hub in one commit.

    Endpoint and token are those of huggingface_hub.

    Args:
        folder: RUN/encoder, an agent from `agents export`, or a dataset folder.
        repository: OWNER/NAME for an encoder or agent, datasets/OWNER/NAME for a dataset; created if missing.
        private: Make it private.
        revision: Branch to write to; created if missing.
        license: Licence for its card, as the Hub spells it.
    """
    from vd4rl_pomdp import hub

    print(hub.push(folder, repository, private, revision, license))


@command
def pull(repository: tyro.conf.Positional[str], folder: tyro.conf.Positional[Path], revision: str = "main") -> None:
    """Download and check an encoder, an agent or a dataset that `hub push` uploaded; re-run to resume.

    Args:
        repository: OWNER/NAME for an encoder or agent, datasets/OWNER/NAME for a dataset.
        folder: New or empty folder.
        revision: Branch, tag or commit.
    """
    from vd4rl_pomdp import hub

    fetched = hub.pull(repository, folder, revision)
    print(f"{folder}: {'downloaded and verified' if fetched else 'already present and verified'}")


@command
def export(run: tyro.conf.Positional[Path], out: Path, episodes: int = 10, workers: int = 0) -> None:
    """Export a fine-tuned run's encoder and policy as an agent: half precision, a card, checksums.

    Args:
        run: Folder of a finished fine-tuning run.
        out: New or empty folder.
        episodes: Episodes played by the exported agent for its card, with and without its corruption.
        workers: Worker processes; 0 uses every core.
    """
    from finetune.export import export_agent

    card = export_agent(run, out, episodes, workers)
    for under in dict.fromkeys(row["evaluated_under"] for row in card["episodes"]):
        returns = [row["return"] for row in card["episodes"] if row["evaluated_under"] == under]
        print(f"{counted(len(returns), 'episode')} under {under}: mean return {sum(returns) / len(returns):.4f}")
    print(f'agent: {out}, loaded by vd4rl_pomdp.load_agent("{out}")')


@command
def play(
    agents: tyro.conf.Positional[list[str]], episodes: int = 10, film: Path | None = None, workers: int = 0
) -> None:
    """Play the same episodes with several agents of one task, with the corruption and length of the first one's card:
    returns and a video.

    Args:
        agents: One or more names of shipped agents, or folders from `agents export` and `hub pull`.
        episodes: Episodes per agent; episode i has the same initial state for all.
        film: File to write (animated WebP): each agent's first episode as it sees it.
        workers: Worker processes; 0 uses every core.
    """
    from finetune.export import play_agents

    if film:
        refuse_inside(film)
        refuse_no_folder(film.parent)
        if film.suffix != ".webp" or film.is_dir():
            raise UserError(f"{film}: films are animated WebP; name a file that ends in .webp")
    cards, played = play_agents(agents, episodes, workers)
    under, count = cards[0]["corruption"]["corruption"], counted(episodes, "episode")
    print(f"{count} of {cards[0]['task']} under {under}: mean return [95% t interval over episodes]")
    returns = [np.array([episode.total for episode in one])[:, None] for one in played]
    about = [f"{card['method']}, seed {card['seed']}" for card in cards]
    names = [name if about.count(name) == 1 else given for name, given in zip(about, agents, strict=True)]
    lines = list(zip(names, returns, strict=True))
    lines += [(f"{names[0]} less {name}", returns[0] - others) for name, others in lines[1:]]
    for name, values in lines:
        low, high = mean_interval(values) or (None, None)
        print(f"  {one_line(name):<38} {with_interval(values.mean(), low, high, 0)}")
    if film:
        from vd4rl_pomdp.report.films import side_by_side

        write_bytes(film, side_by_side(names, [one[0].film for one in played if one[0].film is not None]))
        print(f"film: {film}")

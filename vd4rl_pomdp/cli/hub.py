"""`vd4rl-pomdp hub`: encoders and data sets to and from the Hugging Face Hub."""

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
    """Write an encoder or a data set to the Hub as one commit; endpoint and token are huggingface_hub's.

    Args:
        folder: RUN/encoder, or the folder of a data set.
        repository: OWNER/NAME for an encoder, datasets/OWNER/NAME for a data set; made if there is none.
        private: Make it private.
        revision: Branch to write to; made if there is none.
        license: Licence that its card names, as the Hub spells it.
    """
    print(hub.push(folder, repository, private, revision, license))


@command
def pull(repository: tyro.conf.Positional[str], folder: tyro.conf.Positional[Path], revision: str = "main") -> None:
    """Fetch an encoder or a data set that `hub push` wrote, and check it; re-run the same command to resume.

    Args:
        repository: OWNER/NAME for an encoder, datasets/OWNER/NAME for a data set.
        folder: Folder to make; an empty one will do.
        revision: Branch, tag or commit.
    """
    fetched = hub.pull(repository, folder, revision)
    print(f"{folder}: {'fetched and checked' if fetched else 'is there already, and right'}")

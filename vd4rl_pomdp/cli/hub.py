"""`vd4rl-pomdp hub`: encoders and data sets to and from the Hugging Face Hub."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from vd4rl_pomdp.cli.dispatch import Arguments, Command
from vd4rl_pomdp.cli.parsing import parse


@dataclass(frozen=True)
class PushCommand:
    """Write an encoder or a data set to the Hub as one commit; endpoint and token are huggingface_hub's."""

    folder: tyro.conf.Positional[Path]
    """RUN/encoder, or the folder of a data set."""
    repository: tyro.conf.Positional[str]
    """OWNER/NAME for an encoder, datasets/OWNER/NAME for a data set; made if there is none."""
    private: bool = False
    """Make it private."""
    revision: str = "main"
    """Branch to write to; made if there is none."""
    license: str = "mit"
    """Licence that its card names, as the Hub spells it."""


def _push(words: Arguments, program: str) -> None:
    command = parse(PushCommand, words, program)
    from vd4rl_pomdp.hub import Repository, push

    repository = Repository.named(command.repository)
    print(push(command.folder, repository, command.private, command.revision, command.license))


@dataclass(frozen=True)
class PullCommand:
    """Fetch an encoder or a data set that `hub push` wrote, and check it; a cut pull goes on where it was."""

    repository: tyro.conf.Positional[str]
    """OWNER/NAME for an encoder, datasets/OWNER/NAME for a data set."""
    folder: tyro.conf.Positional[Path]
    """Folder to make; an empty one will do."""
    revision: str = "main"
    """Branch, tag or commit."""


def _pull(words: Arguments, program: str) -> None:
    command = parse(PullCommand, words, program)
    from vd4rl_pomdp.hub import Repository, pull

    fetched = pull(Repository.named(command.repository), command.folder, command.revision)
    print(f"{command.folder}: {'fetched and checked' if fetched else 'is there already, and right'}")


COMMANDS = {
    "push": Command("write an encoder or a data set to the Hugging Face Hub", _push),
    "pull": Command("fetch and check what was pushed", _pull),
}

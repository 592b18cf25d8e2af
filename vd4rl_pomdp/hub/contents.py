"""What a repository of the Hub holds: an encoder or a data set, and the listing by which a pull judges it."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path

from vd4rl_pomdp.core.errors import UnavailableError, UserError
from vd4rl_pomdp.core.reading import build
from vd4rl_pomdp.data.card import set_card
from vd4rl_pomdp.data.folder import is_shard_name, join_shards, shard_files, shard_paths
from vd4rl_pomdp.data.format import read_frame_size, read_rows
from vd4rl_pomdp.hub.repository import ENCODER, SET, Repository
from vd4rl_pomdp.nn.encoder_folder import CONFIG, WEIGHTS, load_encoder, read_record
from vd4rl_pomdp.nn.model_card import CARD, model_card
from vd4rl_pomdp.runs.files import read_json, sha256, write_bytes
from vd4rl_pomdp.runs.outputs import kept_in

LISTING = "vd4rl_pomdp.json"
"""Name of the listing beside the files."""
_FORMAT = 1
_ENCODER_FILES = {CONFIG, WEIGHTS}
_SET_SUFFIXES = (".json", ".md", ".png")


@dataclass(frozen=True)
class Listing:
    """What a repository holds."""

    format: int
    kind: str
    sha256: dict[str, str]
    """Of each file by its name."""
    license: str = ""
    """That its owner gives it, as the Hub spells it; empty in a listing of an earlier version, which names none."""

    @classmethod
    def of(cls, files: list[Path], kind: str, license: str) -> Listing:
        """The listing of files of a folder, under a licence."""
        return cls(_FORMAT, kind, {file.name: sha256(file) for file in files}, license)

    @classmethod
    def read(cls, path: Path, repository: Repository) -> Listing:
        """Read what a repository sent.

        Raises:
            UserError: it is damaged, of another version or of another kind than the repository's.
        """
        try:
            listing = build(cls, read_json(path))
            listing._check(repository)
        except UnavailableError:
            raise
        except (UserError, TypeError, ValueError) as error:
            raise UserError(f"{repository}: its {LISTING} is of another version or damaged; ask its owner") from error
        return listing

    def _check(self, repository: Repository) -> None:
        """Raise ValueError unless it is of this format and of a repository's kind, and names what that kind has."""
        names = self.sha256.keys()
        if self.kind == ENCODER:
            fits = names == _ENCODER_FILES
        else:
            fits = all(map(_is_name_of_set, names)) and any(map(is_shard_name, names))
        told = all(isinstance(digest, str) for digest in self.sha256.values())
        if (self.format, self.kind) != (_FORMAT, repository.kind) or not (fits and told):
            raise ValueError(json.dumps(asdict(self)))


def checked(folder: Path, repository: Repository, license: str) -> tuple[list[Path], str]:
    """The files of what a folder holds, and its card; raises UserError unless it is whole and of the right kind."""
    kind = _kind(folder)
    if kind not in (ENCODER, SET):
        raise UserError(f"{folder}: holds neither an encoder nor a data set; name RUN/encoder or a folder of shards")
    if kind != repository.kind:
        form = "datasets/OWNER/NAME" if kind == SET else "OWNER/NAME"
        raise UserError(f"{folder}: holds {kind}, which goes to {form}; {repository} is the name for {repository.kind}")
    _check(folder, kind)
    if kind == ENCODER:
        card = model_card(read_record(folder), repository.name, license)
        return [folder / name for name in sorted(_ENCODER_FILES)], card
    names = sorted(path.name for path in folder.iterdir() if path.is_file() and _is_name_of_set(path.name))
    return [folder / name for name in names], set_card(folder, repository.name, license)


def _kind(folder: Path) -> str | None:
    """What a folder holds; files that are called shards make a set, so that it is told what is wrong with them."""
    kind = kept_in(folder)
    return SET if kind is None and shard_files(folder) else kind


def _check(folder: Path, kind: str) -> None:
    """Raise UserError for an encoder that does not load, or a set whose rows, frames apart, are not whole."""
    if kind == ENCODER:
        load_encoder(folder)
    else:
        shards = shard_paths(folder)
        read_frame_size(shards)
        join_shards(folder, shards, [read_rows(shard) for shard in shards])


def _is_name_of_set(name: str) -> bool:
    """Whether a set may have a file of a name: no folder's, no hidden one, no README of another maker."""
    told = name.endswith(_SET_SUFFIXES) and not name.startswith(".") and name != CARD
    return Path(name).name == name and (is_shard_name(name) or told)


def is_there(folder: Path, listing: Listing) -> bool:
    """Whether a folder holds what a listing lists, and no shard that would make it another set."""
    shards = {path.name for path in shard_files(folder)}
    return shards <= listing.sha256.keys() and all(
        (folder / n).is_file() and sha256(folder / n) == digest for n, digest in listing.sha256.items()
    )


def accept(content: Path, listing: Listing, repository: Repository) -> None:
    """Check what was sent, and complete it; files that are damaged go, so that the next pull fetches them anew."""
    wrong = [name for name, digest in listing.sha256.items() if sha256(content / name) != digest]
    for name in wrong:
        (content / name).unlink()
    if wrong:
        raise UserError(f"{repository}: {wrong[0]} has a wrong SHA-256 and was removed; pull again, or ask its owner")
    for path in list(content.iterdir()):
        if path.name not in listing.sha256:  # of huggingface_hub, or of a cut pull of another repository
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    _check(content, listing.kind)
    if listing.kind == ENCODER:
        write_bytes(content / CARD, model_card(read_record(content), license=listing.license).encode())

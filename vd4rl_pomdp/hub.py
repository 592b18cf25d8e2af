"""Push and pull encoders, agents and data sets to and from the Hugging Face Hub, with huggingface_hub.

`push` adds a listing, vd4rl_pomdp.json: the kind, the licence and the SHA-256 of every file, which `pull` verifies.
Encoders and agents are model repositories, OWNER/NAME; data sets are datasets/OWNER/NAME, as in the Hub's URLs.
Endpoint and token are those of huggingface_hub: HF_ENDPOINT, HF_TOKEN, `hf auth login`.
"""

from __future__ import annotations

import glob
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from huggingface_hub import HfApi
from huggingface_hub.errors import HfHubHTTPError, HTTPError, LocalEntryNotFoundError, OfflineModeIsEnabled
from huggingface_hub.utils import disable_progress_bars

from vd4rl_pomdp import __version__, agents
from vd4rl_pomdp.core.errors import UserError, disk_errors, in_one_line
from vd4rl_pomdp.core.reading import inside, read_bytes
from vd4rl_pomdp.core.text import code, code_block, one_line
from vd4rl_pomdp.data.folder import is_shard_name, read_set, shard_files, shard_paths, task_and_quality
from vd4rl_pomdp.data.format import read_attributes
from vd4rl_pomdp.nn.encoder_folder import (
    CARD,
    CONFIG,
    LICENSE,
    TAGS,
    WEIGHTS,
    front_matter,
    load_encoder,
    model_card,
    read_record,
)
from vd4rl_pomdp.runs.files import read_json, sha256, write_bytes, write_json
from vd4rl_pomdp.runs.outputs import kept_in, refuse_inside, refuse_mount

LISTING = "vd4rl_pomdp.json"
ENCODER, AGENT, SET = "an encoder", "an agent", "a data set"
"""Kinds of repository, named as by `runs.outputs.kept_in`."""
_FORMAT = 1
_FILES = {ENCODER: (CONFIG, WEIGHTS), AGENT: (*agents.FILES, agents.CARD)}
_MODEL = [name for names in _FILES.values() for name in names]
_BESIDE_SHARDS = (".json", ".md", ".png")
"""Suffixes of a dataset's other files."""
_SHARDS = ["*.hdf5", "*.HDF5", "*.h5", "*.H5"]
_PATTERNS = {ENCODER: _MODEL, AGENT: _MODEL, SET: [*_SHARDS, *(f"*{suffix}" for suffix in _BESIDE_SHARDS)]}
"""Files of each kind: a push replaces all of these and leaves the repository's other files alone."""


def push(folder: Path, repository: str, private: bool = False, revision: str = "main", license: str = LICENSE) -> str:
    """Push an encoder, an agent or a data set as one commit; returns the commit's URL.

    The `repository`, OWNER/NAME or datasets/OWNER/NAME, and the branch `revision` are created if needed. `license` is a
    Hub identifier such as "mit". UserError if the folder holds nothing of that kind or is damaged, the repository holds
    files from elsewhere, or the Hub refuses or cannot be reached.
    """
    name, kind = _repository(repository)
    held = kept_in(folder) or (SET if shard_files(folder) else None)  # `_checked` below reports damaged shards
    kind = AGENT if (kind, held) == (ENCODER, AGENT) else kind
    if held != kind:
        raise UserError(
            f"{folder}: contains {held or 'nothing to push'}, but {repository} is a name for {kind}; pass "
            "RUN/encoder or an exported agent and OWNER/NAME, or a folder of shards and datasets/OWNER/NAME"
        )
    files = _checked(folder, kind)
    if kind == ENCODER:
        card = model_card(read_record(folder), name, license)
    else:
        card = (_set_card if kind == SET else _agent_card)(folder, name, license)
    names = {file: file.relative_to(folder).as_posix() for file in files}
    listing = {"format": _FORMAT, "kind": kind, "sha256": {n: sha256(f) for f, n in names.items()}, "license": license}
    with _hub(repository) as (api, where), tempfile.TemporaryDirectory() as staged:
        api.create_repo(**where, private=private or None, exist_ok=True)
        there = set(api.list_repo_files(**where)) - {".gitattributes", CARD}
        if there and LISTING not in there:
            raise UserError(f"{repository}: holds files that were not pushed by vd4rl-pomdp; choose another name")
        if revision != "main":
            api.create_branch(**where, branch=revision, exist_ok=True)
        for file, place in names.items():
            (Path(staged) / place).parent.mkdir(exist_ok=True)
            # A link, since a data set may not fit into the temporary folder.
            (Path(staged) / place).symlink_to(file.resolve())
        write_bytes(Path(staged) / CARD, card.encode())
        write_json(Path(staged) / LISTING, listing)
        message = f"{kind.split()[-1].capitalize()} of vd4rl-pomdp {__version__}"
        commit = api.upload_folder(
            **where, folder_path=staged, revision=revision, commit_message=message, delete_patterns=_PATTERNS[kind]
        )
    return str(commit.commit_url)


def pull(repository: str, folder: Path, revision: str = "main") -> bool:
    """Download an encoder, an agent or a data set; returns False if `folder` already holds exactly that.

    An interrupted pull is resumed. `folder` is created only when everything is downloaded and verified. `revision` is a
    branch, tag or commit. UserError if the folder holds something else, a download is damaged, or the Hub refuses or
    cannot be reached.
    """
    _, kind = _repository(repository)
    folder = Path(os.path.abspath(folder))
    refuse_inside(folder)
    staged = folder.with_name(f".{folder.name}.pull")
    with _hub(repository) as (api, where), tempfile.TemporaryDirectory() as scratch:
        downloaded = api.hf_hub_download(**where, filename=LISTING, revision=revision, local_dir=scratch)
        listing, license, kind = _read_listing(Path(downloaded), kind, repository)
        if folder.is_symlink() or (folder.exists() and (not folder.is_dir() or any(folder.iterdir()))):
            others = {shard.name for shard in shard_files(folder)} - listing.keys()  # extra shards: another data set
            if folder.is_dir() and not others and not _wrong(folder, listing):
                return False
            raise UserError(
                f"{folder}: is not empty and holds something other than {repository}; choose another folder"
            )
        refuse_mount(folder)
        # Next to the folder, so that the final rename is atomic; its fixed name lets the next pull resume.
        api.snapshot_download(**where, revision=revision, local_dir=staged, allow_patterns=[*map(glob.escape, listing)])
    with disk_errors(folder):
        if wrong := _wrong(staged, listing):
            (staged / wrong[0]).unlink(missing_ok=True)
            raise UserError(
                f"{repository}: {wrong[0]} has a wrong SHA-256 and was removed; pull again, or ask its owner"
            )
        kept = {name.partition("/")[0] for name in listing}
        for path in list(staged.iterdir()):
            if path.name not in kept:  # huggingface_hub's cache, or left by an interrupted pull of another repository
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        _checked(staged, kind)
        if kind == ENCODER:
            write_bytes(staged / CARD, model_card(read_record(staged), license=license).encode())
        staged.rename(folder)
    return True


def _repository(text: str) -> tuple[str, str]:
    """Parse OWNER/NAME (an encoder) or datasets/OWNER/NAME (a data set) into ("OWNER/NAME", kind)."""
    name = text.removeprefix("datasets/")
    if name.count("/") != 1 or not all(name.split("/")):
        raise UserError(
            f"{text!r} is not a repository: write OWNER/NAME for an encoder, datasets/OWNER/NAME for a dataset"
        )
    return name, ENCODER if name == text else SET


@contextmanager
def _hub(repository: str) -> Iterator[tuple[HfApi, dict[str, Any]]]:
    """Yield the API client and its repository arguments; turns the Hub's errors into one-line UserErrors."""
    if not sys.stderr.isatty():
        disable_progress_bars()
    name, kind = _repository(repository)
    try:
        api = HfApi(os.environ.get("HF_ENDPOINT"), library_name="vd4rl-pomdp", library_version=__version__)
        yield api, {"repo_id": name, "repo_type": "dataset" if kind == SET else "model"}
    except UserError:
        raise
    except OfflineModeIsEnabled as error:
        raise UserError("HF_HUB_OFFLINE is set, so nothing can be uploaded or downloaded; unset it") from error
    except (HfHubHTTPError, HTTPError, LocalEntryNotFoundError, RuntimeError, ValueError) as error:
        raise UserError(
            f"{repository}: the Hub refused or did not answer ({in_one_line(error)}); check the name, --revision, "
            "HF_TOKEN or `hf auth login`, and the network"
        ) from error


def _read_listing(path: Path, kind: str, repository: str) -> tuple[dict[str, str], str, str]:
    """Read a listing: (SHA-256 by file name, licence, kind); UserError if it is damaged."""
    listing = read_json(path)
    files = found if isinstance(found := listing.get("sha256"), dict) else {}
    kind = AGENT if (kind, listing.get("kind")) == (ENCODER, AGENT) else kind
    plain = all(
        Path(name).name == name and not name.startswith(".") and name != CARD and name.isprintable() for name in files
    )
    plain = plain and all(is_shard_name(name) or Path(name).suffix in _BESIDE_SHARDS for name in files)
    fits = files.keys() == set(_FILES[kind]) if kind in _FILES else plain and any(map(is_shard_name, files))
    if (listing.get("format"), listing.get("kind")) != (_FORMAT, kind) or not fits:
        raise UserError(f"{repository}: its {LISTING} is of another version or damaged; ask its owner")
    return files, str(listing.get("license", "")), kind


def _wrong(folder: Path, listing: dict[str, str]) -> list[str]:
    """Listed files that are missing from a folder or have another SHA-256."""
    return [n for n, digest in listing.items() if not (folder / n).is_file() or sha256(folder / n) != digest]


def _checked(folder: Path, kind: str) -> list[Path]:
    """Check a folder's contents and return its files; UserError if a model does not load or a data set has gaps."""
    if kind in _FILES:
        (load_encoder if kind == ENCODER else agents.load_agent)(folder)
        return [folder / name for name in _FILES[kind]]
    shards = read_set(folder).shards
    kept = [p for p in folder.iterdir() if p.suffix in _BESIDE_SHARDS and not p.name.startswith(".")]
    return sorted([*shards, *(inside(folder, path) for path in kept if path.name not in (CARD, LISTING))])


def _agent_card(folder: Path, repository: str, license: str) -> str:
    """README.md of an agent: its card and how to load it."""
    card = read_json(folder / agents.CARD)
    names = [str(card.get(name)) for name in ("method", "algorithm", "task")]
    values = {"license": license, "library_name": "vd4rl-pomdp", "pipeline_tag": TAGS[0]}
    use = ["from vd4rl_pomdp import load_agent", "", 'agent = load_agent("FOLDER")  # agent.reset(), agent.act(obs)']
    parts = (
        front_matter(values | {"tags": [*TAGS, *map(one_line, names)]}),
        ["# {} and {} on {}".format(*map(code, names))],
        ["Encoder and policy, trained offline by `vd4rl-pomdp`; weights in half precision."],
        code_block([f"vd4rl-pomdp hub pull {repository} FOLDER"], "bash"),
        code_block(use, "python"),
        code_block(json.dumps(card, indent=2).splitlines(), "json"),
    )
    return "\n".join(line for part in parts for line in (*part, ""))


def _set_card(folder: Path, repository: str, license: str) -> str:
    """README.md of a data set: its data card or, if it has none, a title from its files' attributes."""
    names, card = (
        task_and_quality(folder, [read_attributes(shard) for shard in shard_paths(folder)]),
        folder / "card.md",
    )
    title = f"# {', '.join(code(name or 'unknown') for name in names)}"
    body = read_bytes(card).decode(errors="replace").rstrip() if card.is_file() else title
    tags = [*TAGS[:2], *(one_line(name) for name in names if name)]
    use = code_block([f"vd4rl-pomdp hub pull datasets/{repository} FOLDER"], "bash")
    return "\n".join([*front_matter({"license": license, "tags": tags}), "", body, "", "## Use it", "", *use, ""])

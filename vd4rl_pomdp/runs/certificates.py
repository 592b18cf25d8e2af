"""Certificates: whether a set under a corruption needs a memory of what was seen, as `vd4rl-pomdp certify` found.

    certificates.json    certificates by id, which names the set's content and the corruption

It lies in the set's folder and beside the runs that it was measured by; results folders and reports take it along.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.runs.files import Row, content_hash, files_below, read_json, write_json

CERTIFICATES = "certificates.json"
NOT_CERTIFIED = "not certified"
_HOLDS = {"data", "corruption", "name", "verdict", "why", "made"}


def certificate_id(data: str, corruption: Mapping[str, Any]) -> str:
    """Name of what a certificate is about: the set's fingerprint, and the settings of a corruption."""
    return content_hash([data, dict(corruption)])


def read_certificates(places: Iterable[Path], but: Path | None = None) -> dict[str, Row]:
    """All certificates at or below some folders, by id; of several for one id the newest.

    Args:
        places: folders.
        but: a folder whose own file is not read.

    Raises:
        UserError: a file is damaged.
    """
    found: dict[str, Row] = {}
    for file in dict.fromkeys(file for place in places for file in files_below(place, CERTIFICATES)):
        told = {} if but is not None and file.parent.resolve() == but.resolve() else read_json(file)
        for name, one in told.items():
            if not (isinstance(one, dict) and one.keys() >= _HOLDS):
                raise UserError(f"{file}: is damaged; remove it, or write it again with `vd4rl-pomdp certify`")
            if name not in found or str(one["made"]) > str(found[name]["made"]):
                found[name] = one
    return found


def keep_certificates(folder: Path, certificates: dict[str, Row]) -> None:
    """Add certificates to a folder's own; those of an id that is there take its place. None: nothing is written."""
    file = folder / CERTIFICATES
    there = read_json(file) if file.exists() else {}
    if there | certificates != there:
        write_json(file, there | certificates)


def in_words(certificate: Row) -> str:
    """The verdict and what it rests on."""
    return f"{certificate['verdict']} ({certificate['why']})"

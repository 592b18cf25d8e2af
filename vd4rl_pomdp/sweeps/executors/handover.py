"""Jobs that are handed to processes of a cluster, and how they ended, as files on a disk that all share.

    FOLDER/work/TASK/ATTEMPT.json    a job that task number TASK is to do
    FOLDER/ended/ATTEMPT.json        how it ended

Files are written whole and never changed. Attempts are named by when they were handed over, so that names sort.
"""

from __future__ import annotations

import secrets
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from vd4rl_pomdp.core.errors import UserError, disk_errors
from vd4rl_pomdp.runs.files import jsonable, read_json, write_json
from vd4rl_pomdp.sweeps.work import Ended, Work


@dataclass(frozen=True)
class Handover:
    """The files of one array of tasks."""

    folder: Path

    def add(self, task: int, work: Work) -> str:
        """Hand a job to a task; the name of the attempt.

        Raises:
            UnavailableError: it could not be written.
        """
        attempt = f"{time.time_ns():020d}-{secrets.token_hex(3)}"
        path = self._work(task) / f"{attempt}.json"
        with disk_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, jsonable(asdict(work)))
        return attempt

    def left(self, task: int) -> dict[str, Work]:
        """What was handed to a task and has not ended, by attempt, oldest first."""
        ended = self.ended()
        return {
            name: _read(self._work(task) / f"{name}.json") for name in _names(self._work(task)) if name not in ended
        }

    def end(self, attempt: str, ended: Ended) -> None:
        """Tell how an attempt ended; raises UnavailableError if it could not be written."""
        path = self.folder / "ended" / f"{attempt}.json"
        with disk_errors(path):
            path.parent.mkdir(exist_ok=True)
        write_json(path, asdict(ended))

    def ended(self) -> set[str]:
        """Attempts that have ended."""
        return set(_names(self.folder / "ended"))

    def end_of(self, attempt: str) -> Ended:
        """How one of them did."""
        return Ended(**read_json(self.folder / "ended" / f"{attempt}.json"))

    def _work(self, task: int) -> Path:
        return self.folder / "work" / str(task)


def _names(folder: Path) -> list[str]:
    """Attempts that a folder has files of, oldest first."""
    return sorted(path.stem for path in folder.glob("*.json"))


def _read(path: Path) -> Work:
    told = read_json(path)
    try:
        return Work(**(told | {"words": tuple(told["words"]), "log": Path(told["log"])}))
    except (KeyError, TypeError) as error:
        raise UserError(f"{path}: holds no job ({error}); remove it") from error

"""Find runs in run folders and results folders, each once, and add them to a results folder."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.runs import CONFIG_FILE
from vd4rl_pomdp.runs.files import files_below, read_json
from vd4rl_pomdp.runs.outputs import refuse_foreign
from vd4rl_pomdp.runs.ownership import owned
from vd4rl_pomdp.runs.results.folder import RUNS, Result, read_results, read_run, write_results


def find_results(paths: Sequence[Path | str], but: Path | None = None) -> list[Result]:
    """Every run at or below some paths, each once: of a run folder, or else of a results folder.

    Results folders within a results folder are other experiments: they are read where they are named themselves.

    Args:
        paths: run folders, results folders, and folders that contain some.
        but: a results folder that is not read unless it is named itself.

    Raises:
        UserError: a path is missing, there is no run, two runs of one id have different rows, or a file is damaged.
    """
    if not paths:
        raise UserError("name at least one run folder, or a folder that contains some")
    found: dict[str, Result] = {}
    for run in _found([Path(path) for path in paths], but):
        other = found.get(run.id)
        found[run.id] = run if other is None else _better(other, run)
    if not found:
        raise UserError(
            f"{paths[0]}: contains no runs (a run is a folder with config.json and metrics.jsonl) and no results "
            f"folder (which holds {RUNS})"
        )
    return list(found.values())


def _found(paths: Sequence[Path], but: Path | None) -> Iterator[Result]:
    for path in paths:
        if not path.exists():
            raise UserError(f"{path}: no such folder")
    files = [p for path in paths for p in files_below(path, CONFIG_FILE)]
    yield from (read_run(file.parent) for file in dict.fromkeys(files) if "stage" in read_json(file))
    places = [place for path in paths for place in _outermost(path)]
    for place in dict.fromkeys(places):
        if but is None or place in paths or place.resolve() != but.resolve():
            yield from read_results(place)


def _outermost(path: Path) -> Iterator[Path]:
    """Results folders at or below a path that lie in no other one there."""
    places = {file.parent for file in files_below(path, RUNS)}
    return (place for place in sorted(places) if places.isdisjoint(place.parents))


def _better(one: Result, other: Result) -> Result:
    """Of two tales of one run the one that finished, else diverged; then that of its folder, then the one ahead."""
    if one.settled and _ending(one) == _ending(other) and one.measured != other.measured:
        raise UserError(f"{other.path} and {one.path}: two runs of one method, setting and seed; name one of them")
    return max(one, other, key=lambda run: (_ending(run), run.folder, len(run.measured), run.step))


def _ending(run: Result) -> int:
    """How much is told of a run's end: 0 that it has none yet, 1 that it diverged, 2 that it finished."""
    return run.settled + run.finished


class Added(NamedTuple):
    """What became of some runs."""

    added: int
    known: int
    """There already with the same rows."""
    kept: int
    """There already with other rows, which stay."""
    unfinished: int
    """Neither finished nor diverged, so left out."""

    @property
    def in_words(self) -> str:
        """One line: "2 runs added, 1 there already"."""
        told = (
            (self.known, "there already"),
            (self.kept, "there already with other rows, which stay (remove their lines to replace them)"),
            (self.unfinished, "unfinished and left out"),
        )
        return ", ".join(
            [f"{self.added} run{'s' * (self.added != 1)} added", *(f"{n} {what}" for n, what in told if n)]
        )


def add_results(paths: Sequence[Path | str], out: Path | str) -> Added:
    """Append the runs at or below some paths to a results folder, each once; no row that is there changes.

    An unfinished run of the folder, such as a report of that time keeps, gives way to the same run when it is settled,
    and one that diverged to the same run when it has finished after all.

    Raises:
        UserError: as `find_results`, or `out` holds something else, is damaged or is in use.
    """
    out = Path(out)
    refuse_foreign(out, "results", RUNS, "README.md")  # whose page may be there before the first run
    found = find_results(paths, out)
    with owned(out):
        there = {run.id: run for run in _kept(out)}
        settled = [run for run in found if run.settled]
        fresh = {run.id: run for run in settled if run.id not in there or _ending(run) > _ending(there[run.id])}
        if fresh:
            write_results(out, (there | fresh).values())
    again = [run for run in settled if run.id not in fresh]
    known = sum(run.measured == there[run.id].measured for run in again)
    return Added(len(fresh), known, len(again) - known, len(found) - len(settled))


def _kept(out: Path) -> list[Result]:
    """The runs of a results folder, none before the first."""
    return read_results(out) if (out / RUNS).exists() else []


def refuse_loss(runs: Sequence[Result], out: Path) -> None:
    """Raise UserError if writing runs as the results folder `out` would lose settled ones, or rows, that it holds."""
    there = [run for run in _kept(out) if run.settled]
    written = {run.id: run for run in runs if run.settled}
    if lost := [run for run in there if run.id not in written]:
        raise UserError(
            f"{out}: holds the results of {len(lost)} runs that would be lost; name the folder among those to report, "
            "remove it, or choose another --out"
        )
    if changed := [run for run in there if not _agree(run, written[run.id])]:
        raise UserError(
            f"{out}: holds other rows of {len(changed)} runs (such as {changed[0].id}), which would be lost; choose "
            "another --out"
        )


def _agree(kept: Result, written: Result) -> bool:
    """Whether nothing of a settled run is lost where the same run is written in its place."""
    return kept.measured == written.measured or _ending(written) > _ending(kept)

"""Run what a folder lacks of a control study, a row as each run ends."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

from vd4rl_pomdp.runs.files import Row, read_csv, write_csv
from vd4rl_pomdp.runs.outputs import refuse_foreign
from vd4rl_pomdp.runs.ownership import owned
from vd4rl_pomdp.studies.control.config import LABELS, RUN_COLUMNS, WORDS, ControlConfig
from vd4rl_pomdp.studies.control.measures import EPISODE_COLUMNS, measured

RUNS, EPISODES = "runs.csv", "episodes.csv"


def control_study(config: ControlConfig, on_run: Callable[[Row], None]) -> list[Row]:
    """Run what is missing of a study, and append its rows to OUT/runs.csv and OUT/episodes.csv.

    Args:
        config: what is to be run.
        on_run: called with the row of each run of the study, those that were run before included.

    Returns:
        All rows of OUT/runs.csv, other studies' in the same folder included, by column as text.

    Raises:
        UserError: bad settings, or a folder that holds something else or damaged files, or is another process's.
    """
    config.check()
    refuse_foreign(config.out, "control study", RUNS)
    with owned(config.out):
        runs, episodes = _read(config.out)
        _write(config.out, runs, episodes)
        for run in config.runs():
            row = next((row for row in runs if _labels(row) == tuple(run.labels.values())), None)
            if row is None:
                row, played = measured(run)
                runs, episodes = [*runs, row], [*episodes, *played]
                _write(config.out, runs, episodes)
            on_run(row)
        return _read(config.out)[0]


def _read(out: Path) -> tuple[list[Row], list[Row]]:
    """Rows of runs that are finished, and of their episodes."""
    runs, episodes = read_csv(out / RUNS, RUN_COLUMNS, WORDS), read_csv(out / EPISODES, EPISODE_COLUMNS, WORDS)
    played = Counter(map(_labels, episodes))
    whole = [row for row in runs if str(played[_labels(row)]) == row["eval_episodes"]]
    names = set(map(_labels, whole))
    return whole, [row for row in episodes if _labels(row) in names]


def _write(out: Path, runs: list[Row], episodes: list[Row]) -> None:
    """Episodes first: what has no row among the runs counts as not run."""
    write_csv(out / EPISODES, EPISODE_COLUMNS, episodes)
    write_csv(out / RUNS, RUN_COLUMNS, runs)


def _labels(row: Row) -> tuple[str, ...]:
    return tuple(row[name] for name in LABELS)

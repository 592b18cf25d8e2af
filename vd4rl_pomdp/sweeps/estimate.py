"""What jobs will take, judging by runs and sets that were finished: an estimate, for machines like those."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from statistics import median
from typing import Any

from vd4rl_pomdp.data.folder import PROVENANCE
from vd4rl_pomdp.runs.files import read_json
from vd4rl_pomdp.sweeps.found import FoundRun
from vd4rl_pomdp.sweeps.plan import Job, cost_of
from vd4rl_pomdp.sweeps.stages import STAGES

_SECTIONS = {stage: section for section, stage in STAGES.items()}
_SCALE = {
    **{"collect": "episodes", "navigation_collect": "trajectories"},
    **{"pretrain": "steps", "finetune": "updates", "navigation_train": "steps"},
}
"""Setting that the time of a stage is about proportional to."""


class Estimates:
    """Seconds by stage and settings, from past runs and sets."""

    def __init__(self, runs: Iterable[FoundRun], jobs: Iterable[Job] = ()) -> None:
        """Unfinished work tells nothing.

        Args:
            runs: past runs to judge by.
            jobs: a plan's jobs: the sets that they collected tell, too.
        """
        self._exact: dict[tuple, list[float]] = {}
        self._rates: dict[tuple, list[float]] = {}
        for run in runs:
            self._note(_SECTIONS.get(run.record["stage"]), run.settings, run.seconds)
            self._note("pretrain", run.card.get("settings", {}), run.encoder_seconds)
        for job in jobs:
            if job.section not in STAGES and (job.folder / PROVENANCE).is_file():
                self._note(job.section, dict(job.settings), read_json(job.folder / PROVENANCE).get("seconds"))

    def _note(self, section: str | None, settings: Mapping[str, Any], seconds: float | None) -> None:
        if section and seconds is not None:
            self._exact.setdefault((section, cost_of(settings)), []).append(seconds)
            if amount := settings.get(_SCALE[section]):
                for kind in _kinds(section, settings):
                    self._rates.setdefault(kind, []).append(seconds / float(amount))

    def seconds(self, job: Job) -> float | None:
        """What a job takes from its beginning; None if no run tells."""
        if known := self._exact.get((job.section, job.settings)):
            return median(known)
        amounts = dict(job.settings)
        rates = next((self._rates[kind] for kind in _kinds(job.section, amounts) if kind in self._rates), None)
        return median(rates) * float(amounts.get(_SCALE[job.section], 1)) if rates else None


def _kinds(section: str, settings: Mapping[str, Any]) -> tuple[tuple, tuple]:
    """What a job's pace goes by: its stage with its method, for some train nothing, or else its stage alone."""
    return (section, settings.get("method")), (section,)

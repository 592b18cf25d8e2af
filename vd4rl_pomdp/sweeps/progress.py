"""How far an unfinished job is."""

from __future__ import annotations

from vd4rl_pomdp.data.folder import shard_files
from vd4rl_pomdp.runs.checkpoint import Checkpoints
from vd4rl_pomdp.sweeps.plan import Job
from vd4rl_pomdp.sweeps.stages import STAGES


def progress_of(job: Job) -> int:
    """Step of a training's newest checkpoint, or shards of a set; 0 where there is nothing."""
    if job.section in STAGES:
        return max(Checkpoints(job.folder).steps(), default=0)
    return len(shard_files(job.folder))

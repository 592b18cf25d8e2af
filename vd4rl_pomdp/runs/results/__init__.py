"""Results folders: the small files and raw rows of finished runs, which outlive the run folders."""

from vd4rl_pomdp.runs.results.folder import RUNS, Result, read_results, read_run, whole_files, write_results
from vd4rl_pomdp.runs.results.gather import Added, add_results, find_results, refuse_loss

__all__ = [
    "RUNS",
    "Added",
    "Result",
    "add_results",
    "find_results",
    "read_results",
    "read_run",
    "refuse_loss",
    "whole_files",
    "write_results",
]

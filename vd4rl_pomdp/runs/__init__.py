"""Run folders, checkpoints, metrics, progress and provenance."""

FORMAT = 3
"""Version of the content of run folders and checkpoints and of the random streams; only runs of this one can go on."""

"""Run folders, checkpoints, metrics, progress and provenance."""

FORMAT = 3
"""Version of what run folders and checkpoints hold and of the random streams behind it: a run goes on under its own."""

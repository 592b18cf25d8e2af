"""Run folders, checkpoints, metrics, progress and provenance."""

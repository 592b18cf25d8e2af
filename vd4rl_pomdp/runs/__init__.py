"""Run folders, checkpoints, metrics, progress and provenance."""

FORMAT = 3
"""Version of run folders, checkpoints and random streams. Only runs of the same version can be resumed."""

CONFIG_FILE, METRICS_FILE, EPISODES_FILE = "config.json", "metrics.jsonl", "episodes.csv"
LABELS_FILE, MACHINE_FILE, RENDER_FILE, PROBE_FILE = "labels.json", "machine.json", "render.json", "probe.json"
REFERENCE_FILE, NAVIGATION_FILE, DIVERGED_FILE = "reference.json", "results.json", "diverged.json"
CRITIC_FILE = "critic.json"
FILM_FILE, TRAJECTORY_FILE = "film.npz", "trajectory.csv"
PRETRAIN_TIMING_FILE, TIMING_FILE = "pretrain_timing.json", "timing.json"
"""Names of a run's files. The last one is written at the end and marks the run as finished."""
RECORDS = (
    *(CONFIG_FILE, LABELS_FILE, TIMING_FILE, DIVERGED_FILE, MACHINE_FILE, RENDER_FILE),
    *(PRETRAIN_TIMING_FILE, PROBE_FILE, REFERENCE_FILE, CRITIC_FILE, NAVIGATION_FILE),
)
"""Small files that a results folder stores whole, in this order."""

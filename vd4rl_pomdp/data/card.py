"""Write a data set's card, `card.md` and `card.png`, from what its own files record."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.tasks import SCORE_DIVISOR
from vd4rl_pomdp.core.text import code, markdown, plain
from vd4rl_pomdp.data.folder import (
    PROVENANCE,
    StoredSet,
    episode_returns,
    published_scores,
    read_set,
    task_and_quality,
)
from vd4rl_pomdp.data.format import read_some_frames
from vd4rl_pomdp.runs.files import read_json, write_bytes
from vd4rl_pomdp.runs.results import NOT_CERTIFIED, certificate_in_words, read_certificates

FILM_FRAMES = 10
LINES = 0.82
"""Relative height of bars and lines; the legend is above."""
HOW = {
    "random": "Uniformly random actions.",
    "medium": "The medium actor's sampled actions; the shipped one has about half of the expert's return.",
    "expert": "The expert actor's sampled actions; the shipped one is the best snapshot of its training run.",
    "medium_expert": "The first half of the episodes by the expert actor, the second half by the medium actor.",
    "medium_replay": (
        "Regenerated from snapshots of the training run up to its medium level, instead of a replay buffer: each "
        "episode is collected with the run's exploration noise by the snapshot nearest to its place in the run, in "
        "order; the earliest by uniformly random actions."
    ),
    "medium_noisy": "The medium actor's sampled actions, with Gaussian noise added. Not one of V-D4RL's datasets.",
    "expert_noisy": "The expert actor's sampled actions, with Gaussian noise added. Not one of V-D4RL's datasets.",
    "medium_expert_noisy": (
        "The first half of the episodes by the expert actor, the second half by the medium actor, with Gaussian noise "
        "added to their sampled actions. Not one of V-D4RL's datasets."
    ),
}


def write_card(path: Path) -> Path:
    """Write `card.md`, whose path is returned, and `card.png`; UserError for a damaged, incomplete or read-only set."""
    if path.is_file():
        raise UserError(f"{path}: is a single file; a card describes a whole dataset: name its folder")
    stored = read_set(path)
    attributes = stored.attributes
    names = task_and_quality(path, attributes)
    title = ", ".join(name for name in names if name) or "data set"
    returns, lengths = episode_returns(stored.rows["reward"], stored.starts), stored.ends - stored.starts
    scores = [row["bc"] for row in published_scores() if (row["env"], row["dataset"]) == names]
    # plain behaviour cloning is the published score closest to the data's own mean return
    published = float(scores[0]) * SCORE_DIVISOR if scores else None
    film = _film(stored, int(np.argsort(returns)[len(returns) // 2]))
    table = {
        "episodes": len(returns),
        "rows": int(lengths.sum()),
        "rows per episode": " to ".join(str(length) for length in dict.fromkeys([lengths.min(), lengths.max()])),
        "return, mean": f"{returns.mean():.3f}",
        "return, standard deviation": f"{returns.std():.3f}",
        "return, lowest to highest": f"{returns.min():.3f} to {returns.max():.3f}",
        "return, quartiles": ", ".join(f"{q:.1f}" for q in np.quantile(returns, (0.25, 0.5, 0.75))),
        "published return of plain BC on V-D4RL's dataset": "none" if published is None else f"{published:.0f}",
    }
    memory = {f"memory under {one['name']}": certificate_in_words(one) for one in read_certificates([path]).values()}
    table |= memory or {"memory": NOT_CERTIFIED}
    lines = [f"| {name} | {markdown(str(value))} |" for name, value in table.items()]
    lines += [f"| {name} | {value} |" for name, value in _origin(path, attributes).items()]
    collected = "policy" in attributes[0]  # a user's dataset may share a quality's name
    how = HOW.get(names[1] or "", "") if collected else "A published dataset, or one that records no origin."
    if isinstance(source := attributes[0].get("imported"), dict):
        facts = ", ".join(f"{name} {value}" for name, value in source.items() if name != "format")
        how = f"Imported from {markdown(str(source.get('format')))}: {markdown(facts)}."
    head = [f"# {markdown(title)}", "", how, "", "| | |", "|---|---|"]
    text = "\n".join([*head, *lines, "", "![Returns and a film strip](card.png)", ""])
    write_bytes(path / "card.png", _picture(title, returns, published, film))
    write_bytes(path / "card.md", text.encode(errors="backslashreplace"))
    return path / "card.md"


def _film(stored: StoredSet, episode: int) -> np.ndarray:
    """Evenly spaced frames (FILM_FRAMES, 3, S, S) of an episode; fewer if it has fewer."""
    rows = np.linspace(stored.starts[episode], stored.ends[episode] - 1, FILM_FRAMES).astype(int)
    frames, first = [], 0
    for shard, count in zip(stored.shards, stored.counts, strict=True):
        inside = np.unique(rows[(rows >= first) & (rows < first + count)])
        if len(inside):
            frames.append(read_some_frames(shard, inside - first))
        first += count
    return np.concatenate(frames)


def _picture(title: str, returns: np.ndarray, published: float | None, film: np.ndarray) -> bytes:
    figure = Figure(figsize=(8.4, 4.0), layout="constrained", dpi=110)
    above, below = figure.subplots(2, 1, height_ratios=(2.4, 1))
    low, top = min(returns.min(), 0.0), max(returns.max(), published or 0.0, 1.0)
    counts, edges, _ = above.hist(returns, bins=np.linspace(low, top * 1.02, 41), color="#56b4e9")
    above.axvline(returns.mean(), ymax=LINES, color="#0072b2", label=f"mean of this dataset, {returns.mean():.1f}")
    if published is not None:
        label = f"published: plain BC on V-D4RL's dataset of this name, {published:.0f}"
        above.axvline(published, ymax=LINES, color="#d55e00", ls="--", label=label)
    above.set(xlabel="episode return", ylabel="episodes", title=plain(title))
    above.set(xlim=(edges[0], edges[-1]), ylim=(0, counts.max() / LINES))
    above.yaxis.get_major_locator().set_params(integer=True)
    above.spines[["top", "right"]].set_visible(False)
    above.legend(frameon=False, fontsize=8, ncols=2, loc="upper center")
    below.imshow(np.concatenate(list(film.transpose(0, 2, 3, 1)), axis=1), interpolation="nearest")
    below.set_title("the episode of median return, first row to last", fontsize=9)
    below.axis("off")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def _origin(path: Path, attributes: list[dict[str, Any]]) -> dict[str, str]:
    """Seed, actors, rendering, versions and commit from the data set's files, as Markdown by name."""
    first = attributes[0]
    facts = {"seed": first.get("seed"), "render": first.get("render")}
    facts["noise added to actions, standard deviation"] = first.get("action_noise")
    facts |= {
        f"actor {a.get('policy', 'unknown')}, SHA-256": a["actor_sha256"] for a in attributes if a.get("actor_sha256")
    }
    record = path / PROVENANCE
    if first and record.exists():
        provenance = read_json(record)
        if not all(isinstance(provenance.get(name, {}), dict) for name in ("render", "versions")):
            raise UserError(f"{record}: is damaged; remove it to write the card without it")
        rendered = provenance.get("render", {})
        facts["rendered by"] = ", ".join(str(rendered[k]) for k in ("gl_vendor", "gl_renderer") if k in rendered)
        facts["canary frames"] = rendered.get("canary")
        facts["versions"] = ", ".join(f"{k} {v}" for k, v in provenance.get("versions", {}).items())
        facts["commit"] = provenance.get("git_commit")
        facts["command"] = provenance.get("command")
    return {
        markdown(name): (code if name == "command" else markdown)(str(value))
        for name, value in facts.items()
        if value not in (None, "")
    }

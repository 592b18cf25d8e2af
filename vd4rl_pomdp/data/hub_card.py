"""The README.md of a data set on the Hugging Face Hub: its data card, or what its files tell if it has none."""

from __future__ import annotations

import json
from pathlib import Path

from vd4rl_pomdp.core.reading import read_bytes
from vd4rl_pomdp.core.text import code, code_block, one_line
from vd4rl_pomdp.data.format import read_attributes, shard_paths
from vd4rl_pomdp.data.manifest import task_and_quality

TAGS = ("reinforcement-learning", "offline-reinforcement-learning", "vd4rl-pomdp")


def set_card(folder: Path, repository: str, license: str) -> str:
    """Text of the card.

    Args:
        folder: a set's folder.
        repository: OWNER/NAME on the Hub.
        license: the licence that its owner gives it, as the Hub spells it.
    """
    names = task_and_quality(folder, [read_attributes(shard) for shard in shard_paths(folder)])
    tags = [*TAGS, *(one_line(name) for name in names if name)]
    task, quality = (code(name or "unknown") for name in names)
    told = folder / "card.md"
    body = read_bytes(told).decode(errors="replace") if told.is_file() else f"# {task}, {quality}\n"
    use = code_block([f"vd4rl-pomdp hub pull datasets/{repository} FOLDER"], "bash")
    front = ["---", f"license: {json.dumps(license)}", f"tags: {json.dumps(tags)}", "---", ""]
    return "\n".join([*front, body.rstrip(), "", "## Use it", "", *use, ""])

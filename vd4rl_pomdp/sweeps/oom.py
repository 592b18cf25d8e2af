"""Processes that the kernel ends for want of memory: like any that is killed, but for a count that it keeps."""

from __future__ import annotations

from pathlib import Path

_OWN = Path("/proc/self/cgroup")
_GROUPS = Path("/sys/fs/cgroup")


def oom_kills() -> int:
    """How many processes of this one's control group the kernel has ended so; 0 where it does not say."""
    for path in _counts():
        try:
            rows = [line.split() for line in path.read_text(encoding="utf-8").splitlines()]
        except OSError:  # not there, or not this process's to read
            continue
        return sum(int(value) for name, value in rows if name == "oom_kill")
    return 0


def _counts() -> list[Path]:
    """Where the count may stand: by version 1 or 2 of control groups, in a container perhaps at their root."""
    try:
        rows = [line.split(":", 2) for line in _OWN.read_text(encoding="utf-8").splitlines()]
    except OSError:
        return []
    paths = {controllers: path.strip("/") for _, controllers, path in rows}
    old = [_GROUPS / "memory" / path / "memory.oom_control" for path in (paths.get("memory", ""), "")]
    return [*old, *(_GROUPS / path / "memory.events" for path in (paths.get("", ""), ""))]

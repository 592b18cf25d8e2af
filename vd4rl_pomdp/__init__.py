"""Which representations survive partial observability in offline visual reinforcement learning."""

import os
from typing import TYPE_CHECKING

from vd4rl_pomdp.core import __version__

if TYPE_CHECKING:
    from vd4rl_pomdp.agents import load_agent
    from vd4rl_pomdp.data import open_dataset

# Threads that wait for each other sleep. Else they spin, and where another process is on one of the cores, each of the
# many short waits in a step of training lasts until the system takes the core from a thread that only spins. OpenMP
# reads this when torch loads it, so it comes before torch; what the user has set stays.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__all__ = ["__version__", "load_agent", "open_dataset"]


def __getattr__(name: str) -> object:
    if name == "open_dataset":
        from vd4rl_pomdp.data import open_dataset

        return open_dataset
    if name == "load_agent":
        from vd4rl_pomdp.agents import load_agent

        return load_agent
    raise AttributeError(f"module 'vd4rl_pomdp' has no attribute {name!r}")

"""Which representations survive partial observability in offline visual reinforcement learning."""

import os
from typing import TYPE_CHECKING

from vd4rl_pomdp.core import __version__

if TYPE_CHECKING:
    from vd4rl_pomdp.agents import load_agent
    from vd4rl_pomdp.data import open_dataset

# Threads that wait for each other spin for some microseconds, then sleep. PyTorch's default spins for milliseconds:
# where another process is on one of the cores, each of the many short waits in a step lasts until the system takes the
# core from the spinning thread. Sleeping at once costs a third of the speed on idle cores. OpenMP reads this when torch
# loads it, so it comes before torch; what the user has set stays.
if not {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"} & os.environ.keys():
    os.environ |= {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "500"}

__all__ = ["__version__", "load_agent", "open_dataset"]


def __getattr__(name: str) -> object:
    if name == "open_dataset":
        from vd4rl_pomdp.data import open_dataset

        return open_dataset
    if name == "load_agent":
        from vd4rl_pomdp.agents import load_agent

        return load_agent
    raise AttributeError(f"module 'vd4rl_pomdp' has no attribute {name!r}")

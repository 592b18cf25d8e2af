"""Public path of batches: windows, transitions and the time axis; the code is in `vd4rl_pomdp.core.types`."""

from vd4rl_pomdp.core.types import *  # noqa: F403
